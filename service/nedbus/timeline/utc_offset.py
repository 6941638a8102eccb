"""Offset from time since boot to UTC, and the fields from which it is derived."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from nedbus_msgs import Definition, is_unix_time

FIELDS: Final = ("time_utc_usec", "estimated_offset")
"""The fields that provide UTC: that of a GNSS receiver, or the offset to a companion's clock."""

RELATIVE: Final = "timestamp_time_relative"
"""The field with the time from the message's timestamp to the receiver's UTC [us]."""

UTC_COLUMNS: Final = ("timestamp", *FIELDS, RELATIVE)
"""The fields from which UTC is derived."""


@dataclass(frozen=True, slots=True)
class UtcOffset:
    """Offset from a vehicle's time since boot to Unix time [us], and its source.

    `source`: the stream, "boot_time_utc_us" of a log, or "timestamp" if timestamps are Unix time already, as uXRCE-DDS
    sends them once synchronized. The stream timesync_status is as accurate as the clock of the companion computer.
    `offset_us`: median over the messages of the source; a GNSS fix is a few tenths of a second older than its message.
    `count`: messages within one second of the median; `spread_us`: their maximum minus minimum.
    `corrected_us`: by how much the source corrected its time in flight, as a receiver does that has downloaded the leap
    seconds; the offset after the last correction holds for all messages.
    """

    source: str
    offset_us: int
    count: int
    spread_us: int
    corrected_us: int = 0

    def at(self, timestamp: int) -> datetime:
        """Return the UTC of a `timestamp` from the same boot of this vehicle; Unix time is used as it is."""
        unix = int(self.unix_us(int(timestamp)))
        return datetime.fromtimestamp(0, UTC) + timedelta(microseconds=unix)

    def unix_us(self, timestamps: Any) -> Any:
        """Return the Unix time [us] of a timestamp or an array of timestamps."""
        is_since_boot = 1 - is_unix_time(timestamps)  # also of an array
        return timestamps + self.offset_us * is_since_boot


def to_unix_ns(time: int, boot_utc: int) -> int:
    """Return a time of a file [us], Unix time or since the boot at `boot_utc` (0 if unknown), in nanoseconds."""
    if is_unix_time(time):
        return 1000 * time
    return 1000 * (time + boot_utc)


def unix_seconds(time: float, offset: float | None) -> float | None:
    """Return a vehicle's time [s], Unix time or since boot, as Unix time; None if unknown.

    `offset`: Unix time minus time since boot [s], None if unknown.
    """
    if is_unix_time(time * 1e6):
        return time
    if offset is None:
        return None
    unix = time + offset
    if is_unix_time(unix * 1e6):
        return unix
    return None


def utc_text(times: Sequence[float]) -> str:
    """Return times [s] as UTC if they are Unix times, else as seconds: "3.0 to 4.5 s"."""
    first, last = times
    if not is_unix_time(first * 1e6):
        return f"{first:.1f} to {last:.1f} s"
    begin = datetime.fromtimestamp(first, UTC)
    end = datetime.fromtimestamp(last, UTC)
    return f"{begin:%Y-%m-%d %H:%M:%S} to {end:%H:%M:%S} UTC"


def provides_utc(definition: Definition[Any]) -> bool:
    """Return whether messages of a definition may provide UTC."""
    return not definition.types.keys().isdisjoint(FIELDS)
