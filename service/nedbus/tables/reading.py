"""Read streams from one or more files as arrays or data frames."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypedDict, Unpack, overload

from nedbus import Flight
from nedbus.errors import AddressError, ArgumentError, SourceError
from nedbus.flights import (
    ReadOptions,
    matching,
    path_of,
    require_one_vehicle,
    single_match,
    vehicles_of,
)
from nedbus.log_event import about
from nedbus.timeline import provides_utc
from nedbus_msgs import ANY, BY_TOPIC, DEFAULT_TOPIC, TOPICS, Address, Selection, vehicle_name
from nedbus_msgs.arrays import MessageArray

from .arrays import (
    Library,
    Pandas,
    Polars,
    Streams,
    array_of,
    array_warnings,
    open_arrays,
    to_dataframe,
)

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl

_log = logging.getLogger(__name__)

_UTC_TOPICS: Final = {name for name, message in BY_TOPIC.items() if provides_utc(message)}

FlightPath = str | Path
Files = FlightPath | Sequence[FlightPath]
_Topics = list[str] | tuple[str, ...]
_Select = Callable[[Path, Sequence[Address], Selection], list[Address]]


class _Filter(TypedDict, total=False):
    vehicle: str | int
    instance: int | None
    layout: str | None


@overload
def read(
    path: FlightPath, topic: str = ..., *, dataframe: None = None, **stream: Unpack[_Filter]
) -> MessageArray: ...
@overload
def read(
    path: FlightPath, topic: str = ..., *, dataframe: Pandas, **stream: Unpack[_Filter]
) -> pd.DataFrame: ...
@overload
def read(
    path: FlightPath, topic: str = ..., *, dataframe: Polars, **stream: Unpack[_Filter]
) -> pl.DataFrame: ...
@overload
def read(
    path: Files, topic: _Topics, *, dataframe: None = None, **stream: Unpack[_Filter]
) -> dict[str, MessageArray]: ...
@overload
def read(
    path: Files, topic: _Topics, *, dataframe: Pandas, **stream: Unpack[_Filter]
) -> dict[str, pd.DataFrame]: ...
@overload
def read(
    path: Files, topic: _Topics, *, dataframe: Polars, **stream: Unpack[_Filter]
) -> dict[str, pl.DataFrame]: ...
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
    opened = read_streams(path, topic, vehicle=vehicle, instance=instance, layout=layout)
    tables = {}
    for name, (messages, absent) in opened.streams.items():
        tables[name] = to_dataframe(messages, absent, dataframe)
    if isinstance(topic, str) and isinstance(path, FlightPath):
        (table,) = tables.values()
        return table
    return tables


class ReadStreams(NamedTuple):
    """Streams by name, and their addresses in the flight from which they were read.

    `unix_times`: their timestamps are Unix times, because they are from several files.
    """

    streams: Streams
    flight: Flight
    addresses: list[Address]
    unix_times: bool


def names_of(topics: str | Sequence[str] | None) -> list[str] | None:
    """Return the names of one topic or several; raise ArgumentError for a message class."""
    if topics is None:
        return None
    names = [topics] if isinstance(topics, str | type) else [*topics]
    for name in names:
        if not isinstance(name, str):
            raise ArgumentError("topic", name, "names of topics, such as 'vehicle_attitude'")
    return names


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

    `topics`: None selects the streams of all topics known to nedbus. `utc`: also read what provides UTC.
    """
    names = names_of(topics)
    vehicle = vehicle_name(vehicle)
    if isinstance(path, FlightPath):
        select = single_match if isinstance(topics, str) else matching
        selections = [_selection(name, vehicle, instance) for name in names or [ANY]]
        options = _options(names, layout, utc=utc)
        flight, chosen = _choose_in_one(Path(path).expanduser(), options, selections, select)
    else:
        paths = [Path(file).expanduser() for file in path]
        flight, chosen = _choose_in_several(paths, names, vehicle, layout)
    is_several = not isinstance(path, FlightPath)
    streams = Streams()
    for address in chosen:
        if is_several:
            name = f"{address.vehicle}/{address.stream}"
        else:
            name = address.stream
        streams[name] = array_of(flight, address, unix_times=is_several)
    for file, text in array_warnings(flight):
        _log.warning("%s: %s", file, text, extra=about("damaged", source=str(file), reason=text))
    return ReadStreams(streams, flight, chosen, unix_times=is_several)


