"""The clock of a timestamp: time since PX4's boot, or Unix time, as once uXRCE-DDS is synchronized."""

from typing import Any, Final

YEAR_2000: Final = 946_684_800_000_000  # us; an earlier time is since boot
_YEAR_2100: Final = 4_102_444_800_000_000


def is_unix_time(timestamp_us: Any) -> Any:
    """Return whether a time [us], or each of an array, is Unix time: a date from 2000 to 2100."""
    return (timestamp_us >= YEAR_2000) & (timestamp_us < _YEAR_2100)
