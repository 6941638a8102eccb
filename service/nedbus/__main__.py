"""Entry point of `python -m nedbus`, the same as the command `nedbus`."""

from nedbus.cli import main

main()
