"""Applications around the renderer: each builds on the public names of the core, and the core imports none of them.

An application's `__init__` declares what `thermorender.cli.registry` finds: `VERBS`, its verbs on the command line, and
`PROVIDES`, functions that the core calls where the application is installed.
"""
