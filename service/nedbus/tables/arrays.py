"""Messages of a file as NumPy arrays or data frames, with PX4's field types."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nedbus import Flight
from nedbus.errors import ArgumentError, SourceError
from nedbus.extras import import_optional
from nedbus.flights import ReadOptions, require_utc
from nedbus_msgs import Address, decode_text
from nedbus_msgs.arrays import MessageArray

Absent = Mapping[str, npt.NDArray[np.bool_]]  # masks of the messages that lack a field, by field


class StreamArray(NamedTuple):
    """The messages of a stream as an array, and which of them lack a field, by field."""

    messages: MessageArray
    absent: Absent


Streams = dict[str, StreamArray]  # by topic or topic/instance

Pandas = Literal["pandas"]
Polars = Literal["polars"]
Library = Literal["pandas", "polars"] | None


def missing_of(messages: MessageArray) -> frozenset[str]:
    """Return the fields that some or all of these messages lack; the missing values are NaN, false or 0.

    `read` stores the names in the metadata of the dtype: slices, masks and copies keep them, `numpy.save` does not.
    """
    metadata: Mapping[str, Any] = messages.dtype.metadata or {}
    return frozenset(metadata.get("missing", ()))


def addresses_of(path: str | Path) -> list[Address]:
    """Return the addresses of all streams in a .ulg log, an .mcap recording or a .tlog; raises the errors of `read`.

    It includes messages that only the file defines.
    """
    paths = [Path(path).expanduser()]
    with open_arrays(paths, ReadOptions(topics=None), lambda _: False) as flight:
        return flight.addresses


def open_arrays(
    paths: Sequence[Path], options: ReadOptions, selects: Callable[[Address], bool]
) -> Flight:
    """Read files once, to return the messages of selected addresses as arrays on request.

    Raises SourceError if a file cannot be read.
    """
    flight = Flight(paths, options)
    flight._read_columns(selects)
    return flight


def array_of(flight: Flight, address: Address, *, unix_times: bool = False) -> StreamArray:
    """Return the valid messages of an address, with a mask of the messages that lack a field, by field.

    The dtype has the names of these fields. `unix_times`: their timestamps become Unix times [us].

    Raises SourceError if all messages have another layout than the file says, or if UTC is required, but unknown.
    """
    number, own = flight._find(address)
    reader = flight._readers[number]
    columns = flight._columns[number][own]
    definition = reader.definitions[own]
    messages, valid, absent = columns.decode(definition)
    if not valid.all():
        reason = columns.reason
        if reason and not valid.any():
            raise SourceError(str(reader.path), f"no message of {own.stream} can be read: {reason}")
        count = np.sum(~valid)
        columns.skipped = f"skipped {count} of {len(valid)} messages of {own.stream} as invalid"
        if reason:
            columns.skipped += f" ({reason})"
        messages = messages[valid]
        absent = absent[valid]
    masks = {}
    for name in absent.dtype.names or ():
        if absent[name].any():
            masks[name] = absent[name]
    if masks:
        types = [(name, messages.dtype[name]) for name in definition.names]
        dtype = np.dtype(types, metadata={"missing": tuple(masks)})
        messages = messages.view(dtype)
    if unix_times:
        utc = require_utc(flight, address.vehicle)
        stamps = messages["timestamp"].astype(np.int64)
        messages["timestamp"] = utc.unix_us(stamps)
    return StreamArray(messages, masks)


def array_warnings(flight: Flight) -> list[tuple[Path, str]]:
    """Return damage and skipped messages so far, each with its file."""
    remarks = []
    for reader, streams in zip(flight._readers, flight._columns, strict=True):
        skipped = [columns.skipped for columns in streams.values()]
        for text in (*reader.warnings, *skipped):
            if text:
                remarks.append((reader.path, text))
    return remarks


def recording_start(
    flight: Flight, addresses: Sequence[Address], *, unix_times: bool = False
) -> int:
    """Return when the recording of these addresses began, on the clock of their timestamps [us], 0 if it is unknown.

    `unix_times`: as in `array_of`.
    """
    by_vehicle: dict[str, list[Address]] = {}
    for address in addresses:
        by_vehicle.setdefault(address.vehicle, []).append(address)
    starts = []
    for vehicle, streams in by_vehicle.items():
        start = _start_of_vehicle(flight, streams)
        if start and unix_times:
            utc = require_utc(flight, vehicle)
            start = int(utc.unix_us(start))
        starts.append(start)
    return min(starts, default=0)


def _start_of_vehicle(flight: Flight, addresses: Sequence[Address]) -> int:
    """Return the start of a vehicle's file, or its first message, on the vehicle's clock; 0 without messages."""
    number, _ = flight._find(addresses[0])
    reader = flight._readers[number]
    if reader.start:
        return reader.start
    firsts: list[int] = []
    offsets: list[npt.NDArray[np.float64]] = []  # of the clock of the file to that of the vehicle
    for address in addresses:
        _, own = flight._find(address)
        columns = flight._columns[number][own]
        if columns.times:
            decoded = columns.decode(reader.definitions[own])
            stamps = decoded.messages["timestamp"].astype(float)
            times = np.array(columns.times, float)
            firsts.append(min(columns.times))
            offsets.append(times - stamps)
    if not offsets:
        return 0
    joined = np.concatenate(offsets)
    offset = round(np.median(joined))
    return max(0, min(firsts) - offset)


def to_dataframe(messages: MessageArray, absent: Absent, library: Library) -> Any:
    """Convert a structured array to a data frame with nulls for absent fields; without a library, return the array.

    uint64 becomes int64, because the difference of two times may be negative; see `_to_signed`.
    """
    if library is None:
        return messages
    if library not in ("pandas", "polars"):
        raise ArgumentError("dataframe", library, "pandas or polars")
    package = import_optional(library, library)
    if library == "pandas":
        convert = _pandas_column
    else:
        convert = _polars_column
    columns: dict[str, Any] = {}
    for name in messages.dtype.names or ():
        values = messages[name]
        if values.ndim == 1:
            columns[name] = convert(package.Series, values, absent.get(name))
            continue
        for index in range(values.shape[1]):
            columns[f"{name}[{index}]"] = convert(
                package.Series, values[:, index], absent.get(name)
            )
    data = package.DataFrame(columns)
    if library == "pandas":
        data.attrs["missing"] = sorted(missing_of(messages))
    return data


def _pandas_column(
    series: Any, values: npt.NDArray[Any], absent: npt.NDArray[np.bool_] | None
) -> Any:
    column = series(_plain_values(values))
    if values.dtype.kind == "M":
        return column.dt.tz_localize("UTC")
    if absent is None:
        return column
    if values.dtype.kind != "f":  # floats use NaN
        column = column.convert_dtypes()
    return column.mask(absent)


def _polars_column(
    series: Any, values: npt.NDArray[Any], absent: npt.NDArray[np.bool_] | None
) -> Any:
    column = series(_plain_values(values))
    if values.dtype.kind == "M":
        return column.dt.replace_time_zone("UTC")
    if absent is None:
        return column
    return column.scatter(np.flatnonzero(absent), None)


def _plain_values(values: npt.NDArray[Any]) -> Any:
    """Return values that both libraries accept: texts as str, numbers in one block of memory."""
    if values.dtype.kind == "S":
        return [decode_text(text) for text in values.tolist()]
    return np.ascontiguousarray(_to_signed(values))


def _to_signed(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Convert uint64 to int64, larger values to 2^63 - 1: a negative difference of uint64 wraps to about 2^64."""
    if values.dtype != np.uint64:
        return values
    signed: npt.NDArray[np.int64] = np.minimum(values, np.uint64(2**63 - 1)).astype(np.int64)
    return signed
