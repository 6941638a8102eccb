"""Times as a person reads them: UTC where it is known, else seconds since boot; and durations."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Final

from .event import Event

_CLOCK: Final = re.compile(r"([01]?\d|2[0-3]):([0-5]\d)(?::([0-5]\d(?:\.\d+)?))?")
_LATEST: Final = 1e11  # s since the epoch, some thousand years
_UNIX: Final = 1e9  # s since boot beyond which PX4's time is Unix time, as some simulators have it


@dataclass(frozen=True, slots=True)
class Times:
    """The format of times: live, or by the offsets of the vehicles of a file.

    `is_live`: the account's clock is this host's, in seconds since the epoch.
    `offsets`: Unix time minus time since boot [s], by vehicle, where a message tells it.
    """

    is_live: bool = False
    offsets: Mapping[str, float] = field(default_factory=dict)

    def utc(self, event: Event) -> float | None:
        """Return the Unix time of an event [s], None if nothing tells it."""
        if self.is_live:
            return event.time
        if event.boot is None:
            return None
        utc = event.boot + (0.0 if event.boot > _UNIX else self.offsets.get(event.vehicle, math.nan))
        return utc if 0 <= utc < _LATEST else None  # a damaged time is neither

    def clock(self, event: Event) -> str:
        """Return the clock of a time: "host", "vehicle" for UTC from its messages, or "boot"."""
        return "host" if self.is_live else "boot" if self.utc(event) is None else "vehicle"

    def text(self, event: Event) -> str:
        """Return the time of an event, without the date."""
        utc = self.utc(event)
        if utc is None:
            return f"{event.time if event.boot is None else event.boot:.3f}"
        return to_clock(utc)

    def find(self, text: str, near: Event) -> float:
        """Return a moment by the account's clock, given as 14:05:12 (UTC) or in seconds since boot.

        `near`: an event of the vehicle that is meant, for the date. Raises ValueError for anything else.
        """
        if found := _CLOCK.fullmatch(text.strip()):
            utc = self.utc(near)
            if utc is None:
                raise ValueError("no message of this vehicle tells UTC")
            midnight = datetime.fromtimestamp(utc, UTC).replace(hour=0, minute=0, second=0, microsecond=0)
            since = timedelta(hours=int(found[1]), minutes=int(found[2]), seconds=float(found[3] or 0))
            step = ((midnight + since).timestamp() - utc + 43_200) % 86_400 - 43_200  # the nearest, also past midnight
            return near.time + step
        try:
            seconds = float(text)
        except ValueError:
            seconds = math.nan
        if not math.isfinite(seconds):
            raise ValueError("no time")
        if near.boot is None and self.is_live:
            raise ValueError("no message of this vehicle tells when it booted")
        return near.time + seconds - (near.time if near.boot is None else near.boot)


def to_clock(utc: float) -> str:
    """Return a Unix time as 14:05:12.3, in UTC."""
    tenths = round(utc * 10)
    return f"{datetime.fromtimestamp(tenths // 10, UTC):%H:%M:%S}.{tenths % 10}"


def to_age(seconds: float) -> str:
    """Return a duration in a suitable unit, as text."""
    if seconds < 1:
        return f"{max(0.0, seconds) * 1e3:.0f} ms"
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.0f} h"


def since_text(since: float | None, now: float) -> str:
    """Return the begin of a condition as a suffix for its text; "" where it is not known."""
    return "" if since is None else f", since {to_clock(since)} UTC ({to_age(now - since)})"
