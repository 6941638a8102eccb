"""Reader of .tlog files of QGroundControl or MAVProxy: MAVLink frames, each preceded by the host's time in 8 bytes."""

import struct
from collections.abc import Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus.errors import SourceError
from nedbus.mavlink import SequenceCounter, Vehicle, new_parser, parse
from nedbus.samples import Rejection, SourceMessage
from nedbus.timeline import arrivals
from nedbus_msgs import BY_TOPIC, Address, Encoded

from .formats import open_file
from .reader import FlightReader, ReadOptions, Record

_HEAD: Final = struct.Struct(">Q2s")  # time [us], start of a frame: marker and length
_MAX_RECORD: Final = _HEAD.size + 290  # bytes of a record
_OVERHEAD: Final = {dialect.PROTOCOL_MARKER_V1: 8, dialect.PROTOCOL_MARKER_V2: 12}  # bytes of a frame without payload
_SIGNATURE: Final = 13  # bytes


class _ConvertedStream:
    """A stream of messages that were converted from MAVLink; their payloads are fields by name."""

    dtype = None
    head, strict_bools = b"", frozenset[str]()
    lacking: frozenset[str] = frozenset()
    converted: Mapping[str, Any] = {"timestamp": None}  # decoded at once

    def __init__(self, address: Address) -> None:
        self.address, self.definition = address, BY_TOPIC[address.topic]

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


class TlogReader(FlightReader):
    """Read the messages of all autopilots in a .tlog."""

    kind = "tlog"

    def __init__(self, path: Path, options: ReadOptions) -> None:
        super().__init__(path, options)
        self._file, self.total = open_file(path), path.stat().st_size
        self._resources.append(self._file)
        self._boots: set[int] = set()  # Unix times [us]
        self._foreign = self._lost = 0  # bytes that are not MAVLink; messages before the next one
        self._rebooted = False
        self._streams: dict[Address, _ConvertedStream] = {}
        self._shrinkage: list[str] = []

    @property
    def warnings(self) -> list[str]:
        """Damage so far."""
        return [f"damaged ({self._foreign} B are not MAVLink)"] * bool(self._foreign) + self._shrinkage

    def records(self) -> Iterator[Record]:
        """Yield the converted messages with the host's time; raise SourceError if there are none."""
        vehicles: dict[int, tuple[Vehicle, SequenceCounter]] = {}
        parser, booted = new_parser(), set[int]()
        for arrived, (stamp, frame) in arrivals(self._frames(), itemgetter(0)):
            for item in parse(parser, frame, str(self.path), None, arrived):
                if isinstance(item, Rejection):
                    self._skip(len(frame) if item.where == str(self.path) else 0)
                    continue
                if item.system not in vehicles:
                    name = str(item.system)
                    vehicles[item.system] = Vehicle(name, self.options.topics), SequenceCounter()
                vehicle, sequence = vehicles[item.system]
                vehicle.count_lost(sequence.add(item.sequence, item.time), item.time)
                found = vehicle.handle(item.message, item.time)
                if found is None or found.address is None:
                    continue
                stream = self._stream(found.address)
                if isinstance(found, Rejection):
                    yield Record(stream, {}, stamp, found.reason)
                    continue
                if found.rebooted or item.system not in booted:
                    # The message may have the time of an old sample.
                    booted.add(item.system)
                    self._boots.add(stamp - (vehicle.clock.newest or found.timestamp))
                    self.boot_utc = next(iter(self._boots)) if len(self._boots) == 1 else 0
                self._lost, self._rebooted = found.lost, found.rebooted
                yield Record(stream, found.fields, stamp)
        if not self.definitions:
            reason = "this file has no autopilot messages for these topics"
            raise SourceError(str(self.path), "; ".join([reason, *self.warnings]))

    def message_of(self, record: Record) -> SourceMessage:
        """Return a record as a message, with the losses and the reboot before it."""
        message = super().message_of(record)
        message.lost, message.rebooted, self._lost, self._rebooted = self._lost, self._rebooted, 0, False
        return message

    def _stream(self, own: Address) -> _ConvertedStream:
        if own not in self._streams:
            address = Address(self.vehicle_of(own.vehicle), own.topic, own.instance)
            self._streams[own] = _ConvertedStream(address)
            self.definitions.setdefault(address, BY_TOPIC[own.topic])
        return self._streams[own]

    def _skip(self, count: int) -> None:
        self._foreign += count
        self.damaged |= count > 0

    def _frames(self) -> Iterator[tuple[int, bytes]]:
        """Yield each frame with its time [us]; after damage, search for two consecutive records."""
        with self._file as file:
            data, is_found = b"", True
            while data := data + file.read(2 * _MAX_RECORD - len(data)):
                length = _record_length(data)
                is_found = bool(length) and (is_found or len(data) == length or _record_length(data[length:]) > 0)
                if not is_found or length > len(data):
                    self._skip(1)
                    self.position, data = self.position + 1, data[1:]
                    continue
                yield _HEAD.unpack_from(data)[0], data[8:length]
                self.position, data = self.position + length, data[length:]
            self._shrinkage = self.shrinkage()


def _record_length(data: bytes) -> int:
    """Return the length of the record at the start of these bytes, 0 if there is none."""
    if len(data) < _HEAD.size + 1:
        return 0
    marker, payload, flags = data[8:11]
    signature = _SIGNATURE if marker == dialect.PROTOCOL_MARKER_V2 and flags & dialect.MAVLINK_IFLAG_SIGNED else 0
    return 8 + _OVERHEAD[marker] + payload + signature if marker in _OVERHEAD else 0
