"""A flight open for reading: `nedbus.open` and the samples of one or more files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from datetime import UTC, datetime
from functools import cached_property, lru_cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, Self, TypedDict, Unpack, overload
from weakref import WeakSet

from nedbus.errors import ArgumentError, ClosedError, InvalidMessageError, SourceError
from nedbus.samples import M_co, Sample
from nedbus.timeline import UtcOffset, to_unix_ns
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

from .merge import MergedFlights, Survey, require_files
from .readers import ReadOptions
from .selection import matching

if TYPE_CHECKING:
    from nedbus.samples import Batch

_BATCH: Final = 4096  # messages per batch at most, of all types
_ALL: Final = ReadOptions(topics=None)


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
    return Flight([Path(each).expanduser() for each in paths], vehicle=vehicle_name(vehicle), layout=layout)


class Flight(AbstractContextManager["Flight"]):
    """One or more files open for reading; `nedbus.open` returns one. Its memory does not depend on their size.

    Call it as `bus.subscribe`, with message classes or names of topics, or "*" for all streams of the files. Each call
    reads the files once. The properties read them once, on first use.
    """

    def __init__(self, paths: Sequence[Path], *, vehicle: str, layout: str | None) -> None:
        self._paths, self._vehicle = require_files(paths), vehicle
        self._options, self._is_closed = replace(_ALL, layout=layout), False
        self._selection = Selection(vehicle=vehicle)
        self._samples = WeakSet[FlightSamples[Any]]()  # open ones, which `close` closes
        self._unread: MergedFlights | None = self._open(_ALL.topics, surveys=True)  # raises errors of unreadable files

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
        names = [topic_of(message, topic), *(topic_of(each) for each in more)]
        chosen: VehicleNames = self._vehicle if Selection(vehicle=vehicle).vehicles == (ANY,) else vehicle
        selection = Selection(names, chosen, instance)
        topics = None if selection.topics == (ANY,) else set(selection.topics)
        period = self._seconds(start, "start"), None if end is None else self._seconds(end, "end")
        samples = FlightSamples[Any](self._open(topics), selection, period, rows=rows)
        self._samples.add(samples)
        return samples

    @property
    def addresses(self) -> list[Address]:
        """The addresses with messages."""
        return sorted(self.definitions)

    @property
    def definitions(self) -> dict[Address, Definition[Any]]:
        """The definition of each address."""
        found = self._survey[0].definitions
        return {address: known for address, known in found.items() if self._selection.matches(address)}

    @property
    def duration(self) -> float:
        """Seconds from the first to the last message, by the vehicle's clock, pauses included."""
        flights, surveys = self._survey
        return flights.duration(surveys)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Damage of the files, and what was left out."""
        return self._survey[0].warnings

    @property
    def damaged(self) -> bool:
        """True if messages are lost to damage."""
        return self._survey[0].damaged

    @property
    def utc(self) -> UtcOffset | None:
        """The offset from time since boot to UTC; None if it is unknown, or differs between several vehicles."""
        found = [utc for name, utc in self._utc.items() if self._vehicle in (ANY, name)]
        return found[0] if len(found) == 1 else None

    def close(self) -> None:
        """Close the flight and its samples, which then raise ClosedError; a second call does nothing."""
        self._is_closed = True
        if self._unread is not None:
            self._unread.close()
        for samples in list(self._samples):
            samples.abort()

    def __exit__(self, *_: object) -> None:
        self.close()

    @cached_property
    def _survey(self) -> tuple[MergedFlights, list[Survey]]:
        """The files after one pass, and what it shows of each."""
        flights, self._unread = self._unread, None
        if flights is None:
            flights = self._open(_ALL.topics, surveys=True)
        return flights, flights.survey()

    @property
    def _utc(self) -> dict[str, UtcOffset]:
        flights, _ = self._survey
        return {name: utc for name, utc in flights.utc.items() if isinstance(utc, UtcOffset)}

    def _open(self, topics: Any, *, surveys: bool = False) -> MergedFlights:
        if self._is_closed:
            raise ClosedError
        known = self.__dict__.get("_survey", (None, ()))[1]
        return MergedFlights(self._paths, replace(self._options, topics=topics), known=known, surveys=surveys)

    def _seconds(self, time: float | datetime, name: str) -> float:
        """Return seconds since the first message."""
        if not isinstance(time, datetime):
            return time
        if time.tzinfo is None:
            expected = "seconds, or a datetime with a time zone, such as datetime(2025, 10, 9, 8, 53, tzinfo=UTC)"
            raise ArgumentError(name, str(time), expected, problem="has no time zone, so it names no moment")
        try:
            start = self._survey[0].start()
        except SourceError as exc:
            expected = "seconds since the first message, because this flight has no UTC"
            raise ArgumentError(name, str(time), expected) from exc
        return time.astimezone(UTC).timestamp() - start


class FlightSamples(Generic[M_co], AbstractContextManager["FlightSamples[M_co]"]):
    """Iterator over the samples of a flight, with the methods of a subscription; the call of a flight returns one.

    `skipped`: number of invalid messages so far, by address; the reason of the first is in `warnings`.
    """

    def __init__(
        self, flights: MergedFlights, selection: Selection, period: tuple[float, float | None], *, rows: bool
    ) -> None:
        self._flights, self._selection, self._rows = flights, selection, rows
        self._start, self._end = period
        self.skipped: Counter[Address] = Counter()
        self._reasons: dict[Address, str] = {}
        self._matches = lru_cache(10_000)(selection.matches)
        self._messages = self._select()
        self._is_aborted = False  # by the flight

    @property
    def warnings(self) -> list[str]:
        """Damage, omissions and invalid messages so far."""
        count = self.skipped
        invalid = [
            f"skipped {count[each]} messages of {each} as invalid ({text})" for each, text in self._reasons.items()
        ]
        return [*self._flights.warnings, *invalid]

    @property
    def damaged(self) -> bool:
        """True if messages were lost to damage so far."""
        return self._flights.damaged

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

        while ahead := list(islice(self._messages, _BATCH)):
            yield from make_batches(ahead)
            if self._is_aborted:
                raise ClosedError

    def close(self) -> None:
        """Close the files; a second call does nothing."""
        self._messages.close()
        self._flights.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Sample[M_co]:
        if self._is_aborted:
            raise ClosedError
        address, definition, encoded, received, provenance = next(self._messages)
        codec = codec_of(definition)
        message: Any = (codec.decode_row if self._rows else codec.decode)(encoded.payload)
        return Sample(message, address, received, provenance=provenance)

    def abort(self) -> None:
        """Close the files, because their flight is closed: another sample raises ClosedError."""
        self._is_aborted = True
        self.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _select(self) -> Generator[tuple[Address, Definition[Any], Encoded, int, Provenance]]:
        """Yield address, definition, payload, log time [ns] and provenance of the selected messages."""
        flights, is_found = self._flights, False
        try:
            for message in flights.messages():
                is_late = self._end is not None and message.at > self._end
                if is_late and is_found:
                    return
                address = message.address
                if not self._matches(address):
                    continue
                is_found = True
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
                time = to_unix_ns(message.time, flights.boot_utc)
                yield address, definition, encoded, time, _provenance(message.source, encoded.missing)
        finally:
            flights.close()
        if not is_found:
            files = flights.files
            where = files[0].path if len(files) == 1 else f"any of the {len(files)} files"
            matching(where, sorted(flights.definitions), self._selection)  # raises an AddressError


@lru_cache(1024)
def _provenance(source: str | None, missing: frozenset[str]) -> Provenance:
    return Provenance(source, missing)
