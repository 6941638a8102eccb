"""A flight open for reading: `nedbus.open` and the samples of one or more files."""

from __future__ import annotations

import math
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import cached_property, lru_cache
from itertools import islice
from numbers import Real
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, Self, TypedDict, Unpack, overload
from weakref import WeakSet

from nedbus import limits
from nedbus.errors import ArgumentError, ClosedError, InvalidMessageError, SourceError
from nedbus.samples import M_co, Sample, SourceMessage
from nedbus.timeline import UtcOffset, provides_utc, to_unix_ns
from nedbus_msgs import (
    ANY,
    BY_TOPIC,
    Address,
    Definition,
    Encoded,
    Message,
    Provenance,
    Selection,
    VehicleLocalPosition,
    VehicleNames,
    codec_of,
    topic_of,
    vehicle_name,
)

from .merge import Names, distinct_names, merge_messages, no_utc, renamed, require_files
from .readers import FileStream, FlightReader, ReadOptions, open_reader
from .selection import matching
from .utc import FileUtc, read_utc, utc_of_columns

if TYPE_CHECKING:
    from nedbus.samples import Batch

    from .columns import Columns

_BUILT_IN: Final = ReadOptions()


class FlightMessage(NamedTuple):
    """A valid message of a flight; `received`: its log time [ns]."""

    address: Address
    definition: Definition[Any]
    encoded: Encoded
    received: int
    provenance: Provenance


class Select(TypedDict, total=False):
    """Options of the call of a flight."""

    vehicle: VehicleNames
    instance: int | None
    start: float | datetime
    end: float | datetime | None
    rows: bool


def open_flight(
    path: str | Path | Sequence[str | Path], *, vehicle: str | int = ANY, layout: str | None = None
) -> Flight:
    """Open a .ulg log, an .mcap recording or bag, or a .tlog, or several of them, and return its samples on request.

    with nedbus.open("flight.ulg") as flight:
        for sample in flight(nedbus.VehicleLocalPosition, start=60.0):
            print(sample.message.position)

    Several files are merged by UTC; a vehicle that is in several files is named after its file.
    `vehicle`: only this vehicle. `layout`: the PX4 release, such as "1.15", whose layouts a recording has, if its
    definitions are those of another release, because the px4_msgs of vehicle and recorder differed.

    Raises SourceError if a file cannot be read, ConfigError if it is not a flight file, or if the package that reads
    it is not installed, ArgumentError without files.
    """
    paths = [path] if isinstance(path, str | Path) else path
    options = ReadOptions(topics=None, layout=layout)
    expanded = [Path(path).expanduser() for path in paths]
    flight = Flight(expanded, options, vehicle=vehicle_name(vehicle))
    flight._begin(watches_utc=True)
    return flight


def open_messages(paths: Sequence[Path], options: ReadOptions = _BUILT_IN) -> Flight:
    """Open files for one pass over their messages; raise the errors of `nedbus.open`."""
    flight = Flight(paths, options)
    flight._begin()
    return flight


class Extent(NamedTuple):
    """Begin and end of one of several files: seconds since the first message of all."""

    begin: float
    end: float


class _Period(NamedTuple):
    """A part of a flight: seconds since its first message; `end`: None for the rest of it."""

    start: float
    end: float | None = None


