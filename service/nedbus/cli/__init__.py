"""The command line: everything it does, the library does."""

import sys

from nedbus import __version__

__all__ = ["main"]


def main() -> None:
    """Run `nedbus`."""
    if sys.argv[1:] == ["--version"]:
        sys.stdout.write(f"nedbus {__version__}\n")  # at once: all the rest takes longer to load than this takes
        return
    from .app import app

    app()
