"""UTC of a flight, as its own messages tell it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final

import numpy as np

from nedbus_msgs.arrays import MessageArray

TELLING: Final = ("time_utc_usec", "estimated_offset")
"""The fields that tell it, the better one first: a GNSS receiver's UTC, and the offset to a companion's clock."""

_RELATIVE: Final = "timestamp_time_relative"  # us, of a receiver's UTC after its timestamp
_PLAUSIBLE: Final = (946_684_800_000_000, 4_102_444_800_000_000)  # us: 2000 to 2100; other clocks have no date
_TOLERANCE: Final = 1_000_000  # us from the median to what still agrees with it
_AGREEING: Final = 0.9  # of the messages; fewer are several boots, or a clock that was set


@dataclass(frozen=True, slots=True)
class UtcOffset:
    """Unix time minus the vehicle's `timestamp` [us], and its source.

    `source`: the stream that tells it. With timesync_status it is the clock of a companion, as good as that one is.
    `offset_us`: the median of its messages. A GNSS fix is some tenths of a second older than its message.
    `count`: the messages that agree to a second; `spread_us`: from the least to the greatest of these.
    """

    source: str
    offset_us: int
    count: int
    spread_us: int

    def at(self, timestamp: int) -> datetime:
        """Return the UTC of a `timestamp` of this vehicle, since the same boot."""
        return datetime.fromtimestamp(0, UTC) + timedelta(microseconds=int(timestamp) + self.offset_us)


def tell_utc(streams: Mapping[str, MessageArray]) -> UtcOffset | None:
    """Return the offset that the best of these streams tells, None if none does."""
    for field in TELLING:
        for name, messages in sorted(streams.items()):
            metadata: Mapping[str, Any] = messages.dtype.metadata or {}
            if field not in (messages.dtype.names or ()) or field in metadata.get("missing", ()):
                continue
            times, value = messages["timestamp"].astype(np.int64), messages[field].astype(np.int64)
            utc = value if field == TELLING[0] else times - value
            if field == TELLING[0] and _RELATIVE in (messages.dtype.names or ()):
                utc = value - messages[_RELATIVE]
            offsets = (utc - times)[(utc >= _PLAUSIBLE[0]) & (utc < _PLAUSIBLE[1])]
            middle = int(np.median(offsets)) if len(offsets) else 0
            near = offsets[np.abs(offsets - middle) <= _TOLERANCE]
            if len(near) and len(near) >= _AGREEING * len(offsets):
                return UtcOffset(name, middle, len(near), int(np.ptp(near)))
    return None
