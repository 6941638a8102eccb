"""`python -m nedbus` is `nedbus`."""

from nedbus.cli import main

main()
