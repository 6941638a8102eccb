"""Messages of a flight as columns: runs of records decoded with NumPy, and batches of validated messages."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from nedbus import limits
from nedbus.samples import Batch
from nedbus.timeline import UTC_COLUMNS
from nedbus_msgs import Definition, Provenance, upgrade_with
from nedbus_msgs.arrays import MessageArray, arrays_of

from .readers import FileStream, Run

if TYPE_CHECKING:
    from .flight import FlightMessage

_Mask = npt.NDArray[np.bool_]


class Decoded(NamedTuple):
    """Messages of one definition, a mask of the valid messages, and a mask per field of the messages that lack it."""

    messages: MessageArray
    valid: _Mask
    absent: npt.NDArray[np.void]

    @classmethod
    def empty(cls, definition: Definition[Any], count: int) -> Self:
        """Return `count` invalid messages without any field set."""
        messages = arrays_of(definition).absent(count)
        valid = np.zeros(count, bool)
        absent = np.zeros(count, [(name, bool) for name in definition.types])
        return cls(messages, valid, absent)

    def utc_columns(self) -> dict[str, npt.NDArray[Any]]:
        """Return the columns of the valid messages for `UtcEstimate`, without the fields that all messages lack."""
        fields = self.absent.dtype.names or ()
        columns: dict[str, npt.NDArray[Any]] = {}
        for name in UTC_COLUMNS:
            if name not in fields:
                continue
            if name == "timestamp" or not self.absent[name].all():
                columns[name] = self.messages[name][self.valid]
        return columns


class Columns:
    """The messages of one address in file order.

    `times`: their log times [us], empty for a log. `reason`: why the first unusable one is.
    `skipped`: how many invalid ones were left out, as text; "" if there are none, or before they are read.
    """

    def __init__(self) -> None:
        self.times = array("q")
        self.reason = ""
        self.skipped = ""
        self._parts: dict[FileStream, _Part] = {}
        self._parts_of_runs = array("q")  # the number of the part of each run
        self._lengths = array("q")  # of runs, in messages
        self._decoded: Decoded | None = None

    def __len__(self) -> int:
        return sum(map(len, self._parts.values()))

    def add(self, run: Run) -> None:
        """Add records."""
        part = self._parts.get(run.stream)
        if part is None:
            part = _Part(run.stream, len(self._parts))
            self._parts[run.stream] = part
        self._parts_of_runs.append(part.number)
        self._lengths.append(len(run.payloads))
        self.times.extend([min(time, limits.LATEST_TIME) for time in run.times])
        reason = part.add(run.payloads)
        self.reason = self.reason or reason

    def decode(self, definition: Definition[Any]) -> Decoded:
        """Return the messages as those of a definition, once decoded."""
        if self._decoded is None:
            self._decoded = self._decode(definition)
        return self._decoded

    def _decode(self, definition: Definition[Any]) -> Decoded:
        parts = [part.decode(definition) for part in self._parts.values()]
        if not parts:
            return Decoded.empty(definition, 0)
        if len(parts) == 1:
            return parts[0]
        # The parts follow one another; sorted by part, the messages in file order have these places.
        by_part = np.argsort(np.repeat(self._parts_of_runs, self._lengths), kind="stable")
        in_file_order = np.argsort(by_part)
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return Decoded(*(column[in_file_order] for column in columns))


class _Part:
    """The records of one stream, or the fields of its messages."""

    def __init__(self, stream: FileStream, number: int) -> None:
        self.number = number
        self._stream = stream
        self._data = bytearray()
        self._fields: list[Mapping[str, Any]] = []  # if payloads are no bytes
        self._unusable: list[int] = []
        self._size = 0
        if stream.dtype is not None:
            self._size = np.dtype(stream.dtype).itemsize

    def __len__(self) -> int:
        if not self._size:
            return len(self._fields)
        return len(self._data) // self._size

    def add(self, payloads: Sequence[Any]) -> str:
        """Add records; return why the first unusable one is."""
        if not self._size:
            self._fields += payloads
            return ""
        if self._are_usual(payloads):
            self._data += b"".join(payloads)
            return ""
        first_reason = ""
        for payload in payloads:
            if self._are_usual([payload]):
                reason = None
            else:
                reason = self._stream.check(payload)
            if not reason:
                self._data += payload[: self._size]  # PX4 appends bytes
                continue
            first_reason = first_reason or reason
            self._unusable.append(len(self))
            self._data += bytes(self._size)
        return first_reason

    def _are_usual(self, payloads: Sequence[bytes]) -> bool:
        """Return whether all have the expected size and head; without a head, a file has only such records."""
        head = self._stream.head
        if not head:
            return True
        sizes = {*map(len, payloads)}
        if sizes != {self._size}:
            return False
        return all(payload.startswith(head) for payload in payloads)

    def decode(self, definition: Definition[Any]) -> Decoded:
        """Return the messages as those of a definition."""
        if not self._size:
            return _decode_rows(definition, self._fields)
        table = np.frombuffer(self._data, np.dtype(self._stream.dtype))
        decoded = _decode_table(self._stream, table, definition)
        decoded.valid[self._unusable] = False
        return decoded


def _decode_table(
    stream: FileStream, table: npt.NDArray[np.void], definition: Definition[Any]
) -> Decoded:
    """Decode records, vectorized; fields whose type must be converted one by one."""
    columns = {name: table[name] for name in table.dtype.names or ()}
    plan = definition.plan(tuple(columns))
    decoded = Decoded.empty(definition, len(table))
    messages = decoded.messages
    provided = plan.provided - stream.lacking
    for name in definition.all_fields - provided:
        decoded.absent[name] = True
    for name, converted in _convert_columns(stream, table).items():
        columns[name] = converted.values
        if name in plan.names:
            decoded.absent[name] = converted.absent
    for name, old in plan.names.items():
        messages[name] = columns[old]  # fits: readers convert or refuse types of no layout
    for name, (olds, convert) in plan.converted.items():
        unknown = np.full(len(table), np.nan)
        parts = [unknown if old is None else columns[old] for old in olds]
        rows = zip(*(part.tolist() for part in parts), strict=True)
        messages[name] = [convert(*values) for values in rows]
    decoded.valid[:] = arrays_of(definition).valid_mask(messages)
    for name in stream.strict_bools & columns.keys():
        is_no_bool = columns[name].astype(np.int64) > 1  # a byte that is neither 0 nor 1
        elements = is_no_bool.reshape(len(table), -1)
        is_invalid = elements.any(axis=1)
        decoded.valid[is_invalid] = False
    return decoded


class _Converted(NamedTuple):
    """The values of a field that were converted one by one, and which messages lack it."""

    values: npt.NDArray[Any]
    absent: list[bool]


def _convert_columns(stream: FileStream, table: npt.NDArray[np.void]) -> dict[str, _Converted]:
    """Return the fields whose type must be converted."""
    if not stream.converted:
        return {}
    rows = [stream.decode(row.tobytes()) for row in table]
    columns = {}
    for name, kind in stream.converted.items():
        given = [row.get(name, kind.absent) for row in rows]
        absent = [name not in row for row in rows]
        columns[name] = _Converted(_to_column(kind, given), absent)
    return columns


def _to_column(kind: Any, values: list[Any]) -> npt.NDArray[Any]:
    if kind.is_text:
        return np.char.encode(np.array(values, str), "utf-8")
    return np.array(values, kind.form[-1])


def _decode_rows(definition: Definition[Any], rows: Collection[Mapping[str, Any]]) -> Decoded:
    decoded = Decoded.empty(definition, len(rows))
    arrays = arrays_of(definition)
    for index, fields in enumerate(rows):
        with suppress(ValidationError):
            message = upgrade_with(definition, fields)
            decoded.messages[index] = arrays.of([message])[0]
            decoded.valid[index] = True
            for name in definition.all_fields - message.model_fields_set:
                decoded.absent[name][index] = True
    return decoded


@dataclass(eq=False)
class FlightBatch(Batch):
    """Valid messages of one type from a flight, in the order of their log times."""

    _received: Sequence[int] = field(repr=False)
    _provenances: list[Provenance] = field(repr=False)

    @property
    def received(self) -> npt.NDArray[np.int64]:
        """Log time of each message [ns]."""
        return np.array(self._received, np.int64)

    @property
    def sent(self) -> npt.NDArray[np.int64]:
        """Zeros: files have no time of sending."""
        return np.zeros(len(self), np.int64)

    @property
    def sequence(self) -> npt.NDArray[np.int64]:
        """Only -1: files have no sequence numbers of a publisher."""
        return np.full(len(self), -1, np.int64)

    @property
    def provenances(self) -> list[Provenance]:
        """Provenance of each message: its source and the fields that the source did not provide."""
        return self._provenances


def make_batches(messages: Iterable[FlightMessage]) -> Iterator[FlightBatch]:
    """Yield a batch for each type among these messages."""
    by_definition: dict[Definition[Any], list[FlightMessage]] = {}
    for message in messages:
        by_definition.setdefault(message.definition, []).append(message)
    for definition, own in by_definition.items():
        payloads = b"".join(message.encoded.payload for message in own)
        arrays, _ = arrays_of(definition).decode(payloads)
        addresses = [message.address for message in own]
        distinct = dict.fromkeys(addresses)
        indices = {address: index for index, address in enumerate(distinct)}
        numbers = [indices[address] for address in addresses]
        index = np.array(numbers, np.intp)
        yield FlightBatch(
            arrays,
            definition.model,
            tuple(indices),
            index,
            0,
            [message.received for message in own],
            [message.provenance for message in own],
        )
