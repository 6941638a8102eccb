"""Command line, built on the public API."""

import atexit
import gc
import os
import signal
import sys
from contextlib import suppress

from nedbus import __version__

__all__ = ["main", "run_command"]

# by the exceptions that they raise
_SIGNALS = {KeyboardInterrupt: signal.SIGINT, SystemExit: signal.SIGTERM}


def main() -> None:
    """Run `nedbus`, and end the process."""
    exit_code: list[int] = []
    atexit.register(_end_process, exit_code)  # the first one, so it runs last
    try:
        run_command()
    except SystemExit as exc:
        if isinstance(exc.code, int):
            exit_code.append(exc.code)
        raise


def run_command() -> None:
    """Run the command in `sys.argv`; raise SystemExit when it ends."""
    # no traceback during the imports; a script's `&` sets SIG_IGN
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        # otherwise a socket could get the descriptor of a closed standard stream, and receive the output
        pass
    os.close(descriptor)
    if sys.stderr is None:
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115 - open until exit
    if sys.argv[1:] == ["--version"] and sys.stdout is not None:
        sys.stdout.write(f"nedbus {__version__}\n")  # before the slow imports below
        return
    sys.unraisablehook = _repeat_signal
    atexit.register(_discard_broken_stderr)
    # Pydantic would search all installed packages for plugins, which takes a tenth of a short command and 1 MB.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    gc.disable()  # garbage collection takes a sixth of the import time and frees nothing
    from .app import make_app

    # by a shell, which passes the command line in COMP_WORDS
    is_completing = "_NEDBUS_COMPLETE" in os.environ
    app = make_app(None if is_completing else sys.argv[1:])
    # what was imported stays: the first collection would search all of it, for a tenth of a short command
    gc.freeze()
    gc.enable()
    app()


def _repeat_signal(unraisable: "sys.UnraisableHookArgs") -> None:
    """Report an exception that Python ignores; repeat a signal that it ignored, inside a destructor or callback."""
    number = _SIGNALS.get(unraisable.exc_type)
    if number is not None:
        import threading

        threading.Timer(0.01, os.kill, (os.getpid(), number)).start()
    else:
        sys.__unraisablehook__(unraisable)


def _end_process(exit_code: list[int]) -> None:
    """End the process before Python's finalization, which aborts it if a background thread is in Zenoh or Pydantic.

    A command does not wait for all of its threads: one may still connect to a router, open a log or render a page.
    """
    if exit_code:
        with suppress(OSError):  # the finalization reports it
            if sys.stdout is not None:
                sys.stdout.flush()
            sys.stderr.flush()
            os._exit(exit_code[0])


def _discard_broken_stderr() -> None:
    """Redirect stderr to /dev/null if its terminal is gone: flushing it at exit would fail with exit code 120."""
    try:
        sys.stderr.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
