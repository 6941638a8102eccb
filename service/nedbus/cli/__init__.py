"""The command line, a user of the library."""

import atexit
import gc
import os
import signal
import sys

from nedbus import __version__

__all__ = ["main"]


def main() -> None:
    """Run `nedbus`."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C in the middle of an import would show a traceback
    _fill_closed_streams()
    if sys.argv[1:] == ["--version"] and sys.stdout is not None:
        sys.stdout.write(f"nedbus {__version__}\n")  # at once: the imports below take longer
        return
    atexit.register(_give_up_stderr)
    gc.disable()  # collections take a sixth of the time of the imports, and find nothing
    from .app import app

    gc.enable()
    app()


def _fill_closed_streams() -> None:
    """Open the null device in place of closed standard streams: a socket with their number would get their output."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    if sys.stderr is None:
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115 - until the end


def _give_up_stderr() -> None:
    """Discard stderr if its terminal is gone: Python would flush it again at exit, and exit with 120."""
    try:
        sys.stderr.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
