"""Messages of a file as NumPy arrays or data frames, with PX4's field types."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nedbus.errors import ArgumentError, SourceError
from nedbus.extras import import_optional
from nedbus.flights import Columns, Decoded, FileStream, ReadOptions, open_reader
from nedbus.timeline import UtcEstimate, UtcOffset, provides_utc
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
    with open_reader(Path(path).expanduser(), ReadOptions(topics=None)) as reader:
        for _ in reader.runs():
            pass
        return sorted(reader.definitions)


class FlightArrays:
    """The messages of one file, read once, as arrays on request.

    `selects`: whether an address may be requested. `definitions`: the definition of each address.
    `start`: when recording began, on the clock of the timestamps [us], 0 if unknown.

    Raises SourceError if the file cannot be read.
    """

    def __init__(self, path: Path, options: ReadOptions, selects: Callable[[Address], bool]) -> None:
        self.path = path
        self._columns = defaultdict[Address, Columns](Columns)
        self._utc = dict[str, UtcOffset | str]()
        self._invalid: dict[Address, str] = {}
        with open_reader(path, options) as reader:
            is_kept = dict[FileStream, bool]()
            for run in reader.runs():
                if (stream := run.stream) not in is_kept:
                    is_kept[stream] = selects(stream.address) or provides_utc(stream.definition)
                if is_kept[stream]:
                    self._columns[stream.address].add(run)
            self._warnings, self.damaged, self._boot_utc = reader.warnings, reader.damaged, reader.boot_utc
            self.definitions = reader.definitions
        self.start = reader.start or self._find_start(selects)
        self.addresses = sorted(self.definitions)

    @property
    def warnings(self) -> list[str]:
        """Damage found and messages skipped so far."""
        return [*self._warnings, *self._invalid.values()]

    def read(self, address: Address) -> tuple[MessageArray, Absent]:
        """Return the valid messages of an address, with a mask of the messages that lack a field, by field.

        The dtype has the names of these fields. Raises SourceError if all messages have another layout than the file
        says.
        """
        messages, valid, absent = self._decode(address)
        if not valid.all():
            reason = self._columns[address].reason
            if reason and not valid.any():
                raise SourceError(str(self.path), f"no message of {address.stream} can be read: {reason}")
            skipped = f"skipped {np.sum(~valid)} of {len(valid)} messages of {address.stream} as invalid"
            self._invalid[address] = f"{skipped} ({reason})" if reason else skipped
            messages, absent = messages[valid], absent[valid]
        masks = {name: absent[name] for name in absent.dtype.names or () if absent[name].any()}
        if masks:
            types = [(name, messages.dtype[name]) for name in self.definitions[address].names]
            messages = messages.view(np.dtype(types, metadata={"missing": tuple(masks)}))
        return messages, masks

    def utc(self, vehicle: str) -> UtcOffset | str:
        """Return the UTC offset of a vehicle, or why it is unknown."""
        if vehicle not in self._utc:
            estimate = UtcEstimate()
            for address in self.addresses:
                if address.vehicle == vehicle and address in self._columns:
                    estimate.add(address.stream, self._decode(address).utc_columns())
            self._utc[vehicle] = estimate.result(self._boot_utc)
        return self._utc[vehicle]

    def _decode(self, address: Address) -> Decoded:
        return self._columns[address].decode(self.definitions[address])

    def _find_start(self, selects: Callable[[Address], bool]) -> int:
        """Return the first log time on the clock of the timestamps [us]; 0 without log times."""
        firsts, ages = list[int](), list[npt.NDArray[np.float64]]()
        for address, columns in self._columns.items():
            if columns.times and selects(address):
                firsts.append(min(columns.times))
                ages.append(np.array(columns.times, float) - self._decode(address).messages["timestamp"].astype(float))
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
        parts = [f"{name}[{index}]" for index in range(values.shape[1])] if values.ndim > 1 else [name]
        for part, each in zip(parts, values.reshape(len(values), len(parts)).T, strict=True):
            if each.dtype.kind == "S":
                column = package.Series(list(map(decode_text, each.tolist())))
            else:
                column = package.Series(np.ascontiguousarray(_to_signed(each)))
            if each.dtype.kind == "M":
                zoned = column.dt.tz_localize if library == "pandas" else column.dt.replace_time_zone
                column = zoned("UTC")
            elif name in absent and library == "polars":
                column = column.scatter(np.flatnonzero(absent[name]), None)
            elif name in absent:
                nullable = column if each.dtype.kind == "f" else column.convert_dtypes()  # floats use NaN
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
