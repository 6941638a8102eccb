"""Reader of .tlog files of QGroundControl or MAVProxy: MAVLink frames, each preceded by the host's time in 8 bytes."""

import os
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus.errors import SourceError
from nedbus.mavlink import Received, SequenceCounter, Vehicle, new_parser, parse
from nedbus.samples import Rejection, SourceMessage
from nedbus.timeline import arrivals
from nedbus_msgs import BY_TOPIC, Address, Encoded

from .formats import open_file
from .reader import FlightReader, ReadOptions, Record

_HEAD: Final = struct.Struct(">Q2s")  # time [us], start of a frame: marker and length
_LONGEST_RECORD: Final = _HEAD.size + 290  # bytes
# bytes of a frame without payload
_OVERHEAD: Final = {dialect.PROTOCOL_MARKER_V1: 8, dialect.PROTOCOL_MARKER_V2: 12}
_SIGNATURE: Final = 13  # bytes
_MARKERS: Final = re.compile(b"[%c%c]" % (dialect.PROTOCOL_MARKER_V1, dialect.PROTOCOL_MARKER_V2))
_BLOCK: Final = 2**16  # bytes per read


class _ConvertedStream:
    """A stream of messages that were converted from MAVLink; their payloads are fields by name."""

    dtype = None
    head = b""
    strict_bools = frozenset[str]()
    lacking: frozenset[str] = frozenset()
    converted: Mapping[str, Any] = {"timestamp": None}  # decoded at once

    def __init__(self, address: Address) -> None:
        self.address = address
        self.definition = BY_TOPIC[address.topic]

    def check(self, _: Any) -> str | None:
        """Return None: the fields were checked when they were converted."""
        return None

    def decode(self, fields: Any) -> dict[str, Any]:
        """Return the fields."""
        return dict(fields)

    def timestamp(self, fields: Any) -> tuple[int | None]:
        """Return the timestamp."""
        return (fields.get("timestamp"),)

    def encode_valid(self, _: Any) -> Encoded | None:
        """Return None: the fields are validated by name."""
        return None


@dataclass(slots=True)
class _Sender:
    """An autopilot; `has_booted`: the time of its boot is known."""

    vehicle: Vehicle
    sequence: SequenceCounter
    has_booted: bool = False


