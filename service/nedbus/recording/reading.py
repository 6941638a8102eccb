"""Read streams from one or more files as arrays or data frames."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack, overload

import numpy as np

from nedbus.errors import SourceError
from nedbus.log_event import about
from nedbus_msgs import ANY, DEFAULT_TOPIC, TOPICS, Address, Selection, vehicle_name
from nedbus_msgs.arrays import MessageArray

from .arrays import Flight, Library, Pandas, Polars, Streams, addresses_of, to_dataframe
from .flight_files import distinct_names, matching, require_one_vehicle, single_match
from .utc import find_utc

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl

_log = logging.getLogger(__name__)

FlightPath = str | Path
_Files = FlightPath | Sequence[FlightPath]
_Topics = list[str] | tuple[str, ...]


class _Filter(TypedDict, total=False):
    vehicle: str | int
    instance: int | None


@overload
def read(path: FlightPath, topic: str = ..., *, dataframe: None = None, **stream: Unpack[_Filter]) -> MessageArray: ...
@overload
def read(path: FlightPath, topic: str = ..., *, dataframe: Pandas, **stream: Unpack[_Filter]) -> pd.DataFrame: ...
@overload
def read(path: FlightPath, topic: str = ..., *, dataframe: Polars, **stream: Unpack[_Filter]) -> pl.DataFrame: ...
@overload
def read(
    path: _Files, topic: _Topics, *, dataframe: None = None, **stream: Unpack[_Filter]
) -> dict[str, MessageArray]: ...
@overload
def read(path: _Files, topic: _Topics, *, dataframe: Pandas, **stream: Unpack[_Filter]) -> dict[str, pd.DataFrame]: ...
@overload
def read(path: _Files, topic: _Topics, *, dataframe: Polars, **stream: Unpack[_Filter]) -> dict[str, pl.DataFrame]: ...
def read(
    path: _Files,
    topic: str | _Topics = DEFAULT_TOPIC,
    *,
    vehicle: str | int = ANY,
    instance: int | None = None,
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
    A list of files returns a dict by vehicle and stream, with `timestamp` in Unix time [us]; a vehicle that is in
    several files is named after its file.

    Raises SourceError if a file cannot be read, or is one of several and has no UTC; AddressError if no stream or
    several streams match topic, vehicle and instance; ConfigError if the package that reads the file is not installed.
    """
    streams, _ = read_streams(path, topic, vehicle=vehicle, instance=instance)
    tables = {name: to_dataframe(messages, absent, dataframe) for name, (messages, absent) in streams.items()}
    return next(iter(tables.values())) if isinstance(topic, str) and isinstance(path, FlightPath) else tables


def read_streams(
    path: _Files, topics: str | Sequence[str] | None, *, vehicle: str | int, instance: int | None = None
) -> tuple[Streams, int]:
    """Return the streams of one vehicle, or of several files, and the start of recording [us].

    `topics`: None selects all streams, or in a log the streams of all topics known to nedbus.
    """
    if not isinstance(path, FlightPath):
        names = [topics] if isinstance(topics, str) else topics
        return _read_several([Path(each).expanduser() for each in path], names, vehicle_name(vehicle))
    path, vehicle = Path(path).expanduser(), vehicle_name(vehicle)
    names = [ANY] if topics is None else [topics] if isinstance(topics, str) else topics
    wanted = {name.partition("/")[0] for name in names}
    with Flight(path, topics=None if ANY in wanted and topics is not None else wanted | TOPICS.keys()) as flight:
        chosen: dict[Address, None] = {}
        for name in names:
            topic, _, number = name.rpartition("/")
            parts = (topic, vehicle, int(number)) if number.isdecimal() else (name, vehicle, instance)
            select = single_match if isinstance(topics, str) else matching
            chosen |= dict.fromkeys(select(path, flight.addresses, Selection(*parts)))
        require_one_vehicle(path, chosen, vehicle)
        streams = {address.stream: found for address, found in flight.read(chosen).items()}
        for warning in flight.warnings:
            _log.warning("%s: %s", path, warning, extra=about("damaged", source=str(path), reason=warning))
    return streams, flight.start


def _read_several(paths: Sequence[Path], topics: Sequence[str] | None, vehicle: str) -> tuple[Streams, int]:
    """Return the messages of several files by vehicle and stream, with Unix times."""
    flights = [(path, {address.vehicle for address in addresses_of(path)}) for path in paths]
    files = zip(paths, distinct_names(flights), strict=True)
    named = [(path, own, name) for path, names in files for own, name in names.items()]
    streams, starts = Streams(), list[int]()
    for path, own, name in named:
        others = {each for _, _, each in named if each != name}
        wanted = topics and [each.removeprefix(f"{name}/") for each in topics if each.partition("/")[0] not in others]
        if vehicle not in (ANY, name) or wanted == []:
            continue
        if isinstance(utc := find_utc(path, vehicle=own), str):
            reason = utc or "no message contains UTC"
            raise SourceError(str(path), f"{reason}, which reading several files requires; read it alone")
        found, start = read_streams(path, wanted, vehicle=own)
        starts.append(int(utc.unix_us(start)) if start else 0)
        for stream, (messages, absent) in found.items():
            messages["timestamp"] = utc.unix_us(messages["timestamp"].astype(np.int64))
            streams[f"{name}/{stream}"] = messages, absent
    return streams, min(starts, default=0)
