"""Incremental ULog parser: bytes in, records out."""

import re
import struct
from collections.abc import Collection, Iterator
from dataclasses import replace
from itertools import islice
from typing import Final, Literal, NamedTuple

from nedbus import limits

from .layout import Formats, PayloadLayout
from .records import (
    EXACT_SIZES,
    READERS,
    SYNC,
    Damage,
    Data,
    Format,
    Record,
    Subscription,
    Sync,
    UlogError,
    Unsubscription,
    read_flags,
    read_header,
)

_START: Final = 16  # bytes before the first record
_HEADER: Final = 3  # bytes of a record: size and type
_DATA_HEADER: Final = 5  # bytes: size, type and message id
_PADDING: Final = 8  # bytes of trailing padding in a message at most; PX4 aligns to 8
_SKIPPED: Final = 16  # consecutive records of unknown content that a chain may have
# bytes of a chain of records before its last one; a record has up to 65,538
_CHAIN: Final = 2**16
_WINDOW: Final = 2**16  # bytes; damage of up to twice this length is searched completely
_SAMPLE: Final = 2**12  # bytes searched of each further window
_DISTANCE: Final = 64  # bytes per candidate, on average; denser data is searched only in part
_VALUE: Final = rb"[\x05-\xff](?:u?int|float|double|bool|char)"
_CANDIDATE = re.compile(
    rb"(?s)D|S/s\x13 |A...[A-Za-z]|F[A-Za-z]\w|[IP]%b|[MQ].%b|[CL][0-7]" % (_VALUE, _VALUE)
)
"""The type of a record, and enough of its content to rule out most other bytes."""
_CONTEXT: Final = 16  # maximum bytes of a candidate

_Validity = Literal["valid", "unknown", "invalid", "incomplete"]
"""Valid: the content matches type and size. Unknown: the following bytes decide. Incomplete: more bytes are needed."""


class _Inspection(NamedTuple):
    """Result for one position of the buffer; `stop`: end of the record; `record`: None for data."""

    validity: _Validity
    stop: int
    record: Record | None = None


# What to do with the data messages that begin with some five bytes: their subscription (None: not returned), their
# length, the length without padding, and the list to which payloads are added instead.
# A plain tuple, because each message unpacks one, and a NamedTuple is unpacked through an iterator.
_Route = tuple[Subscription | None, int, int, list[bytes] | None]


