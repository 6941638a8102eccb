"""How a line of the log looks: for people, for the journal, and as JSON for programs."""

from __future__ import annotations

import json
import logging
from datetime import UTC, datetime
from types import TracebackType
from typing import Final

from .format import MAX_TEXT, printable, to_text
from .log_limit import about_of

DATE: Final = "%Y-%m-%d %H:%M:%S"
"""How the date of a line for people is written."""

_TEXT: Final = "%(asctime)s %(levelname)-7s %(message)s"
_MAX_TRACEBACK: Final = 20_000  # characters, the last ones, in which the error is named
_KEYS: Final = ("vehicle", "topic", "instance", "source", "reason", "count", "of")
_PRIORITIES: Final = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
_DEBUG: Final = 7

ExcInfo = tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None]


class TextFormatter(logging.Formatter):
    """Format a record as one line of printable characters; with a traceback as several."""

    def __init__(self, style: str = _TEXT) -> None:
        super().__init__(style, DATE)

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the name is that of logging
        """Return the line without a traceback."""
        record.message = to_text(record.message, MAX_TEXT)
        return super().formatMessage(record)

    def formatException(self, ei: ExcInfo) -> str:  # noqa: N802 - the name is that of logging
        """Return the end of a traceback."""
        return super().formatException(ei)[-_MAX_TRACEBACK:]

    def format(self, record: logging.LogRecord) -> str:
        """Return the line, or the lines."""
        return printable(super().format(record))


class JsonFormatter(TextFormatter):
    """Format a record as one JSON object on one line; what is not known has no key."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the object."""
        about = about_of(record)
        fields: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")[:-6] + "Z",
            "level": record.levelname.lower(),
            "event": about.event if about else None,
            "message": to_text(record.getMessage(), MAX_TEXT),
            "logger": record.name,
        }
        for key in _KEYS if about else ():
            value = getattr(about, key)
            if value is not None:
                fields[key] = to_text(value, MAX_TEXT) if isinstance(value, str) else value
        if record.exc_info:
            fields["exception"] = printable(self.formatException(record.exc_info))
        return json.dumps(fields)


class JournalFormatter(logging.Formatter):
    """Put the priority of syslog before each line of another formatter, as sd-daemon(3) describes."""

    def __init__(self, inner: logging.Formatter) -> None:
        super().__init__()
        self._inner = inner

    def format(self, record: logging.LogRecord) -> str:
        """Return the line, or the lines."""
        priority = next((number for level, number in _PRIORITIES if record.levelno >= level), _DEBUG)
        return "\n".join(f"<{priority}>{line}" for line in self._inner.format(record).split("\n"))
