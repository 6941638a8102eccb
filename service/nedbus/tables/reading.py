"""Read streams from one or more files as arrays or data frames."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypedDict, Unpack, overload

import numpy as np

from nedbus.errors import AddressError, SourceError
from nedbus.flights import (
    ReadOptions,
    UtcOffset,
    distinct_names,
    matching,
    no_utc,
    provides_utc,
    renamed,
    require_files,
    require_one_vehicle,
    single_match,
)
from nedbus.log_event import about
from nedbus_msgs import ANY, BY_TOPIC, DEFAULT, DEFAULT_TOPIC, TOPICS, Address, Selection, vehicle_name
from nedbus_msgs.arrays import MessageArray

from .arrays import FlightArrays, Library, Pandas, Polars, Streams, to_dataframe

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
    nulls for missing fields; a pandas data frame names these in `attrs["missing"]`.
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
    names = [topics] if isinstance(topics, str) else topics
    if isinstance(path, FlightPath):
        select = single_match if isinstance(topics, str) else matching
        selections = [_selection(name, vehicle_name(vehicle), instance) for name in names or [ANY]]
        return _read_one(Path(path).expanduser(), _topics(names), selections, select, layout=layout, utc=utc)
    paths = require_files([Path(each).expanduser() for each in path])
    return _read_several(paths, names, vehicle_name(vehicle), layout)


class Positions:
    """The streams of positions of one or more files, for a plot; those of several files have Unix times.

    Raises the errors of `read`.
    """

    def __init__(self, paths: Sequence[Path], selection: Selection) -> None:
        topics = DEFAULT.topics.keys()
        options = ReadOptions(topics if len(paths) == 1 else topics | _UTC_TOPICS)
        self._flights = [FlightArrays(path, options, selection.matches) for path in require_files(paths)]
        names = distinct_names([(each.path, {one.vehicle for one in each.addresses}) for each in self._flights])
        self._homes: dict[Address, tuple[FlightArrays, Address]] = {}
        for flight, known in zip(self._flights, names, strict=True):
            for address in flight.addresses:
                self._homes[renamed(address, known)] = flight, address
        found = matching(paths[0], sorted(self._homes), selection)
        self.addresses = [address for address in found if address.topic in topics]

    def read(self, addresses: Sequence[Address]) -> Iterator[tuple[Address, MessageArray]]:
        """Yield the messages of each address."""
        for address in addresses:
            flight, own = self._homes[address]
            messages, _ = flight.read([own])[own]
            if len(self._flights) > 1:
                messages["timestamp"] = _utc_of(flight, own.vehicle).unix_us(messages["timestamp"].astype(np.int64))
            yield address, messages

    @property
    def warnings(self) -> list[str]:
        """Damage found and messages skipped so far."""
        return [f"{each.path}: {warning}" for each in self._flights for warning in each.warnings]

    @property
    def damaged(self) -> bool:
        """True if messages are lost to damage."""
        return any(each.damaged for each in self._flights)


def _utc_of(flight: FlightArrays, vehicle: str) -> UtcOffset:
    if isinstance(utc := flight.utc(vehicle), str):
        raise no_utc(flight.path, utc)
    return utc


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
        flight = FlightArrays(path, options, lambda each: _matches(selections, each))
        chosen = dict.fromkeys(each for one in selections for each in select(path, flight.addresses, one))
    except (AddressError, SourceError):
        _explain_absent(path, options, selections, select)
        raise
    require_one_vehicle(path, chosen, selections[0].vehicle)
    streams = {address.stream: found for address, found in flight.read(chosen).items()}
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
    names = distinct_names([(each.path, {one.vehicle for one in each.addresses}) for each in flights])
    named = [(flight, own, name) for flight, known in zip(flights, names, strict=True) for own, name in known.items()]
    if vehicle not in (ANY, *(name for _, _, name in named)):
        raise AddressError("vehicle", vehicle, f"one of {', '.join(sorted(name for _, _, name in named))}")
    streams, starts = Streams(), list[int]()
    for flight, own, name in named:
        others = {each for _, _, each in named if each != name}
        chosen = [each.removeprefix(f"{name}/") for each in topics or [ANY] if each.partition("/")[0] not in others]
        if vehicle not in (ANY, name) or not chosen:
            continue
        utc = _utc_of(flight, own)
        available = [each for each in flight.addresses if wanted is None or each.topic in wanted]
        selections = [_selection(each, own, None) for each in chosen]
        addresses = dict.fromkeys(each for one in selections for each in matching(flight.path, available, one))
        for address, (messages, absent) in flight.read(addresses).items():
            messages["timestamp"] = utc.unix_us(messages["timestamp"].astype(np.int64))
            streams[f"{name}/{address.stream}"] = messages, absent
        starts.append(int(utc.unix_us(flight.start)) if flight.start else 0)
    for flight in flights:
        _log_warnings(flight)
    return ReadStreams(streams, min(starts, default=0), None)


def _open_for_merge(path: Path, options: ReadOptions, wanted: Set[str] | None) -> FlightArrays:
    try:
        return FlightArrays(path, options, lambda each: wanted is None or each.topic in wanted)
    except SourceError:
        _explain_absent(path, options, [Selection(topic) for topic in sorted(wanted or ())], matching)
        raise


def _explain_absent(path: Path, options: ReadOptions, selections: Sequence[Selection], select: _Select) -> None:
    """Raise AddressError with the streams of a file if it has none of the selected ones."""
    if options.topics is not None and not TOPICS.keys() <= {*options.topics}:
        known = FlightArrays(path, replace(options, topics={*options.topics, *TOPICS}), lambda _: False).addresses
        for one in selections:
            select(path, known, one)


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


def _matches(selections: Sequence[Selection], address: Address) -> bool:
    return any(each.matches(address) for each in selections)
