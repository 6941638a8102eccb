"""Run commands that exit on their own inside the test process, and return their output and exit code.

Commands that need a signal, a stream or a concurrent peer run as processes: `run_nedbus`, `fork_command`.
"""

from __future__ import annotations

import atexit
import io
import logging
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import typer

from nedbus.cli.app import make_app
from nedbus.cli.output.logs import RateLimit
from tests.waits import DEADLINE

from .processes import ForkedProcess, ForkServer, without_coverage

_SIZE: Final = {"COLUMNS": "80", "LINES": "24"}  # default terminal size, whatever pytest runs in


@dataclass(frozen=True)
class CommandResult:
    """Exit code and output of a command."""

    exit_code: int
    out: str
    err: str


def run_command(*arguments: str, **environment: str) -> CommandResult:
    """Run `nedbus` with these arguments in the main thread."""
    exit_code, out, err = 0, io.BytesIO(), io.BytesIO()
    stdout = io.TextIOWrapper(out, "utf-8", write_through=True)
    stderr = io.TextIOWrapper(err, "utf-8", errors="backslashreplace", write_through=True)
    with (
        patch.dict(os.environ, _SIZE | environment),
        redirect_stdout(stdout),
        redirect_stderr(stderr),
        _as_process(),
    ):
        try:
            _commands().main(arguments, prog_name="nedbus")
        except SystemExit as exc:
            exit_code = int(exc.code or 0)
        except Exception:  # noqa: BLE001 - printed, as by a process
            exit_code = 1
            traceback.print_exc()
    return CommandResult(exit_code, out.getvalue().decode(), err.getvalue().decode())


def run_until_shown(text: str, *arguments: str, **environment: str) -> CommandResult:
    """Repeat a command until it prints a text: a service on a busy machine may answer after the command's timeout.

    Line breaks and spaces of the output count as one space.
    """
    end = time.monotonic() + DEADLINE
    while True:
        result = run_command(*arguments, **environment)
        if text in " ".join(result.out.split()) or text in " ".join(result.err.split()):
            return result
        assert time.monotonic() < end, f"{text!r} is not shown by {arguments}: {result}"


def fork_command(
    fork_server: ForkServer, *arguments: str, out: int, err: int | None = None, **environment: str
) -> ForkedProcess:
    """Start `nedbus` with these arguments and streams, without coverage; the caller must end it."""
    with Path(os.devnull).open("r+b") as null:
        streams = null.fileno(), out, null.fileno() if err is None else err
        started = without_coverage() | environment
        return fork_server.start(
            ("-m", "nedbus", *arguments), cwd=Path.cwd(), environment=started, streams=streams
        )


@cache
def _commands() -> Any:
    """Return the click command of the app; cached, because it takes 0.1 s to build."""
    return typer.main.get_command(make_app())


@contextmanager
def _as_process() -> Iterator[None]:
    """Save and restore process-wide state: logging, signal handlers and hooks for uncaught errors."""
    signals = {
        number: signal.getsignal(number)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    root = logging.getLogger()
    levels = {logger: logger.level for logger in (root, logging.getLogger("nedbus"))}
    # otherwise pytest's handlers would count as a configured log
    handlers, root.handlers = root.handlers, []
    hooks = sys.excepthook, threading.excepthook
    try:
        yield
    finally:
        for limit in [
            each
            for handler in root.handlers
            for each in handler.filters
            if isinstance(each, RateLimit)
        ]:
            limit.report()
            atexit.unregister(limit.report)
        root.handlers = handlers
        for logger, level in levels.items():
            logger.setLevel(level)
        sys.excepthook, threading.excepthook = hooks
        for number, handler in signals.items():
            signal.signal(number, handler)
