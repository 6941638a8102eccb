"""Read streams from one or more files as arrays or data frames."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypedDict, Unpack, overload

import numpy as np

from nedbus.errors import AddressError, SourceError
from nedbus.flights import (
    ReadOptions,
    distinct_names,
    matching,
    no_utc,
    renamed,
    require_files,
    require_one_vehicle,
    single_match,
)
from nedbus.log_event import about
from nedbus.timeline import UtcOffset, provides_utc
from nedbus_msgs import ANY, BY_TOPIC, DEFAULT, DEFAULT_TOPIC, TOPICS, Address, Selection, vehicle_name
from nedbus_msgs.arrays import MessageArray

from .arrays import Absent, FlightArrays, Library, Pandas, Polars, Streams, to_dataframe

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl

_log = logging.getLogger(__name__)

_UTC_TOPICS: Final = {name for name, each in BY_TOPIC.items() if provides_utc(each)}

FlightPath = str | Path
Files = FlightPath | Sequence[FlightPath]
_Topics = list[str] | tuple[str, ...]
_Select = Callable[[Path, Sequence[Address], Selection], list[Address]]


class _Filter(TypedDict, total=False):
    vehicle: str | int
    instance: int | None
    layout: str | None


@overload
def read(path: FlightPath, topic: str = ..., *, dataframe: None = None, **stream: Unpack[_Filter]) -> MessageArray: ...
@overload
def read(path: FlightPath, topic: str = ..., *, dataframe: Pandas, **stream: Unpack[_Filter]) -> pd.DataFrame: ...
@overload
def read(path: FlightPath, topic: str = ..., *, dataframe: Polars, **stream: Unpack[_Filter]) -> pl.DataFrame: ...
@overload
def read(
    path: Files, topic: _Topics, *, dataframe: None = None, **stream: Unpack[_Filter]
) -> dict[str, MessageArray]: ...
@overload
def read(path: Files, topic: _Topics, *, dataframe: Pandas, **stream: Unpack[_Filter]) -> dict[str, pd.DataFrame]: ...
@overload
def read(path: Files, topic: _Topics, *, dataframe: Polars, **stream: Unpack[_Filter]) -> dict[str, pl.DataFrame]: ...
def read(
    path: Files,
    topic: str | _Topics = DEFAULT_TOPIC,
    *,
    vehicle: str | int = ANY,
    instance: int | None = None,
    layout: str | None = None,
    dataframe: Library = None,
) -> Any:
    """Return one topic of a .ulg log, an .mcap recording or a .tlog as a structured array, one element per message.

    The columns are the fields of the message with PX4's types (`nedbus.dtype_of(topic)`).
    Fields that a layout or source lacks are NaN, false or 0; `nedbus.missing_of` names them.
    Invalid messages and damaged parts of the file are skipped and logged.
    `dataframe`: return a pandas or polars data frame, with array fields as columns `delta_xy[0]`, `delta_xy[1]` and
    nulls for missing fields; a pandas data frame names these in `attrs["missing"]`. Its uint64 fields, such as
    `timestamp`, are int64, so that differences may be negative; values above 2^63 - 1 become 2^63 - 1.
    A list of topics, or of streams such as "sensor_gps/1", returns a dict by stream, for one vehicle. "*" selects all
    streams of the file, including messages that only the file defines.
    `layout`: the PX4 release, such as "1.15", whose layouts a recording has, if its definitions are of another one.
    A list of files returns a dict by vehicle and stream, with `timestamp` in Unix time [us]; a vehicle that is in
    several files is named after its file.

    Raises SourceError if a file cannot be read, or is one of several and has no UTC; AddressError if no stream or
    several streams match topic, vehicle and instance; ConfigError if the package that reads the file is not installed.
    """
    found = read_streams(path, topic, vehicle=vehicle, instance=instance, layout=layout)
    tables = {name: to_dataframe(messages, absent, dataframe) for name, (messages, absent) in found.streams.items()}
    return next(iter(tables.values())) if isinstance(topic, str) and isinstance(path, FlightPath) else tables


class ReadStreams(NamedTuple):
    """Streams by name; `start`: when recording began [us], 0 if unknown; `utc`: of the vehicle, if requested."""

    streams: Streams
    start: int
    utc: UtcOffset | None


def read_streams(
    path: Files,
    topics: str | Sequence[str] | None,
    *,
    vehicle: str | int,
    instance: int | None = None,
    layout: str | None = None,
    utc: bool = False,
) -> ReadStreams:
    """Return the streams of one vehicle or several files.

    `topics`: None selects the streams of all topics known to nedbus. `utc`: also find the UTC of a single file.
    """
    names, vehicle = [topics] if isinstance(topics, str) else topics, vehicle_name(vehicle)
    if isinstance(path, FlightPath):
        select = single_match if isinstance(topics, str) else matching
        selections = [_selection(name, vehicle, instance) for name in names or [ANY]]
        return _read_one(Path(path).expanduser(), _topics(names), selections, select, layout=layout, utc=utc)
    paths = require_files([Path(each).expanduser() for each in path])
    return _read_several(paths, names, vehicle, layout)


class FlightSet:
    """Files whose vehicles have distinct names; with `unix_times`, their timestamps become Unix times [us].

    `vehicles`: the file of each vehicle, by its name in the set, and its name in the file.
    `addresses`: with the names in the set.
    """

    def __init__(self, flights: Sequence[FlightArrays], *, unix_times: bool) -> None:
        self._flights, self._unix_times = flights, unix_times
        names = distinct_names([(each.path, {one.vehicle for one in each.addresses}) for each in flights])
        self.vehicles: dict[str, tuple[FlightArrays, str]] = {}
        self.addresses: list[Address] = []
        for flight, known in zip(flights, names, strict=True):
            self.vehicles |= {name: (flight, own) for own, name in known.items()}
            self.addresses += [renamed(each, known) for each in flight.addresses]

    def read(self, address: Address) -> tuple[MessageArray, Absent]:
        """Return what `FlightArrays.read` does; raise SourceError if Unix times are required, but UTC is unknown."""
        flight, own = self.vehicles[address.vehicle]
        messages, absent = flight.read(renamed(address, {address.vehicle: own}))
        if self._unix_times:
            messages["timestamp"] = self.utc(address.vehicle).unix_us(messages["timestamp"].astype(np.int64))
        return messages, absent

    def utc(self, vehicle: str) -> UtcOffset:
        """Return the UTC offset of a vehicle; raise SourceError if it is unknown."""
        flight, own = self.vehicles[vehicle]
        if isinstance(utc := flight.utc(own), str):
            raise no_utc(flight.path, utc)
        return utc

    @property
    def warnings(self) -> list[str]:
        """Damage found and messages skipped so far."""
        return [f"{each.path}: {warning}" for each in self._flights for warning in each.warnings]

    @property
    def damaged(self) -> bool:
        """True if messages are lost to damage."""
        return any(each.damaged for each in self._flights)


class Positions(FlightSet):
    """The streams of positions of one or more files, for a plot; those of several files have Unix times.

    Raises the errors of `read`.
    """

    def __init__(self, paths: Sequence[Path], selection: Selection) -> None:
        topics, is_single = DEFAULT.topics.keys(), len(paths) == 1
        options = ReadOptions(topics if is_single else topics | _UTC_TOPICS)
        selects = Selection(selection.topics, instance=selection.instance).matches  # the set may rename a vehicle
        super().__init__(
            [FlightArrays(path, options, selects) for path in require_files(paths)], unix_times=not is_single
        )
        found = matching(paths[0], sorted(self.addresses), selection)
        self.addresses = [address for address in found if address.topic in topics]


def _read_one(
    path: Path,
    topics: Set[str] | None,
    selections: Sequence[Selection],
    select: _Select,
    *,
    layout: str | None,
    utc: bool,
) -> ReadStreams:
    options = ReadOptions(topics if topics is None or not utc else topics | _UTC_TOPICS, layout=layout)
    try:
        flight = FlightArrays(path, options, lambda each: any(one.matches(each) for one in selections))
        chosen = dict.fromkeys(each for one in selections for each in select(path, flight.addresses, one))
    except (AddressError, SourceError) as exc:
        raise _explain_absent(path, options, selections, select) or exc from None
    require_one_vehicle(path, chosen, selections[0].vehicles[0])
    streams = {address.stream: flight.read(address) for address in chosen}
    _log_warnings(flight)
    found = flight.utc(next(iter(chosen)).vehicle) if utc else None
    return ReadStreams(streams, flight.start, found if isinstance(found, UtcOffset) else None)


def _read_several(paths: Sequence[Path], topics: Sequence[str] | None, vehicle: str, layout: str | None) -> ReadStreams:
    """Return the messages of several files by vehicle and stream, with Unix times."""
    wanted = _topics(topics)
    for topic in wanted or ():
        Selection(topic)  # raises AddressError for a name that no topic can have
    options = ReadOptions(wanted if wanted is None else wanted | _UTC_TOPICS, layout=layout)
    flights = [_open_for_merge(path, options, wanted) for path in paths]
    found, streams, starts = FlightSet(flights, unix_times=True), Streams(), list[int]()
    if vehicle not in (ANY, *found.vehicles):
        raise AddressError("vehicle", vehicle, f"one of {', '.join(sorted(found.vehicles))}")
    for name, (flight, _) in found.vehicles.items():
        others = found.vehicles.keys() - {name}
        chosen = [each.removeprefix(f"{name}/") for each in topics or [ANY] if each.partition("/")[0] not in others]
        if vehicle not in (ANY, name) or not chosen:
            continue
        available = [each for each in found.addresses if each.vehicle == name and (not wanted or each.topic in wanted)]
        selections = [_selection(each, name, None) for each in chosen]
        for address in dict.fromkeys(each for one in selections for each in matching(flight.path, available, one)):
            streams[f"{name}/{address.stream}"] = found.read(address)
        starts.append(int(found.utc(name).unix_us(flight.start)) if flight.start else 0)
    for flight in flights:
        _log_warnings(flight)
    return ReadStreams(streams, min(starts, default=0), None)


def _open_for_merge(path: Path, options: ReadOptions, wanted: Set[str] | None) -> FlightArrays:
    try:
        return FlightArrays(path, options, lambda each: wanted is None or each.topic in wanted)
    except SourceError as exc:
        selections = [Selection(topic) for topic in sorted(wanted or ())]
        raise _explain_absent(path, options, selections, matching) or exc from None


def _explain_absent(
    path: Path, options: ReadOptions, selections: Sequence[Selection], select: _Select
) -> AddressError | None:
    """Return an error with the streams of a file if it lacks a selected one; None if that was not the fault."""
    if options.topics is None or TOPICS.keys() <= {*options.topics}:
        return None
    known = FlightArrays(path, replace(options, topics={*options.topics, *TOPICS}), lambda _: False).addresses
    for one in selections:
        try:
            select(path, known, one)
        except AddressError as exc:
            return exc
    return None


def _log_warnings(flight: FlightArrays) -> None:
    for warning in flight.warnings:
        extra = about("damaged", source=str(flight.path), reason=warning)
        _log.warning("%s: %s", flight.path, warning, extra=extra)


def _selection(name: str, vehicle: str, instance: int | None) -> Selection:
    """Return the selection of a topic, or of a stream such as sensor_gps/1."""
    topic, _, number = name.rpartition("/")
    return Selection(topic, vehicle, int(number)) if number.isdecimal() else Selection(name, vehicle, instance)


def _topics(names: Sequence[str] | None) -> Set[str] | None:
    """Return the topics of streams such as vehicle_attitude, sensor_gps/1 or 7/sensor_gps/1; None for all."""
    if names is None:
        return TOPICS.keys()
    parts = [[part for part in name.split("/") if not part.isdecimal()] or [name] for name in names]
    return None if any(part[-1] == ANY for part in parts) else {part[-1] for part in parts}
