"""Messages of a file as NumPy arrays or data frames, with PX4's field types."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nedbus import Flight
from nedbus.errors import ArgumentError, SourceError
from nedbus.extras import import_optional
from nedbus.flights import ReadOptions, require_utc
from nedbus_msgs import Address, decode_text
from nedbus_msgs.arrays import MessageArray

Absent = Mapping[str, npt.NDArray[np.bool_]]  # masks of the messages that lack a field, by field
Streams = dict[str, tuple[MessageArray, Absent]]  # by topic or topic/instance

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
    with open_arrays(
        [Path(path).expanduser()], ReadOptions(topics=None), lambda _: False
    ) as flight:
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


def array_of(
    flight: Flight, address: Address, *, unix_times: bool = False
) -> tuple[MessageArray, Absent]:
    """Return the valid messages of an address, with a mask of the messages that lack a field, by field.

    The dtype has the names of these fields. `unix_times`: their timestamps become Unix times [us].

    Raises SourceError if all messages have another layout than the file says, or if UTC is required, but unknown.
    """
    number, own = flight._find(address)
    reader, columns = flight._readers[number], flight._columns[number][own]
    definition = reader.definitions[own]
    messages, valid, absent = columns.decode(definition)
    if not valid.all():
        reason = columns.reason
        if reason and not valid.any():
            raise SourceError(str(reader.path), f"no message of {own.stream} can be read: {reason}")
        skipped = f"skipped {np.sum(~valid)} of {len(valid)} messages of {own.stream} as invalid"
        columns.skipped = f"{skipped} ({reason})" if reason else skipped
        messages, absent = messages[valid], absent[valid]
    masks = {name: absent[name] for name in absent.dtype.names or () if absent[name].any()}
    if masks:
        types = [(name, messages.dtype[name]) for name in definition.names]
        messages = messages.view(np.dtype(types, metadata={"missing": tuple(masks)}))
    if unix_times:
        utc = require_utc(flight, address.vehicle)
        messages["timestamp"] = utc.unix_us(messages["timestamp"].astype(np.int64))
    return messages, masks


def array_warnings(flight: Flight) -> list[tuple[Path, str]]:
    """Return damage and skipped messages so far, each with its file."""
    found = []
    for reader, columns in zip(flight._readers, flight._columns, strict=True):
        found += [(reader.path, text) for text in reader.warnings]
        found += [(reader.path, own.skipped) for own in columns.values() if own.skipped]
    return found


def recording_start(
    flight: Flight, addresses: Sequence[Address], *, unix_times: bool = False
) -> int:
    """Return when the recording of these addresses began, on the clock of their timestamps [us], 0 if it is unknown.

    `unix_times`: as in `array_of`.
    """
    starts = []
    for vehicle in {address.vehicle for address in addresses}:
        start = _start_of_vehicle(flight, [each for each in addresses if each.vehicle == vehicle])
        if start and unix_times:
            start = int(require_utc(flight, vehicle).unix_us(start))
        starts.append(start)
    return min(starts, default=0)


def _start_of_vehicle(flight: Flight, addresses: Sequence[Address]) -> int:
    number, _ = flight._find(addresses[0])
    reader = flight._readers[number]
    if reader.start:
        return reader.start
    firsts, ages = list[int](), list[npt.NDArray[np.float64]]()
    for address in addresses:
        _, own = flight._find(address)
        columns = flight._columns[number][own]
        if columns.times:
            stamps = columns.decode(reader.definitions[own]).messages["timestamp"]
            firsts.append(min(columns.times))
            ages.append(np.array(columns.times, float) - stamps.astype(float))
    return max(0, min(firsts) - round(np.median(np.concatenate(ages)))) if ages else 0


def to_dataframe(messages: MessageArray, absent: Absent, library: Library) -> Any:
    """Convert a structured array to a data frame with nulls for absent fields; without a library, return the array.

    uint64 becomes int64, because the difference of two times may be negative; see `_to_signed`.
    """
    if library is None:
        return messages
    if library not in ("pandas", "polars"):
        raise ArgumentError("dataframe", library, "pandas or polars")
    package = import_optional(library, library)
    columns: dict[str, Any] = {}
    for name in messages.dtype.names or ():
        values = messages[name]
        parts = (
            [f"{name}[{index}]" for index in range(values.shape[1])] if values.ndim > 1 else [name]
        )
        for part, each in zip(parts, values.reshape(len(values), len(parts)).T, strict=True):
            if each.dtype.kind == "S":
                column = package.Series(list(map(decode_text, each.tolist())))
            else:
                column = package.Series(np.ascontiguousarray(_to_signed(each)))
            if each.dtype.kind == "M":
                zoned = (
                    column.dt.tz_localize if library == "pandas" else column.dt.replace_time_zone
                )
                column = zoned("UTC")
            elif name in absent and library == "polars":
                column = column.scatter(np.flatnonzero(absent[name]), None)
            elif name in absent:
                # floats use NaN
                nullable = column if each.dtype.kind == "f" else column.convert_dtypes()
                column = nullable.mask(absent[name])
            columns[part] = column
    data = package.DataFrame(columns)
    if library == "pandas":
        data.attrs["missing"] = sorted(missing_of(messages))
    return data


def _to_signed(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Convert uint64 to int64, larger values to 2^63 - 1: a negative difference of uint64 wraps to about 2^64."""
    if values.dtype != np.uint64:
        return values
    signed: npt.NDArray[np.int64] = np.minimum(values, np.uint64(2**63 - 1)).astype(np.int64)
    return signed
