"""Rate limit of the log, against peers that flood it; the number of suppressed lines is logged."""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from nedbus.log_event import EVENTS, About

from .streams import MAX_TEXT

BURST: Final = 50
"""Lines of one kind that may be logged at once."""

PER_MINUTE: Final = 6
"""Lines of one kind that may be logged per minute after a burst."""

_MAX_KINDS: Final = 1000  # nedbus itself has about 40

Kind = tuple[str, str | None, str]
"""Logger, event and unformatted text of a record."""


@dataclass(slots=True, eq=False)
class _TokenBucket:
    """Token bucket of one kind of line, and the number of lines suppressed since the last report."""

    filled: float
    tokens: float = BURST
    left_out: int = 0
    first: Mapping[str, object] = field(default_factory=dict)  # not the record itself, which may keep a traceback alive

    def fill(self, now: float) -> bool:
        """Add the tokens earned since the last call; return True if a line may be logged."""
        self.tokens = min(BURST, self.tokens + (now - self.filled) * PER_MINUTE / 60)
        self.filled = now
        return self.tokens >= 1


class RateLimit(logging.Filter):
    """Pass a burst of each kind of record, then a few per minute.

    `handle`, the method of the handler, gets a record with the number of suppressed lines once that kind may be logged
    again. Records of unlimited events always pass.
    """

    def __init__(
        self, handle: Callable[[logging.LogRecord], object], *, now: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__()
        self._handle = handle
        self._now = now
        self._buckets: dict[Kind, _TokenBucket] = {}
        self._lock = threading.RLock()  # reentrant, as in logging: garbage collection may log while it is held

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if a record may be logged; first report suppressed lines of kinds that may be logged again."""
        now = self._now()
        self._report(lambda bucket: bucket.fill(now))
        about = about_of(record)
        event = about.event if about else None
        if event is not None and not EVENTS[event].limited:
            return True
        kind = record.name, event, str(record.msg)
        with self._lock:
            if kind not in self._buckets and len(self._buckets) >= _MAX_KINDS:
                kind = "", None, ""  # all others
            bucket = self._buckets.setdefault(kind, _TokenBucket(now))
            if bucket.fill(now):
                bucket.tokens -= 1
                return True
            if not bucket.left_out:
                text = f"suppressed %d more lines like this one: {record.getMessage()[:MAX_TEXT].replace('%', '%%')}"
                names = {"name": record.name, "levelno": record.levelno, "levelname": record.levelname}
                bucket.first = {**names, "msg": text}
            bucket.left_out += 1
            return False

    def flush(self) -> None:
        """Report all suppressed lines."""
        self._report(lambda _: True)

    def _report(self, is_due: Callable[[_TokenBucket], bool]) -> None:
        reports = []
        with self._lock:
            for (_, event, _), bucket in self._buckets.items():
                if bucket.left_out and is_due(bucket):
                    about, args = About("left-out", count=bucket.left_out, of=event), (bucket.left_out,)
                    reports.append(logging.makeLogRecord({**bucket.first, "args": args, "about": about}))
                    bucket.left_out = 0
        for report in reports:
            self._handle(report)


def about_of(record: logging.LogRecord) -> About | None:
    """Return the structured fields of a log call; None for records of other packages."""
    about = getattr(record, "about", None)
    return about if isinstance(about, About) else None
