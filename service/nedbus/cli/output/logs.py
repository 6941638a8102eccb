"""Logging to stderr: text for terminals, syslog priorities for the journal, or JSON."""

import atexit
import json
import logging
import os
import sys
import threading
from dataclasses import asdict
from datetime import UTC, datetime
from types import TracebackType
from typing import Final, Literal, TextIO

from nedbus.errors import NedbusError
from nedbus.log_event import about

from .log_limit import RateLimit, about_of
from .streams import MAX_TEXT, STRUCTURED, printable, to_text

_log = logging.getLogger("nedbus")
_DATE: Final = "%Y-%m-%d %H:%M:%S"
_MAX_TRACEBACK: Final = 20_000  # characters, the last ones: they name the error
_PRIORITIES: Final = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.NOTSET, 7))

LogFormat = Literal["text", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]
ExcInfo = tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None]


class TextFormatter(logging.Formatter):
    """Format a record as one printable line, plus those of a traceback."""

    def __init__(self, style: str = "%(asctime)s %(levelname)-7s %(message)s") -> None:
        super().__init__(style, _DATE)

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - overrides logging
        """Return the line without a traceback."""
        record.message = to_text(record.message, MAX_TEXT)
        return super().formatMessage(record)

    def formatException(self, ei: ExcInfo) -> str:  # noqa: N802 - overrides logging
        """Return the last part of a traceback."""
        return super().formatException(ei)[-_MAX_TRACEBACK:]

    def format(self, record: logging.LogRecord) -> str:
        """Return the line or lines of a record."""
        return printable(super().format(record))


class JsonFormatter(TextFormatter):
    """Format a record as a JSON object on one line; fields without a value are omitted."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the JSON object of a record."""
        about = about_of(record)
        fields: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")[:-6] + "Z",
            "level": record.levelname.lower(),
            "event": None,
            "message": to_text(record.getMessage(), MAX_TEXT),
            "logger": record.name,
        }
        for key, value in asdict(about).items() if about else ():
            if value is not None:
                fields[key] = to_text(value, MAX_TEXT) if isinstance(value, str) else value
        if record.exc_info:
            fields["exception"] = printable(self.formatException(record.exc_info))
        return json.dumps(fields)


class JournalFormatter(logging.Formatter):
    """Prefix each line of another formatter with its syslog priority, see sd-daemon(3)."""

    def __init__(self, inner: logging.Formatter) -> None:
        super().__init__()
        self._inner = inner

    def format(self, record: logging.LogRecord) -> str:
        """Return the line or lines of a record."""
        priority = next(number for level, number in _PRIORITIES if record.levelno >= level)
        return "\n".join(f"<{priority}>{line}" for line in self._inner.format(record).split("\n"))


class _StderrHandler(logging.StreamHandler[TextIO]):
    """Write to the current `sys.stderr`: a live table replaces it, to stay below the log."""

    def emit(self, record: logging.LogRecord) -> None:
        self.setStream(sys.stderr)
        super().emit(record)


def log_to_stderr(*, level: LogLevel, log_format: LogFormat) -> None:
    """Log to stderr, one line per record, with syslog priorities if stderr is the journal."""
    is_journal, is_json = _is_journal(), log_format == "json"
    formatter = JsonFormatter() if is_json else TextFormatter("%(message)s") if is_journal else TextFormatter()
    handler = _StderrHandler()
    handler.setFormatter(JournalFormatter(formatter) if is_journal else formatter)
    if is_journal or is_json:
        handler.name = STRUCTURED
        _log_uncaught_errors()
    limit = RateLimit(handler.handle)
    handler.addFilter(limit)
    atexit.register(limit.flush)
    logging.basicConfig(handlers=[handler], force=True)
    number = logging.getLevelNamesMapping()[level.upper()]
    logging.getLogger("nedbus").setLevel(number)
    logging.getLogger().setLevel(max(number, logging.WARNING))


def _is_journal() -> bool:
    """Return True if stderr is connected to the journal; see JOURNAL_STREAM in systemd.exec(5)."""
    try:
        status = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):  # closed, or not a file
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def _log_uncaught_errors() -> None:
    """Log uncaught errors; Python would print them as several lines."""

    def log(kind: type[BaseException], error: BaseException | None, traceback: TracebackType | None) -> None:
        if not issubclass(kind, SystemExit):
            exc_info = None if error is None else (kind, error, traceback)
            text = str(error) if issubclass(kind, NedbusError) else f"unexpected {kind.__name__}: {error}"
            _log.error("%s", text, exc_info=exc_info, extra=about("error"))

    sys.excepthook = log
    threading.excepthook = lambda caught: log(caught.exc_type, caught.exc_value, caught.exc_traceback)