def read_plotted(
    paths: Sequence[Path], selection: Selection, topics: Collection[str]
) -> tuple[Flight, list[Address]]:
    """Read these topics of one or more files for a plot; return the addresses that a selection chooses.

    Raises the errors of `read`.
    """
    topics = frozenset(topics)
    read = topics
    if len(paths) > 1:
        read = topics | _UTC_TOPICS
    options = ReadOptions(read)
    # a vehicle may have another name here
    selects = Selection(selection.topics, instance=selection.instance).matches
    flight = open_arrays(paths, options, selects)
    chosen = matching(paths[0], flight.addresses, selection)
    return flight, [address for address in chosen if address.topic in topics]


def _options(names: Sequence[str] | None, layout: str | None, *, utc: bool) -> ReadOptions:
    topics = _topics(names)
    if utc and topics is not None:
        topics = topics | _UTC_TOPICS
    return ReadOptions(topics, layout=layout)


def _choose_in_one(
    path: Path, options: ReadOptions, selections: Sequence[Selection], select: _Select
) -> tuple[Flight, list[Address]]:
    """Read a file; return the addresses of one vehicle that are selected."""

    def is_selected(address: Address) -> bool:
        return any(selection.matches(address) for selection in selections)

    chosen: dict[Address, None] = {}  # in order, each once
    try:
        flight = open_arrays([path], options, is_selected)
        for selection in selections:
            chosen |= dict.fromkeys(select(path, flight.addresses, selection))
    except (AddressError, SourceError) as exc:
        raise _explain_absent(path, options, selections, select) or exc from None
    require_one_vehicle(path, chosen, selections[0].vehicles[0])
    return flight, [*chosen]


def _choose_in_several(
    paths: Sequence[Path], names: Sequence[str] | None, vehicle: str, layout: str | None
) -> tuple[Flight, list[Address]]:
    """Read several files; return the selected addresses, vehicle by vehicle."""
    topics = _topics(names)
    for topic in topics or ():
        Selection(topic)  # raises AddressError for a name that no topic can have

    def is_selected(address: Address) -> bool:
        return topics is None or address.topic in topics

    options = _options(names, layout, utc=True)
    try:
        flight = open_arrays(paths, options, is_selected)
    except SourceError as exc:
        selections = [Selection(topic) for topic in sorted(topics or ())]
        raise _explain_absent(Path(exc.source), options, selections, matching) or exc from None
    vehicles = vehicles_of(flight)
    if vehicle not in (ANY, *vehicles):
        raise AddressError("vehicle", vehicle, f"one of {', '.join(sorted(vehicles))}")
    available = [address for address in flight.addresses if not topics or is_selected(address)]
    chosen: list[Address] = []
    for owner in vehicles:
        if vehicle in (ANY, owner):
            others = {*vehicles} - {owner}
            chosen += _choose_of_vehicle(flight, available, names or [ANY], owner, others)
    return flight, chosen


def _choose_of_vehicle(
    flight: Flight, available: list[Address], names: Sequence[str], vehicle: str, others: Set[str]
) -> Iterable[Address]:
    """Return the addresses of a vehicle that names such as sensor_gps, sensor_gps/1 or 7/sensor_gps select."""
    path = path_of(flight, vehicle)
    own = [address for address in available if address.vehicle == vehicle]
    chosen: dict[Address, None] = {}  # in order, each once
    for name in names:
        if name.partition("/")[0] not in others:
            selection = _selection(name.removeprefix(f"{vehicle}/"), vehicle, None)
            chosen |= dict.fromkeys(matching(path, own, selection))
    return chosen


def _explain_absent(
    path: Path, options: ReadOptions, selections: Sequence[Selection], select: _Select
) -> AddressError | None:
    """Return an error with the streams of a file if it lacks a selected one; None if that was not the fault."""
    if options.topics is None or TOPICS.keys() <= {*options.topics}:
        return None
    all_topics = replace(options, topics={*options.topics, *TOPICS})
    flight = open_arrays([path], all_topics, lambda _: False)
    for selection in selections:
        try:
            select(path, flight.addresses, selection)
        except AddressError as exc:
            return exc
    return None


def _selection(name: str, vehicle: str, instance: int | None) -> Selection:
    """Return the selection of a topic, or of a stream such as sensor_gps/1."""
    topic, _, number = name.rpartition("/")
    if number.isdecimal():
        return Selection(topic, vehicle, int(number))
    return Selection(name, vehicle, instance)


def _topics(names: Sequence[str] | None) -> Set[str] | None:
    """Return the topics of streams such as vehicle_attitude, sensor_gps/1 or 7/sensor_gps/1; None for all."""
    if names is None:
        return TOPICS.keys()
    topics = set()
    for name in names:
        parts = [part for part in name.split("/") if not part.isdecimal()]
        if parts:
            topics.add(parts[-1])
        else:
            topics.add(name)
    if ANY in topics:
        return None
    return topics
