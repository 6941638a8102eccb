"""Read streams from one or more files as arrays or data frames."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypedDict, Unpack, overload

from nedbus import Flight
from nedbus.errors import AddressError, SourceError
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
    found = read_streams(path, topic, vehicle=vehicle, instance=instance, layout=layout)
    tables = {
        name: to_dataframe(messages, absent, dataframe)
        for name, (messages, absent) in found.streams.items()
    }
    return (
        next(iter(tables.values()))
        if isinstance(topic, str) and isinstance(path, FlightPath)
        else tables
    )


class ReadStreams(NamedTuple):
    """Streams by name, and their addresses in the flight from which they were read.

    `unix_times`: their timestamps are Unix times, because they are from several files.
    """

    streams: Streams
    flight: Flight
    addresses: list[Address]
    unix_times: bool


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
    names, vehicle = [topics] if isinstance(topics, str) else topics, vehicle_name(vehicle)
    is_one_file = isinstance(path, FlightPath)
    if isinstance(path, FlightPath):
        select = single_match if isinstance(topics, str) else matching
        selections = [_selection(name, vehicle, instance) for name in names or [ANY]]
        options = _options(names, layout, utc=utc)
        flight, chosen = _choose_in_one(Path(path).expanduser(), options, selections, select)
    else:
        flight, chosen = _choose_in_several(
            [Path(each).expanduser() for each in path], names, vehicle, layout
        )
    streams = Streams()
    for address in chosen:
        name = address.stream if is_one_file else f"{address.vehicle}/{address.stream}"
        streams[name] = array_of(flight, address, unix_times=not is_one_file)
    for file, text in array_warnings(flight):
        _log.warning("%s: %s", file, text, extra=about("damaged", source=str(file), reason=text))
    return ReadStreams(streams, flight, chosen, unix_times=not is_one_file)


def read_plotted(
    paths: Sequence[Path], selection: Selection, topics: Collection[str]
) -> tuple[Flight, list[Address]]:
    """Read these topics of one or more files for a plot; return the addresses that a selection chooses.

    Raises the errors of `read`.
    """
    topics = frozenset(topics)
    options = ReadOptions(topics if len(paths) == 1 else topics | _UTC_TOPICS)
    # a vehicle may have another name here
    selects = Selection(selection.topics, instance=selection.instance).matches
    flight = open_arrays(paths, options, selects)
    found = matching(paths[0], flight.addresses, selection)
    return flight, [address for address in found if address.topic in topics]


def _options(names: Sequence[str] | None, layout: str | None, *, utc: bool) -> ReadOptions:
    topics = _topics(names)
    if utc and topics is not None:
        topics = topics | _UTC_TOPICS
    return ReadOptions(topics, layout=layout)


def _choose_in_one(
    path: Path, options: ReadOptions, selections: Sequence[Selection], select: _Select
) -> tuple[Flight, list[Address]]:
    """Read a file; return the addresses of one vehicle that are selected."""
    try:
        flight = open_arrays(
            [path], options, lambda address: any(one.matches(address) for one in selections)
        )
        chosen = dict.fromkeys(
            each for one in selections for each in select(path, flight.addresses, one)
        )
    except (AddressError, SourceError) as exc:
        raise _explain_absent(path, options, selections, select) or exc from None
    require_one_vehicle(path, chosen, selections[0].vehicles[0])
    return flight, [*chosen]


def _choose_in_several(
    paths: Sequence[Path], topics: Sequence[str] | None, vehicle: str, layout: str | None
) -> tuple[Flight, list[Address]]:
    """Read several files; return the selected addresses, vehicle by vehicle."""
    wanted = _topics(topics)
    for topic in wanted or ():
        Selection(topic)  # raises AddressError for a name that no topic can have
    options = _options(topics, layout, utc=True)
    try:
        flight = open_arrays(
            paths, options, lambda address: wanted is None or address.topic in wanted
        )
    except SourceError as exc:
        selections = [Selection(topic) for topic in sorted(wanted or ())]
        raise _explain_absent(Path(exc.source), options, selections, matching) or exc from None
    vehicles = vehicles_of(flight)
    if vehicle not in (ANY, *vehicles):
        raise AddressError("vehicle", vehicle, f"one of {', '.join(sorted(vehicles))}")
    chosen: list[Address] = []
    for name in vehicles:
        others = {*vehicles} - {name}
        own = [
            each.removeprefix(f"{name}/")
            for each in topics or [ANY]
            if each.partition("/")[0] not in others
        ]
        if vehicle not in (ANY, name) or not own:
            continue
        available = [
            each
            for each in flight.addresses
            if each.vehicle == name and (not wanted or each.topic in wanted)
        ]
        selections = [_selection(each, name, None) for each in own]
        path = path_of(flight, name)
        chosen += dict.fromkeys(
            each for one in selections for each in matching(path, available, one)
        )
    return flight, chosen


def _explain_absent(
    path: Path, options: ReadOptions, selections: Sequence[Selection], select: _Select
) -> AddressError | None:
    """Return an error with the streams of a file if it lacks a selected one; None if that was not the fault."""
    if options.topics is None or TOPICS.keys() <= {*options.topics}:
        return None
    flight = open_arrays(
        [path], replace(options, topics={*options.topics, *TOPICS}), lambda _: False
    )
    for one in selections:
        try:
            select(path, flight.addresses, one)
        except AddressError as exc:
            return exc
    return None


def _selection(name: str, vehicle: str, instance: int | None) -> Selection:
    """Return the selection of a topic, or of a stream such as sensor_gps/1."""
    topic, _, number = name.rpartition("/")
    return (
        Selection(topic, vehicle, int(number))
        if number.isdecimal()
        else Selection(name, vehicle, instance)
    )


def _topics(names: Sequence[str] | None) -> Set[str] | None:
    """Return the topics of streams such as vehicle_attitude, sensor_gps/1 or 7/sensor_gps/1; None for all."""
    if names is None:
        return TOPICS.keys()
    parts = [[part for part in name.split("/") if not part.isdecimal()] or [name] for name in names]
    return None if any(part[-1] == ANY for part in parts) else {part[-1] for part in parts}
