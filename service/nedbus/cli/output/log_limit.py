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

_MAX_KINDS: Final = 1000  # that are told apart; nedbus itself has about 40
_LEFT_OUT: Final = "%d more lines like this one were left out: %s"

Kind = tuple[str, str | None, str]
"""A logger, an event, and the text before the values were put in."""

_OTHERS: Final[Kind] = ("", None, "")  # all kinds beyond the limit


@dataclass(slots=True, eq=False)
class _TokenBucket:
    """The number of lines of one kind that may be logged now, the number left out, and what is kept of the first."""

    filled: float
    tokens: float = BURST
    left_out: int = 0
    first: Mapping[str, object] = field(default_factory=dict)  # no record: it may keep a traceback alive
    first_text: str = ""
    event: str | None = None

    def fill(self, now: float) -> bool:
        """Add the tokens of the time since the last call; return whether there is one."""
        self.tokens = min(BURST, self.tokens + (now - self.filled) * PER_MINUTE / 60)
        self.filled = now
        return self.tokens >= 1

    def leave_out(self, record: logging.LogRecord) -> None:
        """Count a line that is not logged."""
        if not self.left_out:
            self.first = {"name": record.name, "levelno": record.levelno, "levelname": record.levelname}
            self.first_text, self.event = record.getMessage()[:MAX_TEXT], _event_of(record)
        self.left_out += 1

    def take_report(self) -> logging.LogRecord:
        """Return a record with the number of lines that were left out; they count no more."""
        count, self.left_out = self.left_out, 0
        about = About("left-out", count=count, of=self.event)
        return logging.makeLogRecord({**self.first, "msg": _LEFT_OUT, "args": (count, self.first_text), "about": about})


class RateLimit(logging.Filter):
    """Let a burst of each kind of record pass, then a few a minute.

    `handle` is the handler's: it gets a record with the number of lines left out, as soon as one could be logged again.
    Records of events that are not limited pass always.
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
        with self._lock:
            now = self._now()
            reports = [each.take_report() for each in self._buckets.values() if each.left_out and each.fill(now)]
            passes = not _is_limited(record) or self._take_token(record, now)
        for report in reports:
            self._handle(report)
        return passes

    def flush(self) -> None:
        """Log the numbers of lines left out so far."""
        with self._lock:
            reports = [each.take_report() for each in self._buckets.values() if each.left_out]
        for report in reports:
            self._handle(report)

    def _take_token(self, record: logging.LogRecord, now: float) -> bool:
        kind = record.name, _event_of(record), str(record.msg)
        if kind not in self._buckets and len(self._buckets) >= _MAX_KINDS:
            kind = _OTHERS
        bucket = self._buckets.setdefault(kind, _TokenBucket(now))
        if not bucket.fill(now):
            bucket.leave_out(record)
            return False
        bucket.tokens -= 1
        return True


def about_of(record: logging.LogRecord) -> About | None:
    """Return what a log call says besides its text; None for those of other packages."""
    about = getattr(record, "about", None)
    return about if isinstance(about, About) else None


def _event_of(record: logging.LogRecord) -> str | None:
    about = about_of(record)
    return about.event if about else None


def _is_limited(record: logging.LogRecord) -> bool:
    event = EVENTS.get(_event_of(record) or "")
    return event is None or event.limited
