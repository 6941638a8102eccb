"""Rate limit of the log: no peer can fill a disk, whatever it sends, and the number of suppressed lines is logged."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from nedbus.log_event import EVENTS, About

from .streams import MAX_TEXT

BURST: Final = 50
"""Lines of one kind that are logged at once."""

PER_MINUTE: Final = 6
"""Lines of one kind that are logged in each minute after that."""

_MAX_KINDS: Final = 1000  # nedbus itself has about 40

Kind = tuple[str, str | None, str]
"""A logger, an event, and the text before the values were put in."""


@dataclass(slots=True, eq=False)
class _TokenBucket:
    """The number of lines of one kind that may be logged now, and the number left out since the last report."""

    filled: float
    tokens: float = BURST
    left_out: int = 0
    report: Mapping[str, object] = field(default_factory=dict)  # no record: it may keep a traceback alive

    def fill(self, now: float) -> bool:
        """Add the tokens of the time since the last call; return whether there is one."""
        self.tokens = min(BURST, self.tokens + (now - self.filled) * PER_MINUTE / 60)
        self.filled = now
        return self.tokens >= 1

    def leave_out(self, record: logging.LogRecord) -> None:
        if not self.left_out:
            text = f"%d more lines like this one were left out: {record.getMessage()[:MAX_TEXT].replace('%', '%%')}"
            self.report = {"name": record.name, "levelno": record.levelno, "levelname": record.levelname, "msg": text}
        self.left_out += 1

    def take_report(self, event: str | None) -> logging.LogRecord:
        count, self.left_out = self.left_out, 0
        return logging.makeLogRecord(
            {**self.report, "args": (count,), "about": About("left-out", count=count, of=event)}
        )


class RateLimit(logging.Filter):
    """Let a burst of each kind of record pass, then a few a minute.

    `handle` is the handler's: it gets a record with the number of lines left out, as soon as one could be logged again.
    Records of events that are not limited always pass.
    """

    def __init__(
        self, handle: Callable[[logging.LogRecord], object], *, now: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__()
        self._handle = handle
        self._now = now
        self._buckets: dict[Kind, _TokenBucket] = {}
        self._lock = threading.RLock()  # as those of logging: collecting garbage may log in the midst of this

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether to log a record; before, log the number left out of each kind that may be logged again."""
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
            if not bucket.fill(now):
                bucket.leave_out(record)
                return False
            bucket.tokens -= 1
            return True

    def flush(self) -> None:
        """Log the numbers of lines left out so far."""
        self._report(lambda _: True)

    def _report(self, is_due: Callable[[_TokenBucket], bool]) -> None:
        with self._lock:
            due = [(kind, each) for kind, each in self._buckets.items() if each.left_out and is_due(each)]
            reports = [bucket.take_report(event) for (_, event, _), bucket in due]
        for report in reports:
            self._handle(report)


def about_of(record: logging.LogRecord) -> About | None:
    """Return the facts of a log call besides its text; None for those of other packages."""
    about = getattr(record, "about", None)
    return about if isinstance(about, About) else None
