"""Replay a .tlog of QGroundControl or MAVProxy: MAVLink frames, each preceded by the host's time in 8 bytes."""

import struct
from collections.abc import Collection, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus.errors import SourceError
from nedbus.recording import open_flight
from nedbus.sources.options import MavlinkOptions, RecordedOptions
from nedbus.sources.source import Rejection, ReplayRun, SourceMessage
from nedbus_msgs import BY_TOPIC, Address, Definition

from .reader import new_parser, parse
from .sequence import SequenceCounter
from .vehicle import Vehicle

_LOOKAHEAD: Final = 1000  # messages read when a file is opened, for the initial list of addresses
_MAX_GAP: Final = 60_000_000  # us; a longer step is a pause or a damaged time, and is skipped
_HEAD: Final = struct.Struct(">Q2s")  # time [us], start of a frame: marker and length
_MAX_RECORD: Final = _HEAD.size + 290  # bytes of a record
_OVERHEAD: Final = {dialect.PROTOCOL_MARKER_V1: 8, dialect.PROTOCOL_MARKER_V2: 12}  # bytes of a frame without payload
_SIGNATURE: Final = 13  # bytes


class TlogReader:
    """Read the messages of all autopilots in a .tlog; `due` is the host's time since the first frame [s]."""

    def __init__(self, path: Path, topics: Collection[str] | None = None, *, vehicle: str | None = None) -> None:
        self._path, self._options, self._vehicle = path, MavlinkOptions(topics=tuple(topics or ())), vehicle
        self.definitions: dict[Address, Definition[Any] | None] = {}  # of the addresses so far
        self._boots: set[int] = set()  # Unix times [us]
        self.damaged = self.position = 0  # bytes

    @property
    def boot_utc(self) -> int:
        """Unix time of the boot by the host's clock [us]; 0 for several vehicles or boots."""
        return next(iter(self._boots)) if len(self._boots) == 1 else 0

    @property
    def warnings(self) -> list[str]:
        """Damage so far."""
        return [f"damaged ({self.damaged} B are not MAVLink)"] if self.damaged else []

    def messages(self) -> Iterator[SourceMessage]:
        """Yield the messages, once; raise SourceError if there are none."""
        vehicles: dict[int, tuple[Vehicle, SequenceCounter]] = {}
        parser, due, last = new_parser(), 0, 0
        for stamp, frame in self._frames():
            due, last = due + (stamp - last if last and 0 < stamp - last <= _MAX_GAP else 0), stamp
            for item in parse(parser, frame, str(self._path), None, due / 1e6):
                if isinstance(item, Rejection):
                    self.damaged += len(frame) if item.where == str(self._path) else 0
                    continue
                if item.system not in vehicles:
                    name = self._vehicle or str(item.system)
                    vehicles[item.system] = Vehicle(name, self._options), SequenceCounter()
                vehicle, sequence = vehicles[item.system]
                vehicle.count_lost(sequence.add(item.sequence, item.time), item.time)
                found = vehicle.handle(item.message, item.time)
                if found is None or found.address is None:
                    continue
                if isinstance(found, Rejection):
                    found = SourceMessage(item.time, found.address, {}, error=found.reason)
                elif found.rebooted or found.address.vehicle not in {each.vehicle for each in self.definitions}:
                    # The message may have the time of an old sample.
                    self._boots.add(stamp - (vehicle.clock.newest or found.timestamp))
                self.definitions.setdefault(found.address, BY_TOPIC[found.address.topic])
                yield replace(found, due=item.time)
        if not self.definitions:
            reason = "this file has no autopilot messages for these topics"
            raise SourceError(str(self._path), "; ".join([reason, *self.warnings]))

    def _frames(self) -> Iterator[tuple[int, bytes]]:
        """Yield each frame with its time [us]; after damage, search for two consecutive records."""
        with open_flight(self._path) as file:
            data, is_found = b"", True
            while data := data + file.read(2 * _MAX_RECORD - len(data)):
                length = _record_length(data)
                is_found = bool(length) and (is_found or len(data) == length or _record_length(data[length:]) > 0)
                if not is_found or length > len(data):
                    self.damaged += 1
                    self.position, data = self.position + 1, data[1:]
                    continue
                yield _HEAD.unpack_from(data)[0], data[8:length]
                self.position, data = self.position + length, data[length:]


def open_tlog(file: str, options: RecordedOptions, _: str) -> ReplayRun:
    """Read the start of a file; raise SourceError if it has none of the requested topics."""
    path = Path(file).expanduser()
    reader = TlogReader(path, options.topics, vehicle=options.vehicle)
    run = ReplayRun(iter(()), reader.definitions, None, "", position=0)
    messages = _read(reader, run, path, options)
    ahead = list(islice(messages, _LOOKAHEAD))
    vehicles = sorted({address.vehicle for address in reader.definitions})
    run.messages = (message for part in (ahead, messages) for message in part)  # a generator, which can be closed
    run.total = path.stat().st_size
    run.summary = f"vehicle {', '.join(vehicles)}, {run.total / 1e6:.1f} MB"
    return run


def _read(reader: TlogReader, run: ReplayRun, path: Path, options: RecordedOptions) -> Iterator[SourceMessage]:
    for message in reader.messages():
        run.position = reader.position
        yield message
    absent = options.absent_from({address.topic for address in reader.definitions}, "this file")
    run.warnings = (*reader.warnings, *absent)
    if reader.damaged:
        run.damage = f"{path}: some messages are lost to damage; {'; '.join(reader.warnings)}"


def _record_length(data: bytes) -> int:
    """Return the length of the record at the start of these bytes, 0 if there is none."""
    if len(data) < _HEAD.size + 1:
        return 0
    marker, payload, flags = data[8:11]
    signature = _SIGNATURE if marker == dialect.PROTOCOL_MARKER_V2 and flags & dialect.MAVLINK_IFLAG_SIGNED else 0
    return 8 + _OVERHEAD[marker] + payload + signature if marker in _OVERHEAD else 0
