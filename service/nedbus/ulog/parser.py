"""Incremental parser of a ULog: bytes in, records out."""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from enum import Enum, auto
from itertools import islice
from types import MappingProxyType
from typing import Final, NamedTuple

from .layout import Formats
from .records import (
    EXACT_SIZES,
    READERS,
    SYNC_MAGIC,
    Added,
    Content,
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

_FILE_HEADER: Final = 16  # bytes
_HEADER: Final = 3  # bytes of a record: size and type
_DATA_HEADER: Final = 5  # bytes: size, type and message id
_MAX_PADDING: Final = 8  # bytes that a message may have beyond its size: PX4 aligns to 8
_MAX_SKIPPED: Final = 16  # records of unknown types in a row
_WINDOW: Final = 2**16  # bytes
_SAMPLE: Final = 2**13  # bytes of each further window in which records are searched, apart from marks
_MAX_CANDIDATES: Final = 1000  # of one window
_CONTEXT: Final = 16  # bytes, the longest that `_CANDIDATE` matches
_SYNC: Final = struct.pack("<HB", len(SYNC_MAGIC), ord("S")) + SYNC_MAGIC
_VALUE_TYPE: Final = rb"[\x05-\xff](?:u?int|float|double|bool|char)"
_CANDIDATE = re.compile(
    rb"(?s)D|S/s\x13 |A...[A-Za-z]|F[A-Za-z]\w|[IP]%b|[MQ].%b|[CL][0-7]" % (_VALUE_TYPE, _VALUE_TYPE)
)
"""The type of a record, and enough of its content to rule out most others."""


class _Judgement(Enum):
    SOUND = auto()
    """A record whose content fits its type and its size."""
    OPAQUE = auto()
    """Perhaps a record, as its length may tell: of an unknown type or message id, or with another content."""
    NONE = auto()
    PARTIAL = auto()
    """Its end is not here yet."""


class _Seen(NamedTuple):
    """A position of the buffer: its judgement, the end of the record, and its content, None for data."""

    judgement: _Judgement
    stop: int
    content: Content | None = None


class _Known(NamedTuple):
    """A subscription, the length of its records, and the length of those without padding."""

    subscription: Subscription
    length: int
    used: int


class UlogParser:
    """Parse a ULog in pieces of any size.

    It keeps the definitions; its memory is that of a piece, and 256 KiB.
    `verify`: for a file, which has no checksums: a message is returned only when another record follows it, and after
    damage the parser searches for the next records. Without, lengths are trusted: for a transport with checksums.
    `undecodable`: number of messages without a usable subscription.
    """

    def __init__(self, *, verify: bool) -> None:
        self.undecodable = 0
        self._verify = verify
        self._formats = Formats()
        self._subscriptions: dict[int, Subscription] = {}
        self._known: dict[bytes, _Known] = {}  # by the first five bytes of a record
        self._unusable: set[str] = set()  # names of topics that were reported
        self._buffer = b""
        self._offset = 0  # of the buffer in the log
        self._began = False
        self._appended: list[int] = []  # offsets at which parsing restarts
        self._damage: int | None = None  # offset at which the current damage began
        self._records: list[Record] = []

    @property
    def subscriptions(self) -> Mapping[int, Subscription]:
        """The subscriptions whose data can be decoded, by message id."""
        return MappingProxyType(self._subscriptions)

    def feed(self, data: bytes) -> list[Record]:
        """Return the records that these bytes complete; raise UlogError if the log must be refused."""
        self._buffer += data
        self._parse(is_end=False)
        return self._take()

    def gap(self) -> None:
        """Discard a partial record, as bytes are missing; the next byte begins a record."""
        self._offset += len(self._buffer)
        self._buffer = b""

    def close(self) -> list[Record]:
        """Return the last records at the end of the log; raise UlogError if it is none."""
        self._parse(is_end=True)
        return self._take()

    def _take(self) -> list[Record]:
        records, self._records = self._records, []
        return records

    def _parse(self, *, is_end: bool) -> None:
        if not self._began and not self._begin(is_end=is_end):
            return
        while self._appended and self._appended[0] <= self._offset + len(self._buffer):
            boundary = self._appended.pop(0) - self._offset
            rest, self._buffer = self._buffer[boundary:], self._buffer[:boundary]
            self._parse_segment(is_end=True)
            if self._records and isinstance(last := self._records[-1], Damage) and last.is_end:
                self._records.pop()  # what was appended begins where the logger was interrupted
            self._buffer = rest
        self._parse_segment(is_end=is_end)

    def _begin(self, *, is_end: bool) -> bool:
        """Read the header and the flags after it; return False if they are not here yet."""
        header, buffer = self._buffer[:_FILE_HEADER], self._buffer
        if len(header) < _FILE_HEADER and not is_end and header[:7] == b"ULog\x01\x12\x35"[: len(header)]:
            return False
        read = read_header(header)
        stop = _FILE_HEADER
        if buffer[18:19] == b"B":
            stop += _HEADER + int.from_bytes(buffer[16:18], "little")
        if (len(buffer) < 19 or len(buffer) < stop) and not is_end:
            return False
        self._records.append(read)
        if read.version > 1:
            self._records.append(Damage(f"unknown version {read.version} of the format", 7, 0))
        if stop > _FILE_HEADER and stop <= len(buffer):
            try:
                flags = read_flags(buffer[_FILE_HEADER + _HEADER : stop])
            except struct.error:
                self._records.append(Damage("its flags are damaged", _FILE_HEADER, stop - _FILE_HEADER))
            else:
                self._records.append(flags)
                self._appended = sorted(each for each in flags.appended if each >= stop)
        self._began = True
        self._drop(min(stop, len(buffer)))
        return True

    def _drop(self, count: int) -> None:
        self._buffer = self._buffer[count:]
        self._offset += count

    def _parse_segment(self, *, is_end: bool) -> None:
        """Parse what is in the buffer; at the end of a segment, all of it."""
        at = 0
        while at < len(self._buffer):
            if self._damage is None:
                at = self._take_data(at)
                after = self._take_one(at, is_end=is_end)
            else:
                after = self._search(at, is_end=is_end)
            if after is None:
                break
            at = after
        self._drop(at)

    def _take_data(self, at: int) -> int:
        """Take messages while another one follows each; return the position of the first that needs a closer look."""
        buffer, known, records = self._buffer, self._known, self._records
        found = known.get(buffer[at : at + _DATA_HEADER])
        while found is not None:
            subscription, length, used = found
            stop = at + length
            found = known.get(buffer[stop : stop + _DATA_HEADER])
            if found is not None:
                records.append(Data(subscription, buffer[at + _DATA_HEADER : at + used]))
                at = stop
        return at

    def _take_one(self, at: int, *, is_end: bool) -> int | None:
        """Take the record at a position; return the position after it, None if bytes are missing."""
        seen = self._look(at)
        if seen.judgement is _Judgement.PARTIAL and not is_end:
            return None
        if seen.judgement is _Judgement.SOUND and not (self._verify and seen.content is None):
            return self._emit(at, seen)
        if not self._verify:
            return self._emit(at, seen) if seen.judgement is not _Judgement.PARTIAL else self._truncate(at)
        if seen.judgement is _Judgement.SOUND:
            following = self._look(seen.stop).judgement
            if following is _Judgement.SOUND:
                return self._emit(at, seen)
            if following is _Judgement.PARTIAL and not is_end:
                return None
        return self._settle(at, is_end=is_end)

    def _settle(self, at: int, *, is_end: bool) -> int | None:
        """Take records of unknown content if their lengths lead to the next chain of records; else begin a search."""
        whole = at + 1 + 2 * _WINDOW
        start, found = self._find(at + 1, whole, is_end=is_end)
        if not is_end and (found is _Judgement.PARTIAL or (found is _Judgement.NONE and len(self._buffer) < whole)):
            return None
        passed: list[tuple[int, _Seen]] = []
        place = at
        while place < start:
            seen = self._look(place)
            if seen.judgement in (_Judgement.NONE, _Judgement.PARTIAL):
                break
            passed.append((place, seen))
            place = seen.stop
        if place == start if found is _Judgement.SOUND else is_end and self._is_tail(place):
            for each in passed:
                self._emit(*each)
            return start if found is _Judgement.SOUND else self._truncate(place)
        self._damage = self._offset + at
        return at + 1

    def _search(self, at: int, *, is_end: bool) -> int | None:
        """Return the start of the next chain of records, or the position up to which there is none.

        In a long damage only marks, and chains in the first part of each window, are searched.
        """
        assert self._damage is not None  # noqa: S101 - for mypy: it is called during damage only
        begun = self._damage - self._offset  # may lie before the buffer
        number = (at - begun - 1) // _WINDOW
        window = begun + 1 + number * _WINDOW
        stop = window + _WINDOW
        start, found = self._find(at, stop if number < 2 else window + _SAMPLE, is_end=is_end)
        if found is _Judgement.NONE and number >= 2:
            mark = self._buffer.find(_SYNC, at, stop + len(_SYNC))
            start, found = (mark, _Judgement.SOUND) if mark >= 0 else (start, found)
        if not is_end and (found is _Judgement.PARTIAL or (found is _Judgement.NONE and len(self._buffer) < stop)):
            return None
        end = start if found is _Judgement.SOUND else min(stop, len(self._buffer))
        if found is _Judgement.SOUND or end == len(self._buffer):
            self._records.append(Damage(f"no record begins at byte {self._damage}", self._damage, end - begun))
            self._damage = None
        return end

    def _find(self, start: int, stop: int, *, is_end: bool) -> tuple[int, _Judgement]:
        """Return the first position in a range at which a chain of records begins, may begin, or `stop` for none."""
        for found in islice(_CANDIDATE.finditer(self._buffer, start + 2, stop + _CONTEXT), _MAX_CANDIDATES):
            at = found.start() - 2
            judgement = self._judge_chain(at, is_end=is_end) if at < stop else _Judgement.NONE
            if judgement is not _Judgement.NONE:
                return at, judgement
        return min(stop, len(self._buffer)), _Judgement.NONE

    def _judge_chain(self, at: int, *, is_end: bool) -> _Judgement:
        """Judge whether a sound record begins here, and another one follows; between them may be unknown ones."""
        seen = self._look(at)
        if seen.judgement is not _Judgement.SOUND or isinstance(seen.content, Sync):
            return _Judgement.NONE if seen.judgement is _Judgement.OPAQUE or is_end else seen.judgement
        for _ in range(_MAX_SKIPPED):
            place = seen.stop
            seen = self._look(place)
            if seen.judgement is _Judgement.PARTIAL and is_end:
                return _Judgement.SOUND if self._is_tail(place) else _Judgement.NONE
            if seen.judgement is not _Judgement.OPAQUE:
                return seen.judgement
        return _Judgement.NONE

    def _look(self, at: int) -> _Seen:
        """Judge a position of the buffer."""
        buffer = self._buffer
        known = self._known.get(buffer[at : at + _DATA_HEADER])
        if known is not None:
            stop = at + known.length
            return _Seen(_Judgement.SOUND if stop <= len(buffer) else _Judgement.PARTIAL, stop)
        stop = at + _HEADER + int.from_bytes(buffer[at : at + 2], "little")
        kind = buffer[at + 2 : at + 3]
        if kind and not kind.isalpha():
            return _Seen(_Judgement.NONE, stop)
        if stop > len(buffer):
            return _Seen(_Judgement.PARTIAL, stop)
        reader, size = READERS.get(kind[0]), stop - at - _HEADER
        try:
            content = reader(buffer[at + _HEADER : stop]) if reader else None
        except (ValueError, LookupError, struct.error):
            content = None
        is_sound = content is not None and size == EXACT_SIZES.get(kind[0], size)
        if isinstance(content, Added):
            is_sound = content.name in self._formats
        elif isinstance(content, Unsubscription):
            is_sound = is_sound and content.message_id in self._subscriptions
        return _Seen(_Judgement.SOUND if is_sound else _Judgement.OPAQUE, stop, content)

    def _is_tail(self, at: int) -> bool:
        """Return whether the log may end here, inside of a record or after one."""
        head = self._buffer[at : at + _DATA_HEADER]
        if len(head) < _HEADER or head[2] == ord("D"):
            return not head or any(known.startswith(head) for known in self._known)
        return head[2] in READERS

    def _truncate(self, at: int) -> int:
        """Report a record that the log ends in."""
        end = len(self._buffer)
        if at < end:
            self._records.append(Damage("the file ends inside a message", self._offset + at, end - at, is_end=True))
        return end

    def _emit(self, at: int, seen: _Seen) -> int:
        """Return the record at a position; return the position after it."""
        kind, offset, content = self._buffer[at + 2], self._offset + at, seen.content
        problem = ""
        if content is not None:
            problem = self._apply(content)
        elif seen.judgement is _Judgement.SOUND:
            subscription, _, used = self._known[self._buffer[at : at + _DATA_HEADER]]
            self._records.append(Data(subscription, self._buffer[at + _DATA_HEADER : at + used]))
        elif kind == ord("D"):
            self.undecodable += 1
        elif kind in READERS or seen.judgement is _Judgement.NONE:
            problem = f"the record at byte {offset} is damaged"
        if problem:
            self._records.append(Damage(problem, offset, seen.stop - at))
        return seen.stop

    def _apply(self, content: Content) -> str:
        """Store a definition, and return a record with its content, or the reason not to."""
        record: Record | None
        try:
            if isinstance(content, Format):
                self._formats.add(content.name, content.fields)
            record = self._subscribe(content) if isinstance(content, Added) else content
        except ValueError as exc:
            return str(exc)
        if isinstance(content, Unsubscription):
            self._unsubscribe(content.message_id)
        if record is not None:
            self._records.append(record)
        return ""

    def _subscribe(self, added: Added) -> Subscription | None:
        """Add a subscription; return None for one that is known, or was reported as unusable."""
        old = self._subscriptions.get(added.message_id)
        if old is not None:
            if (old.multi_id, old.name) == (added.multi_id, added.name):
                return None
            raise ValueError(f"the message id of {old.name} is also that of {added.name}, which is ignored")
        try:
            layout = self._formats.layout(added.name)
        except ValueError as exc:
            if added.name in self._unusable:
                return None
            self._unusable.add(added.name)
            raise ValueError(f"{added.name} cannot be decoded: {exc}") from exc
        subscription = Subscription(added.message_id, added.multi_id, added.name, layout)
        self._subscriptions[added.message_id] = subscription
        for size in range(layout.size, layout.size + min(layout.padding, _MAX_PADDING) + 1):
            head = struct.pack("<HBH", size + 2, ord("D"), added.message_id)
            self._known[head] = _Known(subscription, size + _DATA_HEADER, layout.size + _DATA_HEADER)
        return subscription

    def _unsubscribe(self, message_id: int) -> None:
        old = self._subscriptions.pop(message_id, None)
        if old is not None:
            self._known = {head: known for head, known in self._known.items() if known.subscription is not old}
