"""Incremental parser of a ULog: bytes in, records out."""

import re
import struct
from enum import Enum, auto
from itertools import islice
from typing import Final, NamedTuple

from .layout import Formats
from .records import (  # fmt: skip
    EXACT_SIZES,
    READERS,
    SYNC,
    Damage,
    Data,
    Format,
    Record,
    Subscription,
    Sync,
    Unsubscription,
    read_flags,
    read_header,
)

_START: Final = 16  # bytes before the first record
_HEADER: Final = 3  # bytes of a record: size and type
_DATA_HEADER: Final = 5  # bytes: size, type and message id
_MAX_PADDING: Final = 8  # bytes that a message may have beyond its size; PX4 aligns to 8
_MAX_SUBSCRIPTIONS: Final = 1000  # at a time; a real log has 170
_MAX_SKIPPED: Final = 16  # records of unknown content in a row
_WINDOW: Final = 2**16  # bytes: after damage of this length, records are found
_SAMPLE: Final = 2**12  # bytes of a window that are searched in longer damage
_MIN_DISTANCE: Final = 64  # bytes between two candidates, on average, beyond which no more are judged
_VALUE: Final = rb"[\x05-\xff](?:u?int|float|double|bool|char)"
_CANDIDATE = re.compile(rb"(?s)D|S/s\x13 |A...[A-Za-z]|F[A-Za-z]\w|[IP]%b|[MQ].%b|[CL][0-7]" % (_VALUE, _VALUE))
"""The type of a record, and as much of its content as rules out most other bytes."""
_CONTEXT: Final = 16  # bytes that a candidate can have


class _Judgement(Enum):
    SOUND = auto()  # a record whose content fits its type and size
    OPAQUE = auto()  # a record of unknown type, message id or content, or none: only what follows can tell
    NONE = auto()
    PARTIAL = auto()  # bytes are missing


class _Seen(NamedTuple):
    """A position of the buffer; `record`: None for data."""

    judgement: _Judgement
    stop: int
    record: Record | None = None


