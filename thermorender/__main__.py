"""`python -m thermorender` is the command line."""

from thermorender.cli import main

main()