class UlogParser:
    """Parse a ULog in chunks of any size; between chunks, hold the definitions and less than 257 KiB of data.

    `verify`: return a message only if a valid record follows it, and resynchronise after damage; for files, which have
    no checksums. Without it, the lengths are trusted, and less than 65 KiB held; for transports with checksums.
    `topics`: those whose data messages are returned, None for all; others are only checked.
    `subscriptions`: the current ones with a decodable format, by message id.
    `undecodable`: number of data messages without a matching subscription; `mismatched`: those of another length.
    """

    def __init__(self, *, verify: bool, topics: Collection[str] | None = None) -> None:
        self.undecodable = 0
        self.mismatched = 0
        self._verify = verify
        self._topics = topics
        self._is_readable = True
        self._formats = Formats()
        self.subscriptions: dict[int, Subscription] = {}
        self._ended: dict[tuple[str, int], list[Subscription]] = {}  # by topic and instance
        self._collected: dict[str, list[int]] = {}  # message ids with a list of payloads, by topic
        self._count = 0  # of subscriptions that do not continue an ended one
        self._known: dict[bytes, _Route] = {}  # by the first five bytes of a data message
        self._buffer = b""
        # position in the buffer of the next sync, or the end; before the current record if unknown
        self._sync = -1
        self._offset = 0  # offset of the buffer in the log
        # offsets of appended data; None before the first record
        self._boundaries: list[int] | None = None
        self._damage: int | None = None  # offset at which the search for records began
        self._records: list[Record] = []

    def feed(self, data: bytes) -> list[Record]:
        """Return the records that these bytes complete.

        Raises UlogError if the data is not a readable ULog; after that, all data is discarded.
        """
        if self._is_readable:
            self._buffer += data
        return self._parse(is_end=False)

    def collect(self, subscription: Subscription) -> list[bytes]:
        """Return a list to which the payloads of a subscription are added from now on, instead of being returned.

        This ends with the next subscription to its topic; the messages after that are returned again.
        """
        payloads: list[bytes] = []
        for message_id, current in self.subscriptions.items():
            if current is subscription:
                self._collected.setdefault(subscription.name, []).append(message_id)
                self._route(message_id, payloads)
        return payloads

    def gap(self) -> None:
        """Discard a partial record after a loss of bytes; the next byte must begin a record."""
        self._drop(len(self._buffer))

    def close(self) -> list[Record]:
        """Return the remaining records at the end of the log; raise UlogError if it is not a ULog."""
        return self._parse(is_end=True)

    def _parse(self, *, is_end: bool) -> list[Record]:
        if self._boundaries is None:
            try:
                self._begin(is_end=is_end)
            except UlogError:
                self._is_readable = False
                self._boundaries = []
                self._buffer = b""
                self._records = []
                raise
        while self._boundaries and self._boundaries[0] <= self._offset + len(self._buffer):
            boundary = self._boundaries.pop(0) - self._offset
            rest = self._buffer[boundary:]
            self._buffer = self._buffer[:boundary]
            self._parse_buffer(is_end=True)
            last = self._records[-1] if self._records else None
            if isinstance(last, Damage) and last.is_end:
                self._records.pop()  # the logger was interrupted here
            self._buffer = rest
        if self._boundaries is not None:
            self._parse_buffer(is_end=is_end)
        records = self._records
        self._records = []
        return records

    def _begin(self, *, is_end: bool) -> None:
        """Read the header, and the flags that may follow; do nothing if they are incomplete."""
        kind = self._buffer[_START + 2 : _START + _HEADER]
        content = _START + _HEADER
        stop = _START
        if kind == b"B":
            stop = content + int.from_bytes(self._buffer[_START : _START + 2], "little")
        is_complete = kind and stop <= len(self._buffer)
        if not is_complete and not is_end:
            return
        header = read_header(self._buffer[:_START])
        self._records.append(header)
        if header.version > 1:
            self._records.append(Damage(f"unknown version {header.version} of the ULog format"))
        offsets: tuple[int, ...] = ()
        if kind == b"B":
            offsets = read_flags(self._buffer[content:stop])
        self._boundaries = sorted(offset for offset in offsets if offset >= stop)
        self._drop(min(stop, len(self._buffer)))

    def _drop(self, count: int) -> None:
        self._buffer = self._buffer[count:]
        self._offset += count

    def _parse_buffer(self, *, is_end: bool) -> None:
        self._sync = -1
        at = 0
        after: int | None = 0
        while after is not None and after < len(self._buffer):
            at = after
            if self._damage is None:
                at = self._consume_data(at)
                after = self._consume_record(at, is_end=is_end)
            else:
                after = self._search(at, is_end=is_end)
        self._drop(at if after is None else after)
        if is_end:
            self._end_damage()

    def _consume_data(self, at: int) -> int:
        """Consume consecutive data messages except the last, whose successor needs inspection; return its position."""
        buffer = self._buffer
        known = self._known
        records = self._records
        make = tuple.__new__  # needs half the time of a NamedTuple's constructor
        route = known.get(buffer[at : at + _DATA_HEADER])
        if route and self._sync < at:
            self._sync = buffer.find(SYNC, at)
            if self._sync < 0:
                self._sync = len(buffer)
        sync = self._sync
        while route is not None:
            subscription, length, used, payloads = route
            stop = at + length
            if at < sync < stop:  # bytes are missing
                break
            route = known.get(buffer[stop : stop + _DATA_HEADER])
            if route is not None:
                if payloads is not None:
                    payloads.append(buffer[at + _DATA_HEADER : at + used])
                elif subscription is not None:
                    payload = buffer[at + _DATA_HEADER : at + used]
                    records.append(make(Data, (subscription, payload)))
                at = stop
        return at

    def _consume_record(self, at: int, *, is_end: bool) -> int | None:
        """Consume a record; return the position after it, None if more bytes are needed."""
        inspected = self._inspect(at)
        if inspected.validity == "incomplete" and not (is_end and self._verify):
            return self._truncate(at) if is_end else None
        if not self._verify or (inspected.validity == "valid" and inspected.record is not None):
            return self._emit(at, inspected)
        if inspected.validity == "valid":
            following = self._inspect(inspected.stop).validity
            if following == "valid":
                return self._emit(at, inspected)
            if following == "incomplete" and not is_end:
                return None
        return self._accept_unknown(at, is_end=is_end)

    def _accept_unknown(self, at: int, *, is_end: bool) -> int | None:
        """Accept records of unknown content if their lengths lead to the next valid chain; otherwise start a search."""
        start, validity = self._find(at + 1, at + 1 + 2 * _WINDOW, is_end=is_end)
        if validity == "incomplete":
            return None
        passed: list[tuple[int, _Inspection]] = []
        place = at
        inspected = self._inspect(place)
        while place < start and inspected.validity in ("valid", "unknown"):
            passed.append((place, inspected))
            place = inspected.stop
            inspected = self._inspect(place)
        leads_to_chain = validity == "valid" and place == start
        leads_to_end = validity != "valid" and is_end and self._is_tail(place)
        if leads_to_chain or leads_to_end:
            for position, passed_record in passed:
                self._emit(position, passed_record)
            return start if leads_to_chain else self._truncate(place)
        self._damage = self._offset + at
        return at + 1

    def _search(self, at: int, *, is_end: bool) -> int | None:
        """Return the start of the next valid chain of records, or the end of a window without one."""
        begun = (self._damage or 0) - self._offset  # negative if before the buffer
        number = (at - begun - 1) // _WINDOW
        window = begun + 1 + number * _WINDOW
        searched = _WINDOW if number < 2 else _SAMPLE
        start, validity = self._find(at, window + searched, is_end=is_end)
        if validity == "valid":
            self._end_damage()
            return start
        if validity == "incomplete":
            return None
        return min(window + _WINDOW, len(self._buffer))

    def _end_damage(self) -> None:
        if self._damage is not None:
            self._records.append(Damage(f"no valid record at byte {self._damage}"))
            self._damage = None

    def _find(self, start: int, stop: int, *, is_end: bool) -> tuple[int, _Validity]:
        """Return the first position in a range where a valid chain of records begins, or may begin (INCOMPLETE)."""
        limit = 1 + max(0, stop - start) // _DISTANCE
        candidates = _CANDIDATE.finditer(self._buffer, start + 2, stop + _CONTEXT)
        for candidate in islice(candidates, limit):
            at = candidate.start() - 2
            if at >= stop:
                continue
            validity = self._validate_chain(at, is_end=is_end)
            if validity != "invalid":
                return at, validity
        end = min(stop, len(self._buffer))
        if is_end or len(self._buffer) >= stop + _CONTEXT:
            return end, "invalid"
        return end, "incomplete"

    def _validate_chain(self, at: int, *, is_end: bool) -> _Validity:
        """Check that a valid record begins here and leads to another one; a sync message needs no other."""
        inspected = self._inspect(at)
        if inspected.validity == "incomplete" and not is_end:
            return "incomplete"
        if isinstance(inspected.record, Sync):
            return "valid"
        if inspected.validity != "valid":
            return "invalid"
        for _ in range(_SKIPPED):
            place = inspected.stop
            inspected = self._inspect(place)
            if inspected.validity == "incomplete" and is_end:
                return "valid" if self._is_tail(place) else "invalid"
            if inspected.validity != "unknown":
                return inspected.validity
            if inspected.stop > at + _CHAIN:
                break
        return "invalid"

    def _inspect(self, at: int) -> _Inspection:
        buffer = self._buffer
        route = self._known.get(buffer[at : at + _DATA_HEADER])
        kind = buffer[at + 2 : at + _HEADER]
        content = at + _HEADER
        stop = content + int.from_bytes(buffer[at : at + 2], "little")
        is_partial = stop > len(buffer) or not kind
        # Record types are printable characters, also in later versions; without `verify` the length is trusted.
        if kind and not b"!" <= kind <= b"~" and (self._verify or not is_partial):
            return _Inspection("invalid", stop)
        if is_partial:
            return _Inspection("incomplete", stop)
        if route is not None:
            # a sync message inside the record means that bytes are missing
            lacks_bytes = self._verify and SYNC in buffer[at:stop]
            return _Inspection("unknown" if lacks_bytes else "valid", stop)
        try:
            record = READERS[kind[0]](buffer[content:stop])
        except (ValueError, LookupError, struct.error):
            return _Inspection("unknown", stop)
        size = stop - content
        is_valid = EXACT_SIZES.get(kind[0], size) == size
        return _Inspection("valid" if is_valid else "unknown", stop, record)

    def _is_tail(self, at: int) -> bool:
        """Return whether the log may end here, inside or after a record."""
        head = self._buffer[at : at + _DATA_HEADER]
        if len(head) < _HEADER or head[2] == ord("D"):
            return not head or any(known.startswith(head) for known in self._known)
        return head[2] in READERS

    def _truncate(self, at: int) -> int:
        end = len(self._buffer)
        if at < end:
            self._records.append(Damage("the file ends inside a message", is_end=True))
        return end

    def _emit(self, at: int, inspected: _Inspection) -> int:
        """Add a record to the result; return the position after it."""
        kind = self._buffer[at + 2]
        if inspected.record is not None:
            try:
                self._apply(inspected.record)
            except ValueError as exc:
                self._records.append(Damage(str(exc)))
        elif inspected.validity == "valid":
            subscription, _, used, payloads = self._known[self._buffer[at : at + _DATA_HEADER]]
            payload = self._buffer[at + _DATA_HEADER : at + used]
            if payloads is not None:
                payloads.append(payload)
            elif subscription is not None:
                self._records.append(Data(subscription, payload))
        elif kind == ord("D"):
            self.undecodable += 1
            message_id = int.from_bytes(self._buffer[at + _HEADER : at + _DATA_HEADER], "little")
            if message_id in self.subscriptions:
                self.mismatched += 1
        elif kind in READERS or inspected.validity == "invalid":
            reason = f"the record at byte {self._offset + at} is damaged"
            self._records.append(Damage(reason))
        return inspected.stop

    def _apply(self, record: Record) -> None:
        """Add a record to the result, and store a definition; raise ValueError if it is unusable."""
        if isinstance(record, Subscription):
            self._subscribe(record)
            return
        if isinstance(record, Format):
            self._formats.add(record.name, record.fields)
        elif isinstance(record, Unsubscription):
            self._unsubscribe(record.message_id)
        self._records.append(record)

    def _subscribe(self, new: Subscription) -> None:
        """Decode the data messages of an id; add its subscription to the result unless it continues another."""
        topic = (new.name, new.multi_id)
        old = self.subscriptions.get(new.message_id)
        if old is not None:
            if (old.name, old.multi_id) != topic:
                raise ValueError(
                    f"{new.name} is ignored, because its message id belongs to {old.name}"
                )
            return
        ended = self._ended.get(topic)
        if ended:
            subscription = ended.pop(0)
        else:
            subscription = self._with_layout(new)
            self._count += 1
            self._records.append(subscription)
        self.subscriptions[new.message_id] = subscription
        for message_id in (new.message_id, *self._collected.pop(new.name, ())):
            self._route(message_id, None)

    def _with_layout(self, new: Subscription) -> Subscription:
        try:
            if self._count == limits.ULOG_SUBSCRIPTIONS:
                raise ValueError(f"the log has more than {limits.ULOG_SUBSCRIPTIONS} subscriptions")
            return replace(new, layout=self._formats.layout(new.name))
        except ValueError as exc:
            raise ValueError(f"{new.name} cannot be decoded, because {exc}") from exc

    def _route(self, message_id: int, payloads: list[bytes] | None) -> None:
        """Add the payloads of a message id to a list from now on, or return its messages."""
        subscription = self.subscriptions.get(message_id)
        if subscription is None:
            return
        is_returned = self._topics is None or subscription.name in self._topics
        returned = subscription if is_returned else None
        used = subscription.layout.size + _DATA_HEADER
        for length, head in _heads(message_id, subscription.layout):
            self._known[head] = (returned, length, used, payloads)

    def _unsubscribe(self, message_id: int) -> None:
        old = self.subscriptions.pop(message_id, None)
        if old is not None:
            for _, head in _heads(message_id, old.layout):
                del self._known[head]
            self._ended.setdefault((old.name, old.multi_id), []).append(old)


def _heads(message_id: int, layout: PayloadLayout) -> Iterator[tuple[int, bytes]]:
    """Yield the possible lengths of a data message, which may include padding, and its first five bytes."""
    padding = min(layout.padding, _PADDING)
    for size in range(layout.size, layout.size + padding + 1):
        yield size + _DATA_HEADER, struct.pack("<HBH", size + 2, ord("D"), message_id)
