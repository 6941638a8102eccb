"""UTC of a flight, derived from its messages."""

from array import array
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from statistics import median
from typing import Any, Final

from nedbus.errors import InvalidMessageError
from nedbus.samples import Sample
from nedbus_msgs import ANY, Address, FieldReader, Selection, is_unix_time, vehicle_name

from .readers import FlightReader, open_reader
from .selection import matching, require_one_vehicle

FIELDS: Final = ("time_utc_usec", "estimated_offset")
"""The fields that provide UTC: that of a GNSS receiver, or the offset to a companion's clock."""

RELATIVE: Final = "timestamp_time_relative"
"""The field with the time from the message's timestamp to the receiver's UTC [us]."""

_TOLERANCE: Final = 1_000_000  # us; messages this close to the median agree
_AGREEING: Final = 0.9  # fraction that must agree; a smaller one indicates several boots or a clock step
_READ: Final = FieldReader(("timestamp", *FIELDS, RELATIVE))


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
        return timestamps + self.offset_us * (1 - is_unix_time(timestamps))


class UtcEstimate:
    """Estimate of the offset of one vehicle from its messages.

    Of each message that provides UTC, 8 bytes are kept, and of the others their number.
    """

    def __init__(self) -> None:
        self._offsets: defaultdict[tuple[str, str], array[int]] = defaultdict(
            lambda: array("q")
        )  # by field and stream [us]
        self._stamped = defaultdict[tuple[bool, str], Counter[bool]](Counter)  # by stream: Unix times, and others

    def add(self, stream: str, timestamp: int, values: Mapping[str, int | None], relative: int | None) -> None:
        """Add a message: its fields that provide UTC, and the time from its timestamp to that UTC, if it has one."""
        unix = bool(is_unix_time(timestamp))
        self._stamped[not values, stream][unix] += 1
        for name, value in values.items():
            if value is None:
                continue
            utc = timestamp - value if name == FIELDS[1] else value - (relative or 0)
            if is_unix_time(utc) and not unix:
                self._offsets[name, stream].append(utc - timestamp)

    def result(self, boot_utc: int = 0) -> UtcOffset | None:
        """Return the offset, None if it is unknown; `boot_utc`: Unix time of the boot in the file's metadata [us]."""
        streams = [key for key in self._stamped if not key[0]] or sorted(self._stamped)[:1]
        counts = sum((self._stamped[key] for key in streams), Counter[bool]())
        if counts[True] > counts.total() / 2:
            return UtcOffset("timestamp", 0, counts[True], 0)
        for field, stream in sorted(self._offsets, key=lambda key: (FIELDS.index(key[0]), key[1])):
            offsets = self._offsets[field, stream]
            middle = int(median(offsets))
            near = [each for each in offsets if abs(each - middle) <= _TOLERANCE]
            if near and len(near) >= _AGREEING * len(offsets):
                return UtcOffset(stream, middle, len(near), max(near) - min(near))
        return UtcOffset("boot_time_utc_us", boot_utc, 1, 0) if is_unix_time(boot_utc) else None


def utc_of(
    flight: str | Path | Mapping[str, Any] | Iterable[Sample[Any]], *, vehicle: str | int = ANY
) -> UtcOffset | None:
    """Return the UTC offset of a log or recording, arrays from `read`, or samples; None if it is unknown.

    For live samples: `utc = nedbus.utc_of(bus.latest("*", vehicle="7"))`, then `utc.at(sample.message.timestamp)` for
    any sample until the vehicle reboots.

    The source is a GNSS receiver with a `time_utc_usec` other than 0, a companion's clock in `timesync_status`, or a
    log's `boot_time_utc_us`, accepted only with a date from 2000 to 2100; Unix timestamps are used as they are.
    The offset is unknown if over 10 % of the messages are more than a second off their median.

    Raises AddressError for several vehicles unless `vehicle` names one, and the errors of `read`.
    """
    vehicle, estimate = vehicle_name(vehicle), UtcEstimate()
    if isinstance(flight, Mapping):
        for name, messages in flight.items():
            add_array(estimate, name, messages)
        return estimate.result()
    if not isinstance(flight, str | Path):
        samples = [each for each in flight if vehicle in (ANY, each.vehicle)]
        require_one_vehicle("the samples", (each.address for each in samples), vehicle)
        for sample in samples:
            _add(estimate, sample.address, sample.message, sample.missing)
        return estimate.result()
    path = Path(flight).expanduser()
    with open_reader(path) as reader:
        estimates = estimate_utc(reader)
        addresses = matching(path, sorted(reader.definitions), Selection(vehicle=vehicle))
        require_one_vehicle(path, addresses, vehicle)
        return estimates[addresses[0].vehicle].result(reader.boot_utc)


def estimate_utc(reader: FlightReader) -> dict[str, UtcEstimate]:
    """Read a file; return the estimate of each vehicle."""
    found = defaultdict[str, UtcEstimate](UtcEstimate)
    for record in reader.records():
        address, definition = record.stream.address, record.stream.definition
        if record.error or record.stream.check(record.payload):
            continue
        if definition.types.keys().isdisjoint(FIELDS):
            found[address.vehicle].add(address.stream, record.stream.timestamp(record.payload)[0] or 0, {}, None)
            continue
        try:
            encoded = reader.message_of(record).encode()
        except InvalidMessageError:
            continue
        _add(found[address.vehicle], address, encoded.row, encoded.missing)
    for address in reader.definitions:
        found[address.vehicle]
    return found


def add_array(estimate: UtcEstimate, stream: str, messages: Any) -> None:
    """Add a structured array from `read`."""
    names = set(messages.dtype.names or ()).difference((messages.dtype.metadata or {}).get("missing", ()))
    used = [name for name in ("timestamp", *FIELDS, RELATIVE) if name in names]
    known = [name for name in FIELDS if name in names]
    for values in zip(*(messages[name].tolist() for name in used), strict=True):
        row = dict(zip(used, values, strict=True))
        estimate.add(stream, row["timestamp"], {name: row[name] for name in known}, row.get(RELATIVE))


def _add(estimate: UtcEstimate, address: Address, message: object, missing: frozenset[str]) -> None:
    timestamp, *values, relative = _READ(message)
    known = {
        name: value for name, value in zip(FIELDS, values, strict=True) if value is not None and name not in missing
    }
    estimate.add(address.stream, timestamp, known, None if RELATIVE in missing else relative)
