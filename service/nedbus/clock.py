"""Clocks of this host, times and durations as text: monotonic time for all decisions, Unix time for timestamps.

NTP, a GNSS receiver or a user may step the Unix clock forward or back at any time.
"""

import time
from datetime import UTC, datetime
from typing import Final

_START: Final = time.time() - time.monotonic()

utc_ns = time.time_ns
"""Unix time of the host's clock [ns]; an alias, not a wrapper, because it is called for every sample."""


def steady() -> float:
    """Return a monotonic time [s] that starts at the host's Unix time when this process starts."""
    return _START + time.monotonic()


def utc() -> float:
    """Return the Unix time of the host's clock [s]."""
    return utc_ns() / 1e9


def now() -> datetime:
    """Return the UTC date and time of the host's clock."""
    return datetime.fromtimestamp(utc(), UTC)


def to_utc() -> float:
    """Return the offset from `steady` to Unix time [s], rounded to ms."""
    return round(utc() - steady(), 3)


def format_duration(seconds: float) -> str:
    """Format a duration [s] in ms, s, min or h."""
    if seconds < 1:
        return f"{max(0.0, seconds) * 1e3:.0f} ms"
    if seconds < 120:
        return f"{seconds:.1f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.0f} h"


def format_utc(utc: float) -> str:
    """Format a Unix time as UTC, such as 14:05:12.3."""
    tenths = round(utc * 10)
    return f"{datetime.fromtimestamp(tenths // 10, UTC):%H:%M:%S}.{tenths % 10}"


def format_since(since: float | None, now: float) -> str:
    """Format the start of a condition as a suffix for its text; "" if unknown."""
    if since is None:
        return ""
    return f", since {format_utc(since)} UTC ({format_duration(now - since)})"