class UlogParser:
    """Parse a ULog in pieces of any size; the memory is that of one piece, its definitions, and 256 KiB.

    `verify`: for a file, which has no checksums: messages are returned only if the next record follows them, and after
    damage the next records are searched. Without, lengths are trusted, as those of a transport with checksums.
    `subscriptions`: those whose data can be decoded, by message id.
    `undecodable`: number of messages without a subscription that fits them.
    """

    def __init__(self, *, verify: bool) -> None:
        self.undecodable = 0
        self._verify = verify
        self._formats = Formats()
        self.subscriptions: dict[int, Subscription] = {}
        self._known: dict[bytes, tuple[Subscription, int, int]] = {}
        """By the first five bytes of a record: its subscription, its length, and the length without padding."""
        self._buffer = b""
        self._offset = 0  # of the buffer in the log
        self._boundaries: list[int] | None = None  # offsets of appended data; None before the first record
        self._damage: int | None = None  # offset at which the search for records began
        self._records: list[Record] = []

    def feed(self, data: bytes) -> list[Record]:
        """Return the records that these bytes complete; raise UlogError if it is no ULog, or one of a newer version."""
        self._buffer += data
        return self._parse(is_end=False)

    def gap(self) -> None:
        """Discard a partial record because bytes are missing; the next byte begins a record."""
        self._drop(len(self._buffer))

    def close(self) -> list[Record]:
        """Return the records at the end of the log; raise UlogError if it is no ULog."""
        return self._parse(is_end=True)

    def _parse(self, *, is_end: bool) -> list[Record]:
        if self._boundaries is None:
            self._begin(is_end=is_end)
        while self._boundaries and self._boundaries[0] <= self._offset + len(self._buffer):
            boundary = self._boundaries.pop(0) - self._offset
            rest, self._buffer = self._buffer[boundary:], self._buffer[:boundary]
            self._parse_buffer(is_end=True)
            if self._records and isinstance(last := self._records[-1], Damage) and last.is_end:
                self._records.pop()  # the logger was interrupted here
            self._buffer = rest
        if self._boundaries is not None:
            self._parse_buffer(is_end=is_end)
        records, self._records = self._records, []
        return records

    def _begin(self, *, is_end: bool) -> None:
        kind, content = self._buffer[_START + 2 : _START + _HEADER], _START + _HEADER
        stop = content + int.from_bytes(self._buffer[_START : _START + 2], "little") if kind == b"B" else _START
        if is_end or (kind and stop <= len(self._buffer)):
            header = read_header(self._buffer[:_START])
            self._records.append(header)
            if header.version > 1:
                self._records.append(Damage(f"unknown version {header.version} of the format"))
            offsets = read_flags(self._buffer[content:stop]) if kind == b"B" else ()
            self._boundaries = sorted(offset for offset in offsets if offset >= stop)
            self._drop(min(stop, len(self._buffer)))

    def _drop(self, count: int) -> None:
        self._buffer = self._buffer[count:]
        self._offset += count

    def _parse_buffer(self, *, is_end: bool) -> None:
        at = 0
        after: int | None = 0
        while after is not None and after < len(self._buffer):
            at = after
            if self._damage is None:
                at = self._take_data(at)
                after = self._take_record(at, is_end=is_end)
            else:
                after = self._search(at, is_end=is_end)
        self._drop(at if after is None else after)
        if is_end:
            self._end_damage()

    def _take_data(self, at: int) -> int:
        """Take messages up to the last one in a row, whose successor needs a closer look; return its position."""
        buffer, known, records = self._buffer, self._known, self._records
        make = tuple.__new__  # half the time of calling a NamedTuple
        found = known.get(buffer[at : at + _DATA_HEADER])
        mark = buffer.find(SYNC, at) if found else -1
        while found is not None:
            subscription, length, used = found
            stop = at + length
            found = None if at < mark < stop else known.get(buffer[stop : stop + _DATA_HEADER])
            if found is not None:
                records.append(make(Data, (subscription, buffer[at + _DATA_HEADER : at + used])))
                at = stop
        return at

    def _take_record(self, at: int, *, is_end: bool) -> int | None:
        """Take a record; return the position after it, None if bytes are missing."""
        seen = self._look(at)
        if seen.judgement is _Judgement.PARTIAL and not (is_end and self._verify):
            return self._truncate(at) if is_end else None
        if not self._verify or (seen.judgement is _Judgement.SOUND and seen.record is not None):
            return self._emit(at, seen)
        if seen.judgement is _Judgement.SOUND:
            following = self._look(seen.stop).judgement
            if following is _Judgement.SOUND:
                return self._emit(at, seen)
            if following is _Judgement.PARTIAL and not is_end:
                return None
        return self._settle(at, is_end=is_end)

    def _settle(self, at: int, *, is_end: bool) -> int | None:
        """Take records of unknown content if their lengths lead to the next chain of records; else begin a search."""
        start, found = self._find(at + 1, at + 1 + 2 * _WINDOW, is_end=is_end)
        if found is _Judgement.PARTIAL:
            return None
        passed: list[tuple[int, _Seen]] = []
        place, seen = at, self._look(at)
        while place < start and seen.judgement in (_Judgement.SOUND, _Judgement.OPAQUE):
            passed.append((place, seen))
            place, seen = seen.stop, self._look(seen.stop)
        if place == start if found is _Judgement.SOUND else is_end and self._is_tail(place):
            for each in passed:
                self._emit(*each)
            return start if found is _Judgement.SOUND else self._truncate(place)
        self._damage = self._offset + at
        return at + 1

    def _search(self, at: int, *, is_end: bool) -> int | None:
        """Return the start of the next chain of records, or the end of a window without one."""
        begun = (self._damage or 0) - self._offset  # may be before the buffer
        number = (at - begun - 1) // _WINDOW
        window = begun + 1 + number * _WINDOW
        start, found = self._find(at, window + (_WINDOW if number < 2 else _SAMPLE), is_end=is_end)
        if found is _Judgement.SOUND:
            self._end_damage()
            return start
        return None if found is _Judgement.PARTIAL else min(window + _WINDOW, len(self._buffer))

    def _end_damage(self) -> None:
        if self._damage is not None:
            self._records.append(Damage(f"no record begins at byte {self._damage}"))
            self._damage = None

    def _find(self, start: int, stop: int, *, is_end: bool) -> tuple[int, _Judgement]:
        """Return the first position in a range where a chain of records begins; PARTIAL: more bytes will tell."""
        limit = 1 + max(0, stop - start) // _MIN_DISTANCE
        for found in islice(_CANDIDATE.finditer(self._buffer, start + 2, stop + _CONTEXT), limit):
            at = found.start() - 2
            judgement = self._judge_chain(at, is_end=is_end) if at < stop else _Judgement.NONE
            if judgement is not _Judgement.NONE:
                return at, judgement
        is_whole = is_end or len(self._buffer) >= stop + _CONTEXT
        return min(stop, len(self._buffer)), _Judgement.NONE if is_whole else _Judgement.PARTIAL

    def _judge_chain(self, at: int, *, is_end: bool) -> _Judgement:
        """Judge whether a sound record begins here, and leads to another one; a sync needs no other."""
        seen = self._look(at)
        if seen.judgement is _Judgement.PARTIAL and not is_end:
            return _Judgement.PARTIAL
        if seen.judgement is not _Judgement.SOUND or isinstance(seen.record, Sync):
            return _Judgement.SOUND if isinstance(seen.record, Sync) else _Judgement.NONE
        for _ in range(_MAX_SKIPPED):
            place, seen = seen.stop, self._look(seen.stop)
            if seen.judgement is _Judgement.PARTIAL and is_end:
                return _Judgement.SOUND if self._is_tail(place) else _Judgement.NONE
            if seen.judgement is not _Judgement.OPAQUE:
                return seen.judgement
        return _Judgement.NONE

    def _look(self, at: int) -> _Seen:
        buffer = self._buffer
        known = self._known.get(buffer[at : at + _DATA_HEADER])
        kind, content = buffer[at + 2 : at + _HEADER], at + _HEADER
        stop = content + int.from_bytes(buffer[at : at + 2], "little")
        if kind and not b"!" <= kind <= b"~":  # a type is a printable character, one of a later version, too
            return _Seen(_Judgement.NONE, stop)
        if stop > len(buffer) or not kind:
            return _Seen(_Judgement.PARTIAL, stop)
        if known is not None:  # a sync in the message replaces bytes that were cut out
            return _Seen(_Judgement.OPAQUE if self._verify and SYNC in buffer[at:stop] else _Judgement.SOUND, stop)
        try:
            record = READERS[kind[0]](buffer[content:stop])
        except (ValueError, LookupError, struct.error):
            return _Seen(_Judgement.OPAQUE, stop)
        is_sound = EXACT_SIZES.get(kind[0], stop - content) == stop - content
        return _Seen(_Judgement.SOUND if is_sound else _Judgement.OPAQUE, stop, record)

    def _is_tail(self, at: int) -> bool:
        """Return whether the log may end here, within a record or behind one."""
        head = self._buffer[at : at + _DATA_HEADER]
        if len(head) < _HEADER or head[2] == ord("D"):
            return not head or any(known.startswith(head) for known in self._known)
        return head[2] in READERS

    def _truncate(self, at: int) -> int:
        end = len(self._buffer)
        if at < end:
            self._records.append(Damage("the file ends inside a message", is_end=True))
        return end

    def _emit(self, at: int, seen: _Seen) -> int:
        """Use a record; return the position after it."""
        kind, reason = self._buffer[at + 2], ""
        if seen.record is not None:
            try:
                self._records.extend(self._apply(seen.record))
            except ValueError as exc:
                reason = str(exc)
        elif seen.judgement is _Judgement.SOUND:
            subscription, _, used = self._known[self._buffer[at : at + _DATA_HEADER]]
            self._records.append(Data(subscription, self._buffer[at + _DATA_HEADER : at + used]))
        elif kind == ord("D"):
            self.undecodable += 1
        elif kind in READERS or seen.judgement is _Judgement.NONE:
            reason = f"the record at byte {self._offset + at} is damaged"
        if reason:
            self._records.append(Damage(reason))
        return seen.stop

    def _apply(self, record: Record) -> list[Record]:
        """Store a definition, and return it if it is new; raise ValueError if it cannot be used."""
        if isinstance(record, Subscription):
            old = self.subscriptions.get(record.message_id)
            if old is not None:
                if (old.multi_id, old.name) != (record.multi_id, record.name):
                    raise ValueError(f"the message id of {old.name} is also that of {record.name}, which is ignored")
                return []
            try:
                if len(self.subscriptions) == _MAX_SUBSCRIPTIONS:
                    raise ValueError(f"the log has more than {_MAX_SUBSCRIPTIONS} subscriptions")
                record = record._replace(layout=self._formats.layout(record.name))
            except ValueError as exc:
                raise ValueError(f"{record.name} cannot be decoded: {exc}") from exc
            self.subscriptions[record.message_id] = record
            used = record.layout.size
            for size in range(used, used + min(record.layout.padding, _MAX_PADDING) + 1):
                head = struct.pack("<HBH", size + 2, ord("D"), record.message_id)
                self._known[head] = record, size + _DATA_HEADER, used + _DATA_HEADER
        elif isinstance(record, Format):
            self._formats.add(record.name, record.fields)
        elif isinstance(record, Unsubscription):
            old = self.subscriptions.pop(record.message_id, None)
            self._known = {head: known for head, known in self._known.items() if known[0] is not old}
        return [record]
