"""UTC of a flight, derived from its messages."""

from __future__ import annotations

import logging
from array import array
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from nedbus.errors import InvalidMessageError
from nedbus.log_event import about
from nedbus.samples import Sample
from nedbus_msgs import ANY, DEFAULT_TOPIC, TOPICS, Address, FieldReader, Selection, is_unix_time, vehicle_name

from .readers import FlightReader, open_reader
from .selection import matching, require_one_vehicle

if TYPE_CHECKING:
    from nedbus_msgs.arrays import MessageArray

    from .corrections import Agreement

_log = logging.getLogger(__name__)
_MAX_TIME: Final = 2**62  # us; a damaged timestamp may be larger

FIELDS: Final = ("time_utc_usec", "estimated_offset")
"""The fields that provide UTC: that of a GNSS receiver, or the offset to a companion's clock."""

RELATIVE: Final = "timestamp_time_relative"
"""The field with the time from the message's timestamp to the receiver's UTC [us]."""

_READ: Final = FieldReader(("timestamp", *FIELDS, RELATIVE))


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
        return datetime.fromtimestamp(0, UTC) + timedelta(microseconds=int(self.unix_us(int(timestamp))))

    def unix_us(self, timestamps: Any) -> Any:
        """Return the Unix time [us] of a timestamp or an array of timestamps."""
        return timestamps + self.offset_us * (1 - is_unix_time(timestamps))


class UtcEstimate:
    """Estimate of the offset of one vehicle from its messages; it keeps up to 24 bytes of each message."""

    def __init__(self) -> None:
        self._stamps: defaultdict[tuple[bool, str], array[int]] = defaultdict(lambda: array("q"))
        """Timestamps of each stream [us], of those with UTC first."""
        self._sources: defaultdict[tuple[int, str], tuple[array[int], array[int]]] = defaultdict(
            lambda: (array("q"), array("q"))
        )
        """Timestamps and offsets of the messages with UTC [us], by the index of the field in FIELDS and stream."""

    def add(self, stream: str, timestamp: int, values: Mapping[str, int | None], relative: int | None) -> None:
        """Add a message: its fields that provide UTC, and the time from its timestamp to that UTC, if it has one."""
        timestamp = min(timestamp, _MAX_TIME)
        self._stamps[not values, stream].append(timestamp)
        for name, value in values.items():
            if value is None:
                continue
            utc = timestamp - value if name == FIELDS[1] else value - (relative or 0)
            if is_unix_time(utc) and not is_unix_time(timestamp):
                times, offsets = self._sources[FIELDS.index(name), stream]
                times.append(timestamp)
                offsets.append(utc - timestamp)

    def add_array(self, stream: str, messages: MessageArray) -> None:
        """Add a structured array from `read`, as `add` does."""
        metadata: Mapping[str, Any] = messages.dtype.metadata or {}
        names = set(messages.dtype.names or ()).difference(metadata.get("missing", ()))
        known = [name for name in FIELDS if name in names]
        stamps = messages["timestamp"].clip(0, _MAX_TIME).astype("i8")
        self._stamps[not known, stream].frombytes(stamps.tobytes())
        for name in known:
            values = messages[name].clip(max=_MAX_TIME).astype("i8")
            utc = stamps - values if name == FIELDS[1] else values - (messages[RELATIVE] if RELATIVE in names else 0)
            is_used = is_unix_time(utc) & ~is_unix_time(stamps)
            if is_used.any():
                times, offsets = self._sources[FIELDS.index(name), stream]
                times.frombytes(stamps[is_used].tobytes())
                offsets.frombytes((utc - stamps)[is_used].tobytes())

    def result(self, boot_utc: int = 0) -> UtcOffset | str:
        """Return the offset, or why it is unknown, "" without UTC; `boot_utc`: of the file's metadata [us]."""
        with_utc = [stamps for (is_other, _), stamps in self._stamps.items() if not is_other]
        found = {stream: stamps for (is_other, stream), stamps in sorted(self._stamps.items()) if is_other}
        positions = [stamps for stream, stamps in found.items() if stream == DEFAULT_TOPIC]
        others = positions or [*found.values()]
        used = [*with_utc, *others] if with_utc else [*found.values()][:1]
        unix = sum(sum(map(is_unix_time, stamps)) for stamps in used)
        if unix > sum(map(len, used)) / 2:
            return UtcOffset("timestamp", 0, unix, 0)
        agreement: Agreement | str = ""
        if self._sources:
            from .corrections import find_agreement

            agreement = find_agreement({stream: each for (_, stream), each in sorted(self._sources.items())}, others)
        if not isinstance(agreement, str):
            return UtcOffset(*agreement)
        return UtcOffset("boot_time_utc_us", boot_utc, 1, 0) if is_unix_time(boot_utc) else agreement


def utc_of(
    flight: str | Path | Mapping[str, MessageArray] | Iterable[Sample[Any]], *, vehicle: str | int = ANY
) -> UtcOffset | None:
    """Return the UTC offset of a log or recording, arrays from `read`, or samples; None if it is unknown.

    For live samples: `utc = nedbus.utc_of(bus.latest("*", vehicle="7"))`, then `utc.at(sample.message.timestamp)` for
    any sample until the vehicle reboots.

    The source is a GNSS receiver with a `time_utc_usec` other than 0, a companion's clock in `timesync_status`, or a
    log's `boot_time_utc_us`, accepted only with a date from 2000 to 2100; Unix timestamps are used as they are.
    A receiver may correct its UTC in flight, at most twice and by up to 20 s; the last part then holds for all. Else
    the offset is unknown, and the reason is logged, if over 10 % of the messages are more than a second off their
    median. A source whose timestamps do not overlap those of the other messages is not used.

    Raises AddressError for several vehicles unless `vehicle` names one, and the errors of `read`.
    """
    found = find_utc(flight, vehicle=vehicle)
    if isinstance(found, UtcOffset):
        return found
    if found:
        _log.warning("UTC is unknown: %s", found, extra=about("incomplete"))
    return None


def find_utc(
    flight: str | Path | Mapping[str, MessageArray] | Iterable[Sample[Any]], *, vehicle: str | int = ANY
) -> UtcOffset | str:
    """Return what `utc_of` returns, or why it is unknown, "" if no message contains UTC."""
    vehicle, estimate = vehicle_name(vehicle), UtcEstimate()
    if isinstance(flight, Mapping):
        for name, messages in flight.items():
            estimate.add_array(name, messages)
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
        if address.topic not in TOPICS or record.error or record.stream.check(record.payload):
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


def _add(estimate: UtcEstimate, address: Address, message: object, missing: frozenset[str]) -> None:
    timestamp, *values, relative = _READ(message)
    known = {
        name: value for name, value in zip(FIELDS, values, strict=True) if value is not None and name not in missing
    }
    estimate.add(address.stream, timestamp, known, None if RELATIVE in missing else relative)