class Flight(AbstractContextManager["Flight"]):
    """One or more files open for reading; `nedbus.open` returns one. Its memory does not depend on their size.

    Call it as `bus.subscribe`, with message classes or names of topics, or "*" for all streams of the files. Each call
    reads the files once. The properties read them once, on first use.
    """

    # All readers of files in nedbus use a Flight, through the functions of this package. The first pass over the files
    # yields messages or columns, as the caller needs; what it has shown is kept.

    def __init__(
        self, paths: Sequence[Path], options: ReadOptions = _BUILT_IN, *, vehicle: str = ANY
    ) -> None:
        self._readers: list[FlightReader] = []  # of the first pass, one for each file
        self._paths = require_files(paths)
        self._options = options
        self._vehicle = vehicle
        self._selection = Selection(vehicle=vehicle)
        self._watches: list[FileUtc] = []  # the UTC of each file, from the first pass
        # of each file, if the first pass is one of columns
        self._columns: list[dict[Address, Columns]] = []
        self._ended: set[str] = set()  # vehicles without further messages in the first pass
        self._samples = WeakSet[FlightSamples[Any]]()  # open ones, which `close` closes
        self._is_complete = False
        self._is_closed = False

    @overload
    def __call__(
        self, message: type[M_co] = ..., *, topic: str = ..., **options: Unpack[Select]
    ) -> FlightSamples[M_co]: ...
    @overload
    def __call__(self, message: str, **options: Unpack[Select]) -> FlightSamples[Message]: ...
    @overload
    def __call__(
        self, message: type[Message] | str, *more: type[Message] | str, **options: Unpack[Select]
    ) -> FlightSamples[Message]: ...
    def __call__(
        self,
        message: type[Message] | str = VehicleLocalPosition,
        *more: type[Message] | str,
        topic: str | None = None,
        vehicle: VehicleNames = ANY,
        instance: int | None = None,
        start: float | datetime = 0.0,
        end: float | datetime | None = None,
        rows: bool = False,
    ) -> FlightSamples[Any]:
        """Return the samples of one or more messages, in the order of the vehicle's timestamps, as an iterator.

        `message`, `topic`, `vehicle`, `instance`: as in `bus.subscribe`. `start`, `end`: seconds since the first
        message of the files, pauses included, or a datetime with its time zone. `rows`: a sample's message is
        a Row, a named tuple: faster, with the same validation.
        `sample.received` is the log time [ns]: Unix time, or time since boot in a log without `boot_time_utc_us`.

        Raises ArgumentError for a `start` or `end` in UTC if the files do not provide UTC, AddressError for an invalid
        name. Iterating raises SourceError if a file has none of these topics.
        """
        names = [topic_of(message, topic), *map(topic_of, more)]
        if Selection(vehicle=vehicle).vehicles == (ANY,):
            vehicle = self._vehicle
        selection = Selection(names, vehicle, instance)
        if selection.topics == (ANY,):
            topics = None
        else:
            topics = set(selection.topics)
        period = _Period(self._seconds(start, "start"))
        if end is not None:
            period = _Period(period.start, self._seconds(end, "end"))
        samples = FlightSamples[Any](self, self._open(topics), selection, period, rows=rows)
        self._samples.add(samples)
        return samples

    @property
    def addresses(self) -> list[Address]:
        """The addresses with messages."""
        return sorted(self.definitions)

    @property
    def definitions(self) -> dict[Address, Definition[Any]]:
        """The definition of each address."""
        self._complete()
        known = self._definitions_of(self._readers)
        return {
            address: definition
            for address, definition in known.items()
            if self._selection.matches(address)
        }

    @property
    def duration(self) -> float:
        """Seconds from the first to the last message, by the vehicle's clock, pauses included."""
        self._complete()
        readers = self._readers
        if len(readers) == 1:
            return readers[0].order.duration
        starts = self._starts
        ends = [
            start + reader.order.duration for start, reader in zip(starts, readers, strict=True)
        ]
        return max(ends) - min(starts)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Damage of the files, and what was left out."""
        self._complete()
        return self._warnings_of(self._readers)

    @property
    def damaged(self) -> bool:
        """True if messages are lost to damage."""
        self._complete()
        return any(reader.damaged for reader in self._readers)

    @property
    def utc(self) -> UtcOffset | None:
        """The offset from time since boot to UTC; None if it is unknown, or differs between several vehicles."""
        self._complete()
        known = []
        for name, utc in self._utc_by_name.items():
            if isinstance(utc, UtcOffset) and self._vehicle in (ANY, name):
                known.append(utc)
        if len(known) != 1:
            return None
        return known[0]

    def close(self) -> None:
        """Close the flight and its samples, which then raise ClosedError; a second call does nothing."""
        self._is_closed = True
        close_all(self._readers)
        for samples in list(self._samples):
            samples.abort()

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        close_all(self._readers)

    def _begin(self, *, watches_utc: bool = False) -> None:
        """Begin the first pass with messages; raise the errors of unreadable files.

        `watches_utc`: note the UTC of the messages on the way, so that it needs no further pass.
        """
        self._readers = [open_reader(path, self._options) for path in self._paths]
        for reader in self._readers:
            if watches_utc:
                watch = FileUtc()
                self._watches.append(watch)
                reader.begin(watch=watch.watch)
            else:
                reader.begin()

    def _complete(self) -> None:
        """Read the rest of the first pass."""
        if self._is_complete:
            return
        if self._is_closed:
            raise ClosedError
        for reader in self._readers:
            deque(reader.messages(), maxlen=0)
            reader.close()
        self._is_complete = True

    def _messages(self) -> Iterator[SourceMessage]:
        """Yield the messages of the first pass in chronological order, also those that are not valid.

        Raises SourceError if one of several files has no UTC.
        """
        yield from self._merge(self._readers, lambda names: self._ended.update(names.values()))
        self._is_complete = True

    def _read_columns(self, selects: Callable[[Address], bool]) -> None:
        """Make the first pass one of columns: read the records of selected addresses, and those with UTC."""
        from .columns import Columns

        for path in self._paths:
            reader = open_reader(path, self._options)
            self._readers.append(reader)
            columns = defaultdict[Address, Columns](Columns)
            is_kept = dict[FileStream, bool]()
            with reader:
                for run in reader.runs():
                    stream = run.stream
                    if stream not in is_kept:
                        is_kept[stream] = selects(stream.address) or provides_utc(stream.definition)
                    if is_kept[stream]:
                        columns[stream.address].add(run)
            self._columns.append(columns)
        self._is_complete = True

    def _open(self, topics: Collection[str] | None) -> list[FlightReader]:
        """Begin another pass, over some topics or all (None), on the axis of the first one."""
        if self._is_closed:
            raise ClosedError
        options = replace(self._options, topics=topics)
        readers = [open_reader(path, options) for path in self._paths]
        try:
            for reader, first in zip(readers, self._readers, strict=True):
                reader.begin(whole=first.order.axis)
        except BaseException:
            close_all(readers)
            raise
        return readers

    def _merge(
        self, readers: Sequence[FlightReader], on_end: Callable[[Names], object]
    ) -> Iterator[SourceMessage]:
        """Return the messages of a pass in chronological order; raise SourceError if one of several has no UTC."""
        if len(readers) == 1:
            return readers[0].messages()
        starts = self._starts
        offsets = [start - min(starts) for start in starts]
        return merge_messages(readers, self._names, offsets, on_end)

    @cached_property
    def _utc(self) -> list[Mapping[str, UtcOffset | str]]:
        """The UTC offset of each vehicle of each file, by its own name, or why it is unknown."""
        if self._columns:
            pairs = zip(self._columns, self._readers, strict=True)
            return [utc_of_columns(columns, reader) for columns, reader in pairs]
        if self._watches and self._is_complete:
            watched = zip(self._watches, self._readers, strict=True)
            return [watch.results(reader) for watch, reader in watched]
        # a file may have other topics only
        if self._options.topics is None:
            topics = None
        else:
            topics = _BUILT_IN.topics
        options = replace(self._options, topics=topics)
        offsets: list[Mapping[str, UtcOffset | str]] = []
        for path in self._paths:
            with open_reader(path, options) as reader:
                offsets.append(read_utc(reader))
        return offsets

    @property
    def _utc_by_name(self) -> dict[str, UtcOffset | str]:
        """The UTC offset of each vehicle, or why it is unknown."""
        by_name = dict[str, UtcOffset | str]()
        for offsets, names in zip(self._utc, self._names, strict=True):
            for vehicle, utc in offsets.items():
                by_name[names.get(vehicle, vehicle)] = utc
        return by_name

    @cached_property
    def _names(self) -> list[Names]:
        """The name of each vehicle of each of several files, by its own name."""
        if len(self._readers) == 1:
            return [{}]
        files = []
        for reader, utc in zip(self._readers, self._utc, strict=True):
            vehicles = {address.vehicle for address in reader.definitions}
            files.append((reader.path, vehicles | utc.keys()))
        return [*distinct_names(files)]

    @cached_property
    def _starts(self) -> list[float]:
        """The Unix time of the first message of each file [s]; raise SourceError if it is unknown."""
        files = zip(self._readers, self._utc, strict=True)
        return [_start_of(reader, utc) for reader, utc in files]

    def _extents(self, readers: Sequence[FlightReader]) -> dict[str, Extent]:
        """Return the extent of the file of each vehicle after a pass over several files; {} for one file."""
        extents = dict[str, Extent]()
        if len(readers) == 1:
            return extents
        starts = self._starts
        for start, reader, names in zip(starts, readers, self._names, strict=True):
            begin = start - min(starts)
            extent = Extent(begin, begin + reader.order.duration)
            for name in names.values():
                extents[name] = extent
        return extents

    def _find(self, address: Address) -> tuple[int, Address]:
        """Return the number of the file that has an address, and the address in this file."""
        for number, names in enumerate(self._names):
            for own, name in names.items():
                if name == address.vehicle:
                    return number, renamed(address, {name: own})
        return 0, address

    @property
    def _first_stamps(self) -> dict[str, int]:
        """The timestamp of each vehicle at the first message of its file [us]."""
        stamps = dict[str, int]()
        for reader, names in zip(self._readers, self._names, strict=True):
            for own in {address.vehicle for address in reader.definitions}:
                stamp = reader.order.axis.stamp_at(own, 0.0)
                if stamp is not None and stamp > 0:
                    stamps[names.get(own, own)] = stamp
        return stamps

    def _definitions_of(self, readers: Sequence[FlightReader]) -> dict[Address, Definition[Any]]:
        """Return the definition of each stream that a pass has met so far."""
        definitions = dict[Address, Definition[Any]]()
        for reader, names in zip(readers, self._names, strict=True):
            # a copy, because another thread may read on meanwhile
            for address, definition in [*reader.definitions.items()]:
                definitions[renamed(address, names)] = definition
        return definitions

    def _warnings_of(self, readers: Sequence[FlightReader]) -> tuple[str, ...]:
        """Return damage, omissions and renamed vehicles that a pass has met so far, each with its file."""
        warnings = []
        for reader, names in zip(readers, self._names, strict=True):
            texts = []
            for own, name in names.items():
                if own != name:
                    texts.append(
                        f"vehicle {own} is named {name} here, because several files have a vehicle {own}"
                    )
            texts += [*reader.warnings, *reader.remarks]
            warnings += [f"{reader.path}: {text}" for text in texts]
        return tuple(warnings)

    def _seconds(self, time: object, name: str) -> float:
        """Return seconds since the first message."""
        if not isinstance(time, datetime):
            seconds = math.nan
            if isinstance(time, Real):
                with suppress(OverflowError):
                    seconds = float(time)
            if math.isnan(seconds):
                raise ArgumentError(name, time, "seconds, or a datetime with a time zone")
            return seconds
        if time.tzinfo is None:
            expected = "seconds, or a datetime with a time zone, such as datetime(2025, 10, 9, 8, 53, tzinfo=UTC)"
            raise ArgumentError(
                name, str(time), expected, problem="has no time zone, so it names no moment"
            )
        self._complete()
        try:
            start = min(self._starts)
        except SourceError as exc:
            expected = "seconds since the first message, because this flight has no UTC"
            raise ArgumentError(name, str(time), expected) from exc
        return time.astimezone(UTC).timestamp() - start


class FlightSamples(Generic[M_co], AbstractContextManager["FlightSamples[M_co]"]):
    """Iterator over the samples of a flight, with the methods of a subscription; the call of a flight returns one.

    `skipped`: number of invalid messages so far, by address; the reason of the first is in `warnings`.
    """

    def __init__(
        self,
        flight: Flight,
        readers: Sequence[FlightReader],
        selection: Selection,
        period: _Period,
        *,
        rows: bool,
    ) -> None:
        self._flight = flight
        self._readers = readers
        self._selection = selection
        self._rows = rows
        self._start = period.start
        self._end = period.end
        self.skipped: Counter[Address] = Counter()
        self._reasons: dict[Address, str] = {}
        self._matches = lru_cache(10_000)(selection.matches)
        self._messages = self._select()
        self._is_aborted = False  # by the flight

    @property
    def warnings(self) -> list[str]:
        """Damage, omissions and invalid messages so far."""
        warnings = [*self._flight._warnings_of(self._readers)]
        for address, reason in self._reasons.items():
            count = self.skipped[address]
            warnings.append(f"skipped {count} messages of {address} as invalid ({reason})")
        return warnings

    @property
    def damaged(self) -> bool:
        """True if messages were lost to damage so far."""
        return any(reader.damaged for reader in self._readers)

    def rows(self) -> Iterator[Sample[M_co]]:
        """Iterate over samples whose message is a Row, as `subscription.rows` does."""
        while True:
            if self._is_aborted:
                raise ClosedError
            selected = next(self._messages, None)
            if selected is None:
                return
            address, definition, encoded, received, provenance = selected
            message: Any = codec_of(definition).decode_row(encoded.payload)
            yield Sample(message, address, received, provenance=provenance)

    def batches(self) -> Iterator[Batch]:
        """Iterate over messages as NumPy arrays, up to 4096 of one type, with the same validation."""
        from .columns import make_batches

        while messages := list(islice(self._messages, limits.BATCH_MESSAGES)):
            yield from make_batches(messages)
            if self._is_aborted:
                raise ClosedError

    def close(self) -> None:
        """Close the files; a second call does nothing."""
        self._messages.close()
        close_all(self._readers)

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Sample[M_co]:
        if self._is_aborted:
            raise ClosedError
        address, definition, encoded, received, provenance = next(self._messages)
        codec = codec_of(definition)
        if self._rows:
            decode = codec.decode_row
        else:
            decode = codec.decode
        message: Any = decode(encoded.payload)
        return Sample(message, address, received, provenance=provenance)

    def abort(self) -> None:
        """Close the files, because their flight is closed: another sample raises ClosedError."""
        self._is_aborted = True
        self.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _select(self) -> Generator[FlightMessage]:
        """Yield the selected messages, and count the invalid ones."""
        readers = self._readers
        make = tuple.__new__  # half the time of the constructor
        is_any_selected = False
        try:
            for message in self._flight._merge(readers, lambda _: None):
                is_late = self._end is not None and message.at > self._end
                if is_late and is_any_selected:
                    return
                address = message.address
                if not self._matches(address):
                    continue
                is_any_selected = True
                if is_late:
                    return
                if message.at < self._start:
                    continue
                try:
                    encoded = message.encode()
                except InvalidMessageError as exc:
                    self.skipped[address] += 1
                    self._reasons.setdefault(address, exc.reason)
                    continue
                definition = message.definition or BY_TOPIC[address.topic]
                time = to_unix_ns(message.time, boot_utc_of(readers))
                provenance = Provenance(message.source, encoded.missing)
                yield make(FlightMessage, (address, definition, encoded, time, provenance))
        finally:
            close_all(readers)
        if not is_any_selected:
            self._raise_unmatched()

    def _raise_unmatched(self) -> None:
        """Raise AddressError, because the files have none of the selected addresses."""
        readers = self._readers
        addresses = sorted(self._flight._definitions_of(readers))
        where: Path | str = f"any of the {len(readers)} files"
        if len(readers) == 1:
            where = readers[0].path
        matching(where, addresses, self._selection)


def close_all(readers: Sequence[FlightReader]) -> None:
    """Close files."""
    for reader in readers:
        reader.close()


def boot_utc_of(readers: Sequence[FlightReader]) -> int:
    """Return the Unix time of the boot in the metadata of the only file [us]; 0 if unknown, or for several files."""
    if len(readers) == 1:
        return readers[0].boot_utc
    return 0


def _start_of(reader: FlightReader, utc: Mapping[str, UtcOffset | str]) -> float:
    """Return the Unix time of the first message of a file [s]; raise SourceError if it is unknown."""
    starts = []
    for message in reader.ahead:
        offset = utc.get(message.address.vehicle)
        if message.error:
            stamp = None
        else:
            stamp = message.timestamp
        if isinstance(offset, UtcOffset) and stamp is not None:
            starts.append(int(offset.unix_us(stamp)) / 1e6 - message.at)
    if not starts:
        reasons = [reason for reason in utc.values() if isinstance(reason, str)]
        raise no_utc(reader.path, reasons[0] if reasons else "")
    return median(starts)
