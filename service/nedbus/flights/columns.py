"""Messages of a flight as columns: runs of records decoded with NumPy, and batches of validated messages."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from nedbus.samples import Batch
from nedbus.timeline import UTC_COLUMNS
from nedbus_msgs import Address, Definition, Encoded, Provenance, upgrade_with
from nedbus_msgs.arrays import MessageArray, arrays_of

from .readers import FileStream, Run

_MAX_TIME: Final = 2**62  # us; later log times of a damaged file are of no use

_Mask = npt.NDArray[np.bool_]
_Message = tuple[Address, Definition[Any], Encoded, int, Provenance]  # with its log time [ns]


class Decoded(NamedTuple):
    """Messages of one definition, a mask of the valid messages, and a mask per field of the messages that lack it."""

    messages: MessageArray
    valid: _Mask
    absent: npt.NDArray[np.void]

    @classmethod
    def empty(cls, definition: Definition[Any], count: int) -> Self:
        """Return `count` invalid messages without any field set."""
        absent = np.zeros(count, [(name, bool) for name in definition.types])
        return cls(arrays_of(definition).absent(count), np.zeros(count, bool), absent)

    def utc_columns(self) -> dict[str, npt.NDArray[Any]]:
        """Return the columns of the valid messages for `UtcEstimate`, without the fields that all messages lack."""
        known = [name for name in UTC_COLUMNS if name in (self.absent.dtype.names or ())]
        names = [name for name in known if name == "timestamp" or not self.absent[name].all()]
        return {name: self.messages[name][self.valid] for name in names}


class Columns:
    """The messages of one address in file order.

    `times`: their log times [us], empty for a log. `reason`: why the first unusable one is.
    `skipped`: how many invalid ones were left out, as text; "" if there are none, or before they are read.
    """

    def __init__(self) -> None:
        self.times = array("q")
        self.reason = self.skipped = ""
        self._parts: dict[FileStream, _Part] = {}
        # the number of the part, and of the messages, of each run
        self._runs = array("q"), array("q")
        self._decoded: Decoded | None = None

    def __len__(self) -> int:
        return sum(map(len, self._parts.values()))

    def add(self, run: Run) -> None:
        """Add records."""
        part = self._parts.get(run.stream)
        if part is None:
            part = self._parts[run.stream] = _Part(run.stream, len(self._parts))
        self._runs[0].append(part.number)
        self._runs[1].append(len(run.payloads))
        self.times.extend([min(time, _MAX_TIME) for time in run.times])
        reason = part.add(run.payloads)
        self.reason = self.reason or reason

    def decode(self, definition: Definition[Any]) -> Decoded:
        """Return the messages as those of a definition, once decoded."""
        if self._decoded is None:
            found = [each.decode(definition) for each in self._parts.values()] or [
                Decoded.empty(definition, 0)
            ]
            if len(found) == 1:
                self._decoded = found[0]
            else:
                order = np.argsort(np.argsort(np.repeat(*self._runs), kind="stable"))
                self._decoded = Decoded(
                    *(np.concatenate(columns)[order] for columns in zip(*found, strict=True))
                )
        return self._decoded


class _Part:
    """The records of one stream, or the fields of its messages."""

    def __init__(self, stream: FileStream, number: int) -> None:
        self.number, self._stream = number, stream
        self._data, self._fields = bytearray(), list[Mapping[str, Any]]()
        self._unusable: list[int] = []
        self._size = 0 if stream.dtype is None else np.dtype(stream.dtype).itemsize

    def __len__(self) -> int:
        return len(self._data) // self._size if self._size else len(self._fields)

    def add(self, payloads: Sequence[Any]) -> str:
        """Add records; return why the first unusable one is."""
        size = self._size
        head = self._stream.head
        reason = ""
        if not size:
            self._fields += payloads
        elif not head or (
            {*map(len, payloads)} == {size} and all(each.startswith(head) for each in payloads)
        ):
            self._data += b"".join(payloads)  # records without a head have exactly this size
        else:
            for payload in payloads:
                is_usual = len(payload) == size and payload.startswith(head)
                if not is_usual and (unusable := self._stream.check(payload)):
                    reason = reason or unusable
                    self._unusable.append(len(self))
                    self._data += bytes(size)
                else:
                    self._data += payload[:size]  # PX4 appends bytes
        return reason

    def decode(self, definition: Definition[Any]) -> Decoded:
        """Return the messages as those of a definition."""
        if not self._size:
            return _decode_rows(definition, self._fields)
        decoded = _decode_table(
            self._stream, np.frombuffer(self._data, np.dtype(self._stream.dtype)), definition
        )
        decoded.valid[self._unusable] = False
        return decoded


def _decode_table(
    stream: FileStream, table: npt.NDArray[np.void], definition: Definition[Any]
) -> Decoded:
    """Decode records, vectorized; fields whose type must be converted one by one."""
    columns = {name: table[name] for name in table.dtype.names or ()}
    plan = definition.plan(tuple(columns))
    messages, valid, absent = decoded = Decoded.empty(definition, len(table))
    for name in definition.all_fields - (plan.provided - stream.lacking):
        absent[name] = True
    rows = [stream.decode(row.tobytes()) for row in table] if stream.converted else []
    for name, kind in stream.converted.items():
        values = np.array(
            [row.get(name, kind.absent) for row in rows], str if kind.is_text else kind.form[-1]
        )
        columns[name] = np.char.encode(values, "utf-8") if kind.is_text else values
        if name in plan.names:
            absent[name] = [name not in row for row in rows]
    for name, old in plan.names.items():
        messages[name] = columns[old]
    for name, (olds, convert) in plan.converted.items():
        parts = [np.full(len(table), np.nan) if old is None else columns[old] for old in olds]
        messages[name] = [
            convert(*values) for values in zip(*(part.tolist() for part in parts), strict=True)
        ]
    valid[:] = arrays_of(definition).valid_mask(messages)
    for name, old in plan.names.items():
        if messages[name].dtype.kind in "iu" and messages[name].dtype != columns[old].dtype:
            is_same = messages[name] == columns[old]  # not beyond the range of the field
            valid &= is_same.reshape(len(messages), -1).all(axis=1)
    for name in stream.strict_bools & columns.keys():
        invalid = columns[name].astype(np.int64) >> 1 != 0  # a byte other than 0 and 1
        valid[invalid.reshape(len(messages), -1).any(axis=1)] = False
    return decoded


def _decode_rows(definition: Definition[Any], rows: Collection[Mapping[str, Any]]) -> Decoded:
    decoded = Decoded.empty(definition, len(rows))
    for index, fields in enumerate(rows):
        with suppress(ValidationError):
            message = upgrade_with(definition, fields)
            decoded.messages[index] = arrays_of(definition).of([message])[0]
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


def make_batches(messages: Iterable[_Message]) -> Iterator[FlightBatch]:
    """Yield a batch for each type among these messages."""
    by_definition: dict[Definition[Any], list[_Message]] = {}
    for each in messages:
        by_definition.setdefault(each[1], []).append(each)
    for definition, own in by_definition.items():
        addresses, _, encoded, received, provenances = zip(*own, strict=True)
        arrays, _ = arrays_of(definition).decode(b"".join(each.payload for each in encoded))
        indices = {address: index for index, address in enumerate(dict.fromkeys(addresses))}
        index = np.fromiter(map(indices.__getitem__, addresses), np.intp, len(own))
        yield FlightBatch(
            arrays, definition.model, tuple(indices), index, 0, received, list(provenances)
        )
