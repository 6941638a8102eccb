"""Where the log goes: to stderr as text, to the journal with priorities, as JSON, or above what is redrawn in place."""

from __future__ import annotations

import atexit
import logging
import os
import sys
import threading
from enum import StrEnum
from types import TracebackType
from typing import TYPE_CHECKING, TextIO

from nedbus.errors import NedbusError
from nedbus.log_event import about

from .log_format import DATE, JournalFormatter, JsonFormatter, TextFormatter
from .log_limit import RateLimit

if TYPE_CHECKING:
    from rich.console import Console

_log = logging.getLogger("nedbus")


class LogFormat(StrEnum):
    """How lines look."""

    TEXT = "text"
    JSON = "json"


class LogLevel(StrEnum):
    """From which level on lines are logged."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


def log_to_stderr(*, level: LogLevel = LogLevel.INFO, log_format: LogFormat = LogFormat.TEXT) -> None:
    """Log to stderr, a line for each record; with priorities where that is the journal."""
    to_journal = _is_journal(sys.stderr)
    formatter: logging.Formatter
    if log_format is LogFormat.JSON:
        formatter = JsonFormatter()
    else:
        formatter = TextFormatter("%(message)s") if to_journal else TextFormatter()
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JournalFormatter(formatter) if to_journal else formatter)
    _install(handler, force=False)
    if logs_for_programs():
        _log_uncaught_errors()
    number = logging.getLevelNamesMapping()[level.name]
    logging.getLogger("nedbus").setLevel(number)
    logging.getLogger().setLevel(max(number, logging.WARNING))


def log_to(console: Console) -> None:
    """Log to the terminal on which something is redrawn in place, above it."""
    from rich.logging import RichHandler

    handler = RichHandler(console=console, show_path=False, log_time_format=DATE)
    handler.setFormatter(TextFormatter("%(message)s"))
    _install(handler, force=True)


def _install(handler: logging.Handler, *, force: bool) -> None:
    limit = RateLimit(handler.handle)
    handler.addFilter(limit)
    atexit.register(limit.flush)
    logging.basicConfig(handlers=[handler], force=force)


def logs_for_programs() -> bool:
    """Return whether the log is read by programs: then nothing else is written to stderr."""
    formatters = [handler.formatter for handler in logging.getLogger().handlers]
    return any(isinstance(each, JsonFormatter | JournalFormatter) for each in formatters)


def _is_journal(stream: TextIO) -> bool:
    """Return whether a stream is connected to the journal, as sd_journal_print(3) describes JOURNAL_STREAM."""
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):  # closed, or no file
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def _log_uncaught_errors() -> None:
    """Log errors that nobody caught, which Python itself would print as several lines."""

    def log(kind: type[BaseException], error: BaseException | None, traceback: TracebackType | None) -> None:
        if not issubclass(kind, SystemExit):
            exc_info = None if error is None else (kind, error, traceback)
            text = str(error) if issubclass(kind, NedbusError) else f"an unexpected {kind.__name__}: {error}"
            _log.error("%s", text, exc_info=exc_info, extra=about("error"))

    sys.excepthook = log
    threading.excepthook = lambda caught: log(caught.exc_type, caught.exc_value, caught.exc_traceback)
