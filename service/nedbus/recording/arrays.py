"""Messages of a log or recording as NumPy arrays or data frames, with PX4's field types."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from nedbus.errors import ArgumentError, DecodeError
from nedbus.extras import import_optional
from nedbus.ulog import LoggedStream
from nedbus_msgs import TOPICS, Address, Definition, Message, decode_text, decode_with, upgrade_with
from nedbus_msgs.arrays import MessageArray, arrays_of

from .flight_files import find_format
from .ulog_reader import UlogReader

if TYPE_CHECKING:
    from .mcap_reader import RecordedMessage, RecordedStream

_CHUNK: Final = 65536  # messages of a recording decoded at a time

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
    with Flight(Path(path).expanduser()) as flight:
        return flight.addresses


class Flight(ExitStack):
    """A .ulg log, an .mcap recording or a .tlog open for reading: its addresses and their messages.

    `topics`: the topics to read from a log, None for all; `definitions`: the message definition of each address.
    `start`: when recording began, on the clock of the timestamps [us]; for an MCAP file set by `read`.
    `boot_utc`: Unix time of the boot in the file's metadata [us], 0 if unknown.

    Raises SourceError if the file cannot be read.
    """

    def __init__(self, path: Path, *, topics: Collection[str] | None = TOPICS) -> None:
        super().__init__()
        self.definitions: dict[Address, Definition[Any]]
        self._file: Any
        self._payloads = defaultdict[LoggedStream, bytearray](bytearray)  # of a .ulg log
        self._converted = defaultdict[Address, list[_Decoded]](list)  # of a .tlog
        self._invalid: list[str] = []
        self.start = 0
        if (form := find_format(path)) == "mcap":
            reader = import_optional("mcap", f"{__package__}.mcap_reader").RecordingReader(path, vehicle="1")
            self._file = self.enter_context(reader)
            self.definitions = {stream.address: stream.definition for stream in reader.counts}
        elif form == "tlog":  # imported late: this package is below nedbus.sources
            self._file = import_optional("mavlink", "nedbus.sources.mavlink.tlog").TlogReader(path)
            self.definitions = self._file.definitions
            for address, own in _by_address(self._file.messages()):
                self._converted[address].append(_decode_fields(self.definitions[address], own))
        else:
            log = self._file = UlogReader(path, topics=topics, vehicle=None, default_vehicle="1")
            for stream, payload in log.messages():
                self._payloads[stream] += payload
            self.start = log.start
            self.definitions = {address: stream.definition for address, stream in log.streams.items()}
        self.addresses, self.boot_utc = sorted(self.definitions), int(self._file.boot_utc)

    @property
    def warnings(self) -> list[str]:
        """Damage found and messages skipped so far."""
        return [*self._file.warnings, *self._invalid]

    @property
    def damaged(self) -> bool:
        """True if damage has cost messages so far."""
        return bool(self._file.damaged)

    def read(self, addresses: Collection[Address]) -> dict[Address, tuple[MessageArray, Absent]]:
        """Return the messages of each address, with a mask of the messages that lack a field, by field."""
        if isinstance(self._file, UlogReader):
            streams = {address: self._file.streams[address] for address in addresses}
            decoded = ((each, _decode_ulog(stream, self._payloads[stream])) for each, stream in streams.items())
        else:
            parts = self._converted or self._decode_recording(addresses)
            decoded = ((each, _Decoded(*map(np.concatenate, zip(*parts[each], strict=True)))) for each in addresses)
        return {address: self._drop_invalid(address, each) for address, each in decoded}

    def _decode_recording(self, addresses: Collection[Address]) -> dict[Address, list[_Decoded]]:
        parts = {address: [_Decoded.empty(self.definitions[address], 0)] for address in addresses}
        logged, ages = list[int](), list[npt.NDArray[np.float64]]()
        for address, own in _by_address(self._file.messages(parts.keys())):
            decoded = _decode_cdr(self.definitions[address], own)
            parts[address].append(decoded)
            times = [each.logged // 1000 for each in own]
            logged.append(min(times))
            ages.append(times - decoded.messages["timestamp"].astype(float))
        if ages:
            self.start = max(0, min(logged) - round(np.median(np.concatenate(ages))))
        return parts

    def _drop_invalid(self, address: Address, decoded: _Decoded) -> tuple[MessageArray, Absent]:
        """Drop invalid messages, and store the names of missing fields in the dtype."""
        messages, valid, absent = decoded
        if not valid.all():
            self._invalid.append(f"skipped {np.sum(~valid)} of {len(valid)} messages of {address.stream} as invalid")
            messages, absent = messages[valid], absent[valid]
        masks = {name: absent[name] for name in absent.dtype.names or () if absent[name].any()}
        if masks:
            types = [(name, messages.dtype[name]) for name in self.definitions[address].names]
            messages = messages.view(np.dtype(types, metadata={"missing": tuple(masks)}))
        return messages, masks


def _by_address(messages: Iterator[Any]) -> Iterator[tuple[Address, list[Any]]]:
    """Yield the messages of each address, chunk by chunk."""
    while chunk := list(islice(messages, _CHUNK)):
        by_address = defaultdict[Address, list[Any]](list)
        for each in chunk:
            by_address[each.address].append(each)
        yield from by_address.items()


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


def _decode_ulog(stream: LoggedStream, payloads: bytearray) -> _Decoded:
    """Decode messages of a log, vectorized; one by one in streams with fields whose type must be converted."""
    table: npt.NDArray[np.void] = np.frombuffer(payloads, np.dtype(stream.subscription.layout.dtype))
    definition, columns = stream.definition, {name: table[name] for name in stream.names}
    decoded, plan = _Decoded.empty(definition, len(table)), definition.plan(tuple(columns))
    messages = decoded.messages
    for name in definition.all_fields - plan.provided:
        decoded.absent[name] = True
    rows = [stream.decode(row.tobytes()) for row in table] if stream.converted else []
    for name, kind in stream.converted.items():
        values = np.array([row.get(name, kind.absent) for row in rows], str if kind.is_text else kind.form[-1])
        columns[name] = np.char.encode(values, "utf-8") if kind.is_text else values
        if name in plan.names:
            decoded.absent[name] = [name not in row for row in rows]
    for name, old in plan.names.items():
        messages[name] = columns[old]
    for name, (olds, convert) in plan.converted.items():
        parts = [np.full(len(table), np.nan) if old is None else columns[old] for old in olds]
        messages[name] = [convert(*values) for values in zip(*(part.tolist() for part in parts), strict=True)]
    decoded.valid[:] = arrays_of(definition).valid_mask(messages)
    return decoded


def _decode_cdr(definition: Definition[Any], chunk: Sequence[RecordedMessage]) -> _Decoded:
    """Decode CDR messages, vectorized; messages that the vectorized decoder rejects are decoded one by one."""
    arrays = arrays_of(definition)
    decoded = _Decoded.empty(definition, len(chunk))
    by_stream: dict[RecordedStream, list[int]] = {}
    for index, recorded in enumerate(chunk):
        by_stream.setdefault(recorded.stream, []).append(index)
    for stream, rows in by_stream.items():
        known = {name: kind for name, kind in stream.layout.types.items() if name in definition.known_types}
        if known.items() <= definition.types.items():
            payloads = [chunk[index].payload for index in rows]
            decoded.messages[rows], decoded.valid[rows] = arrays.decode_cdr(payloads, stream.layout)
        for name in definition.all_fields - (definition.plan(stream.layout.fields).provided - stream.missing):
            decoded.absent[name][rows] = True
    single: dict[int, Message] = {}
    for index in np.flatnonzero(~decoded.valid).tolist():
        with suppress(DecodeError, ValidationError):
            fields = decode_with(definition, chunk[index].payload, chunk[index].stream.layout)
            single[index] = upgrade_with(definition, fields)
    if single:
        decoded.messages[list(single)] = arrays.of(list(single.values()))
        decoded.valid[list(single)] = True
    return decoded


def _decode_fields(definition: Definition[Any], chunk: Sequence[Any]) -> _Decoded:
    decoded = _Decoded.empty(definition, len(chunk))
    for index, each in enumerate(chunk):
        with suppress(ValidationError):
            message = upgrade_with(definition, each.fields)
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
