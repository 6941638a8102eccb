"""Messages of a file as NumPy arrays or data frames, with PX4's field types."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from nedbus.errors import ArgumentError, SourceError
from nedbus.extras import import_optional
from nedbus.flights import FIELDS, FileStream, ReadOptions, UtcEstimate, UtcOffset, open_reader
from nedbus_msgs import Address, Definition, decode_text, upgrade_with
from nedbus_msgs.arrays import MessageArray, arrays_of

_MAX_TIME: Final = 2**62  # us; later log times of a damaged file are of no use

_Mask = npt.NDArray[np.bool_]
Absent = Mapping[str, _Mask]  # masks of the messages that lack a field, by field
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
    """Return the addresses in a .ulg log, an .mcap recording or a .tlog; raises the errors of `read`."""
    with open_reader(Path(path).expanduser()) as reader:
        for _ in reader.records():
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
        self._buffers = dict[FileStream, _Buffer]()
        usual = dict[FileStream, tuple[bytearray, int]]()  # data and record size of the only streams of their addresses
        self._invalid: list[str] = []
        buffers = self._buffers
        with open_reader(path, options) as reader:
            for number, (stream, payload, time, error) in enumerate(reader.records()):
                try:
                    data, size = usual[stream]
                    if time is None and len(payload) == size:
                        data += payload  # as `add` does, for a record of a log
                        continue
                except KeyError:
                    usual[stream] = bytearray(), -1
                    if selects(stream.address) or not stream.definition.types.keys().isdisjoint(FIELDS):
                        buffers[stream] = buffer = _Buffer(stream)
                        usual[stream] = buffer.data, buffer.size
                    if len(same := self._buffers_of(stream.address)) > 1:
                        for each in same:
                            each.begin_order()
                            usual[each.stream] = bytearray(), -1
                if stream in buffers:
                    buffers[stream].add({} if error else payload, number, time)
            self._warnings, self.damaged, self.boot_utc = reader.warnings, reader.damaged, reader.boot_utc
            self.definitions = reader.definitions
        self.start = reader.start or self._find_start(selects)
        self.addresses = sorted(self.definitions)

    @property
    def warnings(self) -> list[str]:
        """Damage found and messages skipped so far."""
        return [*self._warnings, *self._invalid]

    def read(self, addresses: Collection[Address]) -> dict[Address, tuple[MessageArray, Absent]]:
        """Return the messages of each address, with a mask of the messages that lack a field, by field.

        Raises SourceError if all messages of an address have another layout than the file says.
        """
        return {address: self._read(address) for address in addresses}

    def utc(self, vehicle: str) -> UtcOffset | str:
        """Return the UTC offset of a vehicle, or why it is unknown."""
        estimate = UtcEstimate()
        for address in self.addresses:
            if address.vehicle == vehicle and self._buffers_of(address):
                estimate.add_array(address.stream, self._decode(address).valid_messages)
        return estimate.result(self.boot_utc)

    def _buffers_of(self, address: Address) -> list[_Buffer]:
        return [each for each in self._buffers.values() if each.stream.address == address]

    def _decode(self, address: Address) -> _Decoded:
        buffers = self._buffers_of(address)
        parts = [each.decode(self.definitions[address]) for each in buffers] or [
            _Decoded.empty(self.definitions[address], 0)
        ]
        if len(parts) == 1:
            return parts[0]
        order = np.argsort(np.concatenate([each.numbers or array("q") for each in buffers]), kind="stable")
        return _Decoded(*(np.concatenate(columns)[order] for columns in zip(*parts, strict=True)))

    def _read(self, address: Address) -> tuple[MessageArray, Absent]:
        """Drop invalid messages, and store the names of missing fields in the dtype."""
        decoded = self._decode(address)
        messages, valid, absent = decoded
        if not valid.all():
            reason = next((each.reason for each in self._buffers_of(address) if each.reason), "")
            if reason and not valid.any():
                raise SourceError(str(self.path), f"no message of {address.stream} can be read: {reason}")
            skipped = f"skipped {np.sum(~valid)} of {len(valid)} messages of {address.stream} as invalid"
            self._invalid.append(f"{skipped} ({reason})" if reason else skipped)
            messages, absent = messages[valid], absent[valid]
        masks = {name: absent[name] for name in absent.dtype.names or () if absent[name].any()}
        if masks:
            types = [(name, messages.dtype[name]) for name in self.definitions[address].names]
            messages = messages.view(np.dtype(types, metadata={"missing": tuple(masks)}))
        return messages, masks

    def _find_start(self, selects: Callable[[Address], bool]) -> int:
        """Return the first log time on the clock of the timestamps [us]; 0 without log times."""
        firsts, ages = list[int](), list[npt.NDArray[np.float64]]()
        for buffer in self._buffers.values():
            if buffer.times and selects(buffer.stream.address):
                firsts.append(min(buffer.times))
                ages.append(
                    np.array(buffer.times, float)
                    - buffer.decode(self.definitions[buffer.stream.address]).messages["timestamp"].astype(float)
                )
        return max(0, min(firsts) - round(np.median(np.concatenate(ages)))) if ages else 0


class _Buffer:
    """The records of one stream, or the fields of its messages, in file order.

    `numbers`: position of each in the file, None while the stream is the only one of its address; `times`: its log time
    [us]. `reason`: why the first unusable one is. `data`, `size`: the records, and the bytes of one.
    """

    def __init__(self, stream: FileStream) -> None:
        self.stream, self.reason = stream, ""
        self.numbers: array[int] | None = None
        self.times, self.data = array("q"), bytearray()
        self._fields, self._unusable = list[Mapping[str, Any]](), list[int]()
        self.size = 0 if stream.dtype is None else np.dtype(stream.dtype).itemsize
        self._decoded: _Decoded | None = None

    def __len__(self) -> int:
        return len(self.data) // self.size if self.size else len(self._fields)

    def begin_order(self) -> None:
        """Store positions from now on, because another stream has the same address; all earlier ones are before."""
        if self.numbers is None:
            self.numbers = array("q", bytes(8 * len(self)))

    def add(self, payload: Any, number: int, time: int | None) -> None:
        """Add a record."""
        if self.numbers is not None:
            self.numbers.append(number)
        if time is not None:
            self.times.append(min(time, _MAX_TIME))
        if not self.size:
            self._fields.append(payload)
        elif len(payload) == self.size and payload.startswith(self.stream.head):
            self.data += payload
        elif reason := self.stream.check(payload):
            self.reason = self.reason or reason
            self._unusable.append(len(self))
            self.data += bytes(self.size)
        else:
            self.data += payload[: self.size]  # PX4 appends bytes

    def decode(self, definition: Definition[Any]) -> _Decoded:
        """Return the messages as those of a definition, once decoded."""
        if self._decoded is None:
            rows = self._fields
            stream = self.stream
            if self.size:
                table: npt.NDArray[np.void] = np.frombuffer(self.data, np.dtype(stream.dtype))
                decoded = _decode_table(stream, table, definition)
                decoded.valid[self._unusable] = False
            else:
                decoded = _decode_rows(definition, rows)
            self._decoded = decoded
        return self._decoded


class _Decoded(NamedTuple):
    """Messages of one definition, a mask of the valid messages, and a mask per field of the messages that lack it."""

    messages: MessageArray
    valid: _Mask
    absent: npt.NDArray[np.void]

    @classmethod
    def empty(cls, definition: Definition[Any], count: int) -> Self:
        """Return `count` invalid messages without any field set."""
        absent = np.zeros(count, [(name, bool) for name in definition.types])
        return cls(arrays_of(definition).absent(count), np.zeros(count, bool), absent)

    @property
    def valid_messages(self) -> MessageArray:
        """The valid messages, with the names of fields that all of them lack in the dtype."""
        messages = self.messages[self.valid]
        missing = tuple(name for name in self.absent.dtype.names or () if self.absent[name].all())
        types = [(name, messages.dtype[name]) for name in messages.dtype.names or ()]
        return messages.view(np.dtype(types, metadata={"missing": missing}))


def _decode_table(stream: FileStream, table: npt.NDArray[np.void], definition: Definition[Any]) -> _Decoded:
    """Decode records, vectorized; fields whose type must be converted one by one."""
    columns = {name: table[name] for name in table.dtype.names or ()}
    plan = definition.plan(tuple(columns))
    messages, valid, absent = decoded = _Decoded.empty(definition, len(table))
    for name in definition.all_fields - (plan.provided - stream.lacking):
        absent[name] = True
    rows = [stream.decode(row.tobytes()) for row in table] if stream.converted else []
    for name, kind in stream.converted.items():
        values = np.array([row.get(name, kind.absent) for row in rows], str if kind.is_text else kind.form[-1])
        columns[name] = np.char.encode(values, "utf-8") if kind.is_text else values
        if name in plan.names:
            absent[name] = [name not in row for row in rows]
    for name, old in plan.names.items():
        messages[name] = columns[old]
    for name, (olds, convert) in plan.converted.items():
        parts = [np.full(len(table), np.nan) if old is None else columns[old] for old in olds]
        messages[name] = [convert(*values) for values in zip(*(part.tolist() for part in parts), strict=True)]
    valid[:] = arrays_of(definition).valid_mask(messages)
    for name, old in plan.names.items():
        if messages[name].dtype.kind in "iu" and messages[name].dtype != columns[old].dtype:
            is_same = messages[name] == columns[old]  # not beyond the range of the field
            valid &= is_same.reshape(len(messages), -1).all(axis=1)
    for name in stream.strict_bools & columns.keys():
        invalid = columns[name].astype(np.int64) >> 1 != 0  # a byte other than 0 and 1
        valid[invalid.reshape(len(messages), -1).any(axis=1)] = False
    return decoded


def _decode_rows(definition: Definition[Any], rows: Collection[Mapping[str, Any]]) -> _Decoded:
    decoded = _Decoded.empty(definition, len(rows))
    for index, fields in enumerate(rows):
        with suppress(ValidationError):
            message = upgrade_with(definition, fields)
            decoded.messages[index], decoded.valid[index] = arrays_of(definition).of([message])[0], True
            for name in definition.all_fields - message.model_fields_set:
                decoded.absent[name][index] = True
    return decoded


def to_dataframe(messages: MessageArray, absent: Absent, library: Library) -> Any:
    """Convert a structured array to a data frame with nulls for absent fields; without a library, return the array."""
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
            is_text = each.dtype.kind == "S"
            column = package.Series(list(map(decode_text, each.tolist())) if is_text else np.ascontiguousarray(each))
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
