"""UTC of a flight, derived from its messages."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np

from nedbus.client import Sample
from nedbus_msgs import ANY, Selection, is_unix_time, vehicle_name
from nedbus_msgs.arrays import MessageArray, to_array

from .arrays import Flight, missing_of
from .flight_files import matching, require_one_vehicle

_FIELDS: Final = ("time_utc_usec", "estimated_offset")  # UTC of a GNSS receiver, or offset to a companion's clock
_RELATIVE: Final = "timestamp_time_relative"  # us from the message's timestamp to the receiver's UTC
_TOLERANCE: Final = 1_000_000  # us; messages this close to the median agree
_AGREEING: Final = 0.9  # fraction that must agree; a smaller one indicates several boots or a clock step


@dataclass(frozen=True, slots=True)
class UtcOffset:
    """Offset from a vehicle's time since boot to Unix time [us], and its source.

    `source`: the stream, "boot_time_utc_us" of a log, or "timestamp" if timestamps are Unix time already, as uXRCE-DDS
    sends them once synchronized. The stream timesync_status is as accurate as the clock of the companion computer.
    `offset_us`: median over the messages of the source; a GNSS fix is a few tenths of a second older than its message.
    `count`: messages within one second of the median; `spread_us`: their maximum minus minimum.
    """

    source: str
    offset_us: int
    count: int
    spread_us: int

    def at(self, timestamp: int) -> datetime:
        """Return the UTC of a `timestamp` from the same boot of this vehicle; Unix time is used as it is."""
        return datetime.fromtimestamp(0, UTC) + timedelta(microseconds=int(self.unix_us(int(timestamp))))

    def unix_us(self, timestamps: Any) -> Any:
        """Return the Unix time [us] of a timestamp or an array of timestamps."""
        return timestamps + self.offset_us * ~np.asarray(is_unix_time(timestamps))


def utc_of(
    flight: str | Path | Mapping[str, MessageArray] | Iterable[Sample[Any]], *, vehicle: str | int = ANY
) -> UtcOffset | None:
    """Return the UTC offset of a .ulg log, an .mcap recording, arrays from `read`, or samples; None if it is unknown.

    For live samples: `utc = nedbus.utc_of(bus.latest("*", vehicle="7"))`, then `utc.at(sample.message.timestamp)` for
    any sample until the vehicle reboots.

    The source is a GNSS receiver with a `time_utc_usec` other than 0, a companion's clock in `timesync_status`, or a
    log's `boot_time_utc_us`, accepted only with a date from 2000 to 2100; Unix timestamps are used as they are.
    The offset is unknown if over 10 % of the messages are more than a second off their median.

    Raises AddressError for several vehicles unless `vehicle` names one, and the errors of `read`.
    """
    vehicle = vehicle_name(vehicle)
    if isinstance(flight, Mapping):
        return _find_utc(flight)
    if not isinstance(flight, str | Path):
        samples = [each for each in flight if vehicle in (ANY, each.vehicle)]
        require_one_vehicle("the samples", (each.address for each in samples), vehicle)
        return _find_utc({each.address.stream: to_array([each.message]) for each in samples})
    path = Path(flight).expanduser()
    with Flight(path) as opened:
        addresses = matching(path, opened.addresses, Selection(vehicle=vehicle))
        require_one_vehicle(path, addresses, vehicle)
        used = [each for each in addresses if not opened.definitions[each].types.keys().isdisjoint(_FIELDS)]
        streams = opened.read(used or addresses[:1])
        return _find_utc({address.stream: messages for address, (messages, _) in streams.items()}, opened.boot_utc)


def _find_utc(streams: Mapping[str, MessageArray], boot_utc: int = 0) -> UtcOffset | None:
    unix = sum(int(np.sum(is_unix_time(messages["timestamp"]))) for messages in streams.values())
    if unix > sum(map(len, streams.values())) / 2:
        return UtcOffset("timestamp", 0, unix, 0)
    for field in _FIELDS:
        for name, messages in sorted(streams.items()):
            names = set(messages.dtype.names or ()) - missing_of(messages)
            if field not in names:
                continue
            times, value = messages["timestamp"].astype(np.int64), messages[field].astype(np.int64)
            if field == "estimated_offset":
                utc = times - value
            else:
                utc = value - messages[_RELATIVE] if _RELATIVE in names else value
            offsets = (utc - times)[is_unix_time(utc) & ~is_unix_time(times)]
            middle = int(np.median(offsets)) if len(offsets) else 0
            near = offsets[np.abs(offsets - middle) <= _TOLERANCE]
            if len(near) and len(near) >= _AGREEING * len(offsets):
                return UtcOffset(name, middle, len(near), int(np.ptp(near)))
    return UtcOffset("boot_time_utc_us", boot_utc, 1, 0) if is_unix_time(boot_utc) else None