class TlogReader(FlightReader):
    """Read the messages of all autopilots in a .tlog."""

    kind = "tlog"

    def __init__(self, path: Path, options: ReadOptions) -> None:
        super().__init__(path, options)
        self._file = open_file(path)
        self.total = path.stat().st_size
        self._resources.append(self._file)
        self._boots: set[int] = set()  # Unix times [us]
        self._foreign = 0  # bytes that are not MAVLink
        self._lost = 0  # messages before the next one
        self._end = self.total  # the rest of the file is zeros
        self._is_cut = False  # the file ends within a record, or in zeros
        self._rebooted = False
        self._source = self.kind  # of the next message
        self._streams: dict[Address, _ConvertedStream] = {}
        self._shrinkage: list[str] = []
        self._senders: dict[int, _Sender] = {}  # by system id

    @property
    def warnings(self) -> list[str]:
        """Damage so far, and a truncated end, which is no damage."""
        warnings = [*self._shrinkage]
        if self._foreign:
            warnings.append(f"damaged ({self._foreign} B are not MAVLink)")
        if self._is_cut and self._end < self.total:
            zeros = self.total - self._end
            warnings.append(f"truncated (the last {zeros} B are zeros, as after a power cut)")
        elif self._is_cut:
            warnings.append("truncated (the file ends within a message)")
        copies = sum(sender.vehicle.copies for sender in self._senders.values())
        if copies:
            noun = "copy" if copies == 1 else "copies"
            warnings.append(f"{copies} {noun} from a second link left out")
        return warnings

    def records(self) -> Iterator[Record]:
        """Yield the converted messages with the host's time; raise SourceError if there are none."""
        parser = new_parser()
        path = str(self.path)
        for arrived, (stamp, frame) in arrivals(self._frames(), itemgetter(0)):
            for item in parse(parser, frame, path, None, arrived):
                if not isinstance(item, Rejection):
                    yield from self._records_of(item, stamp)
                elif self.position > self._end:
                    self._is_cut = True  # a record whose end was not written
                elif item.where == path:
                    self._skip(len(frame))
        if not self.definitions:
            reason = "this file has no autopilot messages for these topics"
            raise SourceError(path, "; ".join([reason, *self.warnings]))

    def _records_of(self, frame: Received, stamp: int) -> Iterator[Record]:
        """Yield the messages that the autopilot's frame completes; `stamp`: the host's time [us]."""
        sender = self._senders.get(frame.system)
        if sender is None:
            sender = _Sender(Vehicle(str(frame.system), self.options.topics), SequenceCounter())
            self._senders[frame.system] = sender
        vehicle = sender.vehicle
        lost = sender.sequence.add(frame.sequence, frame.time)
        vehicle.count_lost(lost, frame.time, link=sender.sequence.link)
        for message in vehicle.handle_all(frame.message, frame.time):
            if message.address is None:
                continue
            stream = self._stream(message.address)
            if isinstance(message, Rejection):
                yield Record(stream, {}, stamp, message.reason)
                continue
            if message.rebooted or not sender.has_booted:
                sender.has_booted = True
                # The message may have the time of an old sample.
                self._add_boot(stamp - (vehicle.clock.newest or message.timestamp))
            self._lost = message.lost
            self._rebooted = message.rebooted
            self._source = message.source or self.kind
            yield Record(stream, message.fields, stamp)

    def _add_boot(self, utc: int) -> None:
        """Note the Unix time of a boot [us]; only that of a single one is known."""
        self._boots.add(utc)
        self.boot_utc = utc if len(self._boots) == 1 else 0

    def message_of(self, record: Record) -> SourceMessage:
        """Return a record as a message, with its author, and the losses and the reboot before it."""
        message = super().message_of(record)
        message.lost = self._lost
        message.rebooted = self._rebooted
        self._lost = 0
        self._rebooted = False
        message.source = self._source
        return message

    def _stream(self, own: Address) -> _ConvertedStream:
        if own not in self._streams:
            address = Address(self.vehicle_of(own.vehicle), own.topic, own.instance)
            self._streams[own] = _ConvertedStream(address)
            self.definitions.setdefault(address, BY_TOPIC[own.topic])
        return self._streams[own]

    def _skip(self, count: int) -> None:
        self._foreign += count
        self.damaged = True

    def _frames(self) -> Iterator[tuple[int, bytes]]:
        """Yield each frame with its time [us]; after damage, search for two consecutive records."""
        with self._file as file:
            self._end = _end_of_content(file, self.total)
            data = b""
            at = 0
            is_synchronised = True
            while True:
                if len(data) - at < 2 * _LONGEST_RECORD:
                    data = data[at:] + file.read(_BLOCK)
                    at = 0
                if at == len(data):
                    break
                length = _record_length(data, at)
                is_record = 0 < length <= len(data) - at and self.position < self._end
                if is_record and (is_synchronised or _is_next(data, at + length)):
                    is_synchronised = True
                    self.position += length
                    time, _ = _HEAD.unpack_from(data, at)
                    yield time, data[at + 8 : at + length]
                    at += length
                    continue
                content = self._end - self.position
                if content <= 0 or (is_synchronised and _is_cut(data[at:], content)):
                    self._is_cut = True
                    self.position += len(data) - at
                    if self._end < self.total:
                        self.position = self.total
                    break
                is_synchronised = False
                skipped = _next_candidate(data, at) - at
                self._skip(skipped)
                self.position += skipped
                at += skipped
            self._shrinkage = self.shrinkage()


def _end_of_content(file: BinaryIO, size: int) -> int:
    """Return the position behind the last byte of a file that is not zero; do not move in the file."""
    begin = file.tell()
    end = size
    while end > begin:
        start = max(begin, end - _BLOCK)
        file.seek(start)
        block = file.read(end - start)
        if block != bytes(len(block)):  # ten times as fast as to strip it
            end = start + len(block.rstrip(b"\0"))
            break
        end = start
    file.seek(begin, os.SEEK_SET)
    return end


def _record_length(data: bytes, at: int) -> int:
    """Return the length of the record at a position of these bytes, 0 if there is none."""
    if len(data) - at < _HEAD.size + 1:
        return 0
    marker, payload, flags = data[at + 8 : at + 11]
    if marker not in _OVERHEAD:
        return 0
    length = 8 + _OVERHEAD[marker] + payload
    if marker == dialect.PROTOCOL_MARKER_V2 and flags & dialect.MAVLINK_IFLAG_SIGNED:
        length += _SIGNATURE
    return length


def _is_next(data: bytes, at: int) -> bool:
    """Return whether the data ends at a position, or another record begins there."""
    return at == len(data) or _record_length(data, at) > 0


def _is_cut(rest: bytes, content: int) -> bool:
    """Return whether the rest of a file is the beginning of a record; `content`: its size without zeros at the end."""
    if content >= _LONGEST_RECORD:
        return False
    return min(content, len(rest)) <= 8 or rest[8] in _OVERHEAD


def _next_candidate(data: bytes, at: int) -> int:
    """Return the next position at which a record may begin; the end of the data if there is none."""
    marker = _MARKERS.search(data, at + 9)
    if marker is not None:
        return marker.start() - 8
    if len(data) - at <= 8:
        return len(data)
    return max(at + 1, len(data) - 8)
