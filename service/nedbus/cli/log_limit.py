"""How many lines of one kind are logged: no peer can fill a disk, whatever it sends, and what is left out is told."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from nedbus.log_event import EVENTS, About

from .format import MAX_TEXT

BURST: Final = 50
"""Lines of one kind that are logged at once."""

PER_MINUTE: Final = 6
"""Lines of one kind that are logged in each minute after that."""

_MAX_KINDS: Final = 1000  # that are told apart; nedbus itself has about 40
_LEFT_OUT: Final = "%d more lines like this one were left out: %s"

Kind = tuple[str, str | None, str]
"""A logger, an event, and the text before the values were put in."""

_OTHERS: Final[Kind] = ("", None, "")  # all kinds beyond the limit


@dataclass(frozen=True, slots=True)
class _Line:
    """What is kept of a record: its text, and nothing that a traceback or its values keep alive."""

    logger: str
    level: int
    text: str
    event: str | None


@dataclass(slots=True, eq=False)
class _Bucket:
    """How many lines of one kind may be logged now, and how many were not."""

    tokens: float
    filled: float
    left_out: int = 0


class RateLimit(logging.Filter):
    """Let a burst of each kind of record pass, then a few a minute.

    `handle` is the handler's: it gets a record that says how many were left out, as soon as one could be logged again.
    Records of events that are not limited pass always.
    """

    def __init__(
        self, handle: Callable[[logging.LogRecord], object], *, now: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__()
        self._handle = handle
        self._now = now
        self._buckets: dict[Kind, _Bucket] = {}
        self._silenced: dict[Kind, _Line] = {}  # the first line of each kind that was left out
        self._lock = threading.RLock()  # as those of logging: collecting garbage may log in the midst of this

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether to log a record; before, log how many of any kind were left out."""
        with self._lock:
            now = self._now()
            reports = [self._report(kind) for kind in list(self._silenced) if self._fill(self._buckets[kind], now) >= 1]
            passes = not is_limited(record) or self._take(record, now)
        for report in reports:
            self._handle(report)
        return passes

    def flush(self) -> None:
        """Log how many were left out so far."""
        with self._lock:
            reports = [self._report(kind) for kind in list(self._silenced)]
        for report in reports:
            self._handle(report)

    def _take(self, record: logging.LogRecord, now: float) -> bool:
        """Return whether one more of this kind may be logged."""
        kind = record.name, event_of(record), str(record.msg)
        if kind not in self._buckets and len(self._buckets) >= _MAX_KINDS:
            kind = _OTHERS
        bucket = self._buckets.setdefault(kind, _Bucket(BURST, now))
        if self._fill(bucket, now) >= 1:
            bucket.tokens -= 1
            return True
        if not bucket.left_out:
            self._silenced[kind] = _Line(record.name, record.levelno, record.getMessage()[:MAX_TEXT], event_of(record))
        bucket.left_out += 1
        return False

    @staticmethod
    def _fill(bucket: _Bucket, now: float) -> float:
        bucket.tokens = min(BURST, bucket.tokens + (now - bucket.filled) * PER_MINUTE / 60)
        bucket.filled = now
        return bucket.tokens

    def _report(self, kind: Kind) -> logging.LogRecord:
        """Return a record that says how many of this kind were left out; they are not counted any more."""
        first, bucket = self._silenced.pop(kind), self._buckets[kind]
        count, bucket.left_out = bucket.left_out, 0
        return logging.makeLogRecord(
            {
                "name": first.logger,
                "levelno": first.level,
                "levelname": logging.getLevelName(first.level),
                "msg": _LEFT_OUT,
                "args": (count, first.text),
                "about": About("left-out", count=count, of=first.event),
            }
        )


def about_of(record: logging.LogRecord) -> About | None:
    """Return what a log call says besides its text; None for those of other packages."""
    about = getattr(record, "about", None)
    return about if isinstance(about, About) else None


def event_of(record: logging.LogRecord) -> str | None:
    """Return the event of a record."""
    about = about_of(record)
    return about.event if about else None


def is_limited(record: logging.LogRecord) -> bool:
    """Return whether lines of this kind may be left out."""
    event = EVENTS.get(event_of(record) or "")
    return event is None or event.limited
