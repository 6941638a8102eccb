"""UTC of a flight, derived from its messages."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from nedbus.log_event import about
from nedbus.samples import Sample
from nedbus.timeline import UTC_COLUMNS, UtcOffset, provides_utc
from nedbus_msgs import ANY, TOPICS, Address, Definition, FieldReader, Selection, vehicle_name

from .readers import FileStream, FlightReader, Record, Run, open_reader
from .selection import matching, require_one_vehicle

if TYPE_CHECKING:
    from nedbus_msgs.arrays import MessageArray

    from .columns import Columns

_log = logging.getLogger(__name__)
_BATCH: Final = 4096  # messages of a stream with UTC that are decoded at once

_READ: Final = FieldReader(UTC_COLUMNS)


def utc_of(
    flight: str | Path | Mapping[str, MessageArray] | Iterable[Sample[Any]],
    *,
    vehicle: str | int = ANY,
) -> UtcOffset | None:
    """Return the UTC offset of a log or recording, arrays from `read`, or samples; None if it is unknown.

    For live samples: `utc = nedbus.utc_of(bus.latest("*", vehicle="7"))`, then `utc.at(sample.message.timestamp)` for
    any sample until the vehicle reboots.

    The source is a GNSS receiver with a `time_utc_usec` other than 0, a companion's clock in `timesync_status`, or a
    log's `boot_time_utc_us`, accepted only with a date from 2009-02-13, as in PX4, to 2100. Unix timestamps are used as
    they are.
    A receiver may correct its UTC in flight, at most twice and by up to 20 s; the last part then holds for all. Else
    the offset is unknown, and the reason is logged, if over 10 % of the messages are more than a second off their
    median. A source whose timestamps do not overlap those of the other messages is not used.

    Raises AddressError for several vehicles unless `vehicle` names one, and the errors of `read`.
    """
    utc = find_utc(flight, vehicle=vehicle)
    if isinstance(utc, UtcOffset):
        return utc
    if utc:
        _log.warning("UTC is unknown: %s", utc, extra=about("incomplete"))
    return None


def find_utc(
    flight: str | Path | Mapping[str, MessageArray] | Iterable[Sample[Any]],
    *,
    vehicle: str | int = ANY,
) -> UtcOffset | str:
    """Return what `utc_of` returns, or why it is unknown, "" if no message contains UTC."""
    vehicle = vehicle_name(vehicle)
    if isinstance(flight, Mapping):
        return _utc_of_arrays(flight)
    if not isinstance(flight, str | Path):
        return _utc_of_samples(flight, vehicle)
    path = Path(flight).expanduser()
    selection = Selection(vehicle=vehicle)
    with open_reader(path) as reader:
        offsets = read_utc(reader)
        addresses = sorted(reader.definitions)
    selected = matching(path, addresses, selection)
    require_one_vehicle(path, selected, vehicle)
    return offsets[selected[0].vehicle]


def _utc_of_arrays(flight: Mapping[str, MessageArray]) -> UtcOffset | str:
    from nedbus.timeline import UtcEstimate

    estimate = UtcEstimate()
    for stream, messages in flight.items():
        metadata: Mapping[str, Any] = messages.dtype.metadata or {}
        missing = metadata.get("missing", ())
        columns = {}
        for name in messages.dtype.names or ():
            if name in UTC_COLUMNS and name not in missing:
                columns[name] = messages[name]
        estimate.add(stream, columns)
    return estimate.result()


def _utc_of_samples(samples: Iterable[Sample[Any]], vehicle: str) -> UtcOffset | str:
    from nedbus.timeline import UtcEstimate

    estimate = UtcEstimate()
    selected = [sample for sample in samples if vehicle in (ANY, sample.vehicle)]
    addresses = [sample.address for sample in selected]
    require_one_vehicle("the samples", addresses, vehicle)
    for sample in selected:
        columns = {}
        values = _READ(sample.message)
        for name, value in zip(UTC_COLUMNS, values, strict=True):
            if value is not None and name not in sample.missing:
                columns[name] = [value]
        estimate.add(sample.address.stream, columns)
    return estimate.result()


def read_utc(reader: FlightReader) -> dict[str, UtcOffset | str]:
    """Read a file; return the UTC offset of each vehicle, or why it is unknown."""
    utc = FileUtc()
    for run in reader.runs():
        utc.add(run.stream, run.payloads)
    return utc.results(reader)


def utc_of_columns(
    columns: Mapping[Address, Columns], reader: FlightReader
) -> dict[str, UtcOffset | str]:
    """Return the UTC offset of each vehicle of a file from columns that were read, or why it is unknown."""
    from nedbus.timeline import UtcEstimate

    estimates = {address.vehicle: UtcEstimate() for address in reader.definitions}
    for address in sorted(columns):
        definition = reader.definitions[address]
        decoded = columns[address].decode(definition)
        estimate = estimates[address.vehicle]
        estimate.add(address.stream, decoded.utc_columns())
    results = {}
    for vehicle, estimate in estimates.items():
        results[vehicle] = estimate.result(reader.boot_utc)
    return results


class FileUtc:
    """The UTC of the vehicles of a file, from its records."""

    def __init__(self) -> None:
        from nedbus.timeline import UtcEstimate

        self._estimates = defaultdict[str, UtcEstimate](UtcEstimate)
        self._columns: dict[Address, Columns] = {}  # messages with UTC, not yet in the estimate
        # of records that `watch` has seen
        self._payloads = defaultdict[FileStream, list[Any]](list)

    def watch(self, records: Iterable[Record]) -> Iterator[Record]:
        """Yield records on their way to another reader, and add them."""
        payloads = self._payloads
        for record in records:
            own = payloads[record.stream]
            own.append(record.payload)
            if len(own) >= _BATCH:
                self.add(record.stream, own)
                own.clear()
            yield record

    def add(self, stream: FileStream, payloads: list[Any]) -> None:
        """Add the payloads of a stream."""
        from .columns import Columns

        address = stream.address
        if address.topic not in TOPICS:
            return
        if not provides_utc(stream.definition):
            intact = [payload for payload in payloads if not stream.check(payload)]
            stamps = [stream.timestamp(payload)[0] or 0 for payload in intact]
            estimate = self._estimates[address.vehicle]
            estimate.add(address.stream, {"timestamp": stamps})
            return
        columns = self._columns.setdefault(address, Columns())
        columns.add(Run(stream, payloads, []))
        if len(columns) >= _BATCH:
            del self._columns[address]
            self._add_columns(address, columns, stream.definition)

    def results(self, reader: FlightReader) -> dict[str, UtcOffset | str]:
        """Return the UTC offset of each vehicle, or why it is unknown, at the end of a file."""
        for stream, payloads in self._payloads.items():
            self.add(stream, payloads)
        self._payloads.clear()
        for address, columns in self._columns.items():
            self._add_columns(address, columns, reader.definitions[address])
        self._columns.clear()
        vehicles = {address.vehicle for address in reader.definitions}
        results = {}
        for vehicle in vehicles:
            estimate = self._estimates[vehicle]
            results[vehicle] = estimate.result(reader.boot_utc)
        return results

    def _add_columns(self, address: Address, columns: Columns, definition: Definition[Any]) -> None:
        decoded = columns.decode(definition)
        estimate = self._estimates[address.vehicle]
        estimate.add(address.stream, decoded.utc_columns())
