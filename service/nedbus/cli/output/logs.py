"""Rate-limited logging to stderr: text for terminals, syslog priorities for the journal, or JSON."""

import atexit
import json
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from types import TracebackType
from typing import Final, TextIO

from nedbus import limits
from nedbus.errors import NedbusError
from nedbus.log_event import EVENTS, About, about
from nedbus_msgs.text import counted

from . import LogFormat, LogLevel
from .streams import STRUCTURED, printable, to_text

BURST: Final = 50  # lines of one kind that may be logged at once
PER_MINUTE: Final = 6  # lines of one kind that may be logged per minute after a burst
_log = logging.getLogger("nedbus")
_DATE: Final = "%Y-%m-%d %H:%M:%S"
_PRIORITIES: Final = (
    (logging.ERROR, 3),
    (logging.WARNING, 4),
    (logging.INFO, 6),
    (logging.NOTSET, 7),
)

ExcInfo = tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None]


class TextFormatter(logging.Formatter):
    """Format a record as one printable line, followed by the lines of a traceback."""

    def __init__(self, style: str = "%(asctime)s %(levelname)-7s %(message)s") -> None:
        super().__init__(style, _DATE)

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - overrides logging
        """Return the line without a traceback."""
        record.message = to_text(record.message, limits.LINE_TEXT)
        return super().formatMessage(record)

    def formatException(self, ei: ExcInfo) -> str:  # noqa: N802 - overrides logging
        """Return the end of a traceback, with control characters escaped."""
        return printable(super().formatException(ei)[-limits.TRACEBACK_TEXT :])


class JsonFormatter(TextFormatter):
    """Format a record as a JSON object on one line; fields without a value are omitted."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the JSON object of a record."""
        about: About | None = getattr(record, "about", None)  # None for records of other packages
        created = datetime.fromtimestamp(record.created, UTC)
        text = created.isoformat(timespec="milliseconds")
        fields: dict[str, object] = {
            "time": f"{text.removesuffix('+00:00')}Z",
            "level": record.levelname.lower(),
            "event": None,
            "message": to_text(record.getMessage(), limits.LINE_TEXT),
            "logger": record.name,
        }
        for key, value in asdict(about).items() if about else ():
            if value is not None:
                if isinstance(value, str):
                    fields[key] = to_text(value, limits.LINE_TEXT)
                else:
                    fields[key] = value
        if record.exc_info:
            fields["exception"] = self.formatException(record.exc_info)
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


@dataclass(slots=True, eq=False)
class _TokenBucket:
    """Token bucket of one kind of line, and the number of lines suppressed since the last report."""

    refilled: float
    tokens: float = BURST
    suppressed: int = 0
    # not the record itself, which may keep a traceback alive
    first: Mapping[str, object] = field(default_factory=dict)

    def refill(self, now: float) -> bool:
        """Add the tokens earned since the last call; return True if a line may be logged."""
        self.tokens = min(BURST, self.tokens + (now - self.refilled) * PER_MINUTE / 60)
        self.refilled = now
        return self.tokens >= 1


class RateLimit(logging.Filter):
    """Pass a burst of each kind of record, then a few per minute.

    `handle`, the method of the handler, receives a record with the number of suppressed lines once that kind may be
    logged again. Records of unlimited events always pass.
    """

    def __init__(
        self,
        handle: Callable[[logging.LogRecord], object],
        *,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__()
        self._handle = handle
        self._now = now
        self._buckets: dict[tuple[str, str | None, str], _TokenBucket] = {}
        # reentrant, as in logging: garbage collection may log while it is held
        self._lock = threading.RLock()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if a record may be logged; first report suppressed lines of kinds that may be logged again."""
        now = self._now()
        self.report(lambda bucket: bucket.refill(now))
        about: About | None = getattr(record, "about", None)
        event = None
        if about:
            event = about.event
        if event is not None and not EVENTS[event].limited:
            return True
        kind = record.name, event, str(record.msg)
        with self._lock:
            if kind not in self._buckets and len(self._buckets) >= limits.LOG_KINDS:
                kind = "", None, ""  # one bucket for all further kinds
            bucket = self._buckets.setdefault(kind, _TokenBucket(now))
            if bucket.refill(now):
                bucket.tokens -= 1
                return True
            if not bucket.suppressed:
                example = record.getMessage()[: limits.LINE_TEXT].replace("%", "%%")
                bucket.first = {
                    "name": record.name,
                    "levelno": record.levelno,
                    "levelname": record.levelname,
                    "msg": f"suppressed %s like this one: {example}",
                }
            bucket.suppressed += 1
            return False

    def report(self, is_due: Callable[[_TokenBucket], bool] = lambda _: True) -> None:
        """Report suppressed lines, by default all."""
        reports = []
        with self._lock:
            for (_, event, _), bucket in self._buckets.items():
                if bucket.suppressed and is_due(bucket):
                    count = bucket.suppressed
                    about = About("suppressed", count=count, of=event)
                    fields = {
                        **bucket.first,
                        "args": (counted(count, "more line"),),
                        "about": about,
                    }
                    reports.append(logging.makeLogRecord(fields))
                    bucket.suppressed = 0
        for report in reports:
            self._handle(report)


class _StderrHandler(logging.StreamHandler[TextIO]):
    """Write to the current `sys.stderr`, which `live_table` replaces to print log lines above the table."""

    def emit(self, record: logging.LogRecord) -> None:
        self.setStream(sys.stderr)
        super().emit(record)


def log_to_stderr(*, level: LogLevel, log_format: LogFormat) -> None:
    """Log to stderr, one line per record, with syslog priorities if stderr is the journal."""
    is_journal = False
    is_json = log_format == "json"
    with suppress(OSError, ValueError):  # stderr is closed, or not a file
        status = os.fstat(sys.stderr.fileno())
        # see systemd.exec(5)
        is_journal = os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"
    formatter: logging.Formatter = TextFormatter()
    if is_json:
        formatter = JsonFormatter()
    elif is_journal:
        formatter = TextFormatter("%(message)s")
    if is_journal:
        formatter = JournalFormatter(formatter)
    handler = _StderrHandler()
    handler.setFormatter(formatter)
    if is_journal or is_json:
        handler.name = STRUCTURED
        sys.excepthook = _log_uncaught
        threading.excepthook = lambda caught: _log_uncaught(
            caught.exc_type, caught.exc_value, caught.exc_traceback
        )
    limit = RateLimit(handler.handle)
    handler.addFilter(limit)
    atexit.register(limit.report)
    logging.basicConfig(handlers=[handler], force=True)
    number = logging.getLevelNamesMapping()[level.upper()]
    logging.getLogger("nedbus").setLevel(number)
    logging.getLogger().setLevel(max(number, logging.WARNING))


def _log_uncaught(
    kind: type[BaseException], error: BaseException | None, traceback: TracebackType | None
) -> None:
    if issubclass(kind, SystemExit):
        return
    text = str(error)
    if not issubclass(kind, NedbusError):
        text = f"unexpected {kind.__name__}: {error}"
    if error is None:
        exc_info = None
    else:
        exc_info = (kind, error, traceback)
    _log.error("%s", text, exc_info=exc_info, extra=about("error"))
