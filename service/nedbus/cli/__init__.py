"""The command line, a user of the library."""

import sys

from nedbus import __version__

__all__ = ["main"]


def main() -> None:
    """Run `nedbus`."""
    if sys.argv[1:] == ["--version"]:
        sys.stdout.write(f"nedbus {__version__}\n")  # at once: the imports below take longer
        return
    from .app import app

    app()
