"""The clocks of this host: a steady one that all decisions use, and the settable one, which only labels.

NTP, a GNSS receiver or a person may set the host's clock at any time, forth or back.
"""

import time
from datetime import UTC, datetime
from typing import Final

_START: Final = time.time() - time.monotonic()

utc_ns = time.time_ns
"""Return the Unix time by the host's clock [ns]; not a function of ours, as each sample calls it."""


def steady() -> float:
    """Return a monotonic time [s] that equals the host's Unix time when this process starts."""
    return _START + time.monotonic()


def utc() -> float:
    """Return the Unix time by the host's clock [s]."""
    return utc_ns() / 1e9


def now() -> datetime:
    """Return the UTC date and time by the host's clock."""
    return datetime.fromtimestamp(utc(), UTC)


def to_utc() -> float:
    """Return what to add to a steady time to label it with the Unix time [s], in ms."""
    return round(utc() - steady(), 3)
