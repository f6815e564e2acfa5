"""`python -m thermorender` is the command line."""

from thermorender.cli.app import main

main()
