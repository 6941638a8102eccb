"""Readers of a link: LinkReader yields the messages of autopilots, LogReceiver also requests their ULog streams."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import common as dialect

from nedbus.sources.options import MavlinkOptions
from nedbus.sources.source import Rejection

from .boot_clock import BootClock
from .link import AUTOPILOT, Link, Peer, ignore_reason
from .log_client import COMMANDS, Command, LogStreamClient
from .log_reassembly import Chunk, Reassembly
from .saved_stream import read_stream, state_path

# Ids of a companion computer: its loss, unlike that of a ground station, triggers no failsafe.
SYSTEM: Final = 245
COMPONENT: Final = dialect.MAV_COMP_ID_ONBOARD_COMPUTER

_MAX_WAITING: Final = 16_384  # messages queued for `read`; later ones are dropped, and counted as lost
_MAX_READ: Final = 100  # messages per call
_TICK: Final = 0.05  # s, the longest wait of the thread
_STOP_TIMEOUT: Final = 0.8  # s for vehicles to confirm the end of their streams


class Received(NamedTuple):
    """A message of an autopilot. `time`: arrival, monotonic [s]; `sequence`: MAVLink's; `chunk`: ULog data in it."""

    message: Any
    system: int
    sequence: int
    peer: Peer
    time: float
    chunk: Chunk | None = None


class LinkReader:
    """Parse the MAVLink messages of a link."""

    def __init__(self, link: Link, *, name: str) -> None:
        self._link, self.name = link, name
        self._parser = new_parser()

    def read(self, timeout: float) -> Iterator[Received | Rejection]:
        """Yield the messages of autopilots; wait up to `timeout` seconds for the first. Raises OSError."""
        for data, peer in self._link.read(timeout):
            now = time.monotonic()
            if not self._link.stream:
                # A truncated message must not consume the next datagram, which may be from another sender.
                self._parser = new_parser()
            # Pymavlink frees parsed bytes only once no partial message follows them.
            del self._parser.buf[: self._parser.buf_index]
            self._parser.buf_index = 0
            yield from parse(self._parser, data, self.name, peer, now)
            if not self._link.stream and self._parser.buf_len():
                yield Rejection(self.name, f"truncated message ({self._parser.buf_len()} B)")


def parse(parser: Any, data: bytes, name: str, peer: Peer, now: float) -> Iterator[Received | Rejection]:
    """Yield the messages of autopilots in bytes that `peer` sent; `now`: time of arrival."""
    for message in parser.parse_buffer(data) or []:
        raw = bytes(message.get_msgbuf())
        if message.get_type() == "BAD_DATA":
            yield Rejection(name, f"data that is not MAVLink ({len(raw)} B)")
            continue
        # Only the header of a message can be parsed if the dialect lacks its definition.
        sequence, system, component = raw[4:7] if raw[0] == dialect.PROTOCOL_MARKER_V2 else raw[2:5]
        reason = ignore_reason(system, component)
        if not reason:
            yield Received(message, system, sequence, peer, now)
        elif not ((system and component) or message.get_type().startswith("UNKNOWN")):  # cameras etc. are normal
            yield Rejection(f"{name} system {system} component {component}", reason)


def new_parser() -> Any:
    """Return a parser that reports bytes that are not MAVLink as BAD_DATA."""
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    return parser


@dataclass(slots=True)
class _Vehicle:
    system: int
    client: LogStreamClient
    peer: Peer
    reassembly: Reassembly = field(default_factory=Reassembly)
    clock: BootClock = field(default_factory=BootClock)
    refusal: str = ""  # why the stream of an earlier process cannot be continued


class LogReceiver:
    """Read a link on a dedicated thread, which acknowledges PX4's log stream even while publishing blocks.

    `send`: sends a MAVLink message to a peer, without blocking. `vehicles`: by system id, from the first heartbeat on.
    """

    def __init__(self, reader: LinkReader, options: MavlinkOptions, send: Callable[[Any, Peer], object]) -> None:
        self._reader, self._options, self._send = reader, options, send
        self.vehicles: dict[int, _Vehicle] = {}
        self._waiting: SimpleQueue[Received | Rejection | BaseException] = SimpleQueue()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="nedbus-mavlink", daemon=True)
        self._thread.start()

    def read(self, timeout: float) -> Iterator[Received | Rejection]:
        """Yield messages; wait up to `timeout` seconds for the first. Raises the error that ended the thread."""
        with suppress(Empty):
            for number in range(_MAX_READ):
                item = self._waiting.get_nowait() if number else self._waiting.get(timeout=timeout)
                if isinstance(item, BaseException):
                    raise item
                yield item

    def close(self) -> None:
        """Stop the streams and the thread; wait until the vehicles confirm, or a timeout expires."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._step()
            end = time.monotonic() + _STOP_TIMEOUT
            for vehicle in self.vehicles.values():
                self._execute(vehicle, vehicle.client.stop(time.monotonic()))
            while time.monotonic() < end and any(
                vehicle.client.status.state == "stopping" for vehicle in self.vehicles.values()
            ):
                self._step()
        except BaseException as exc:  # noqa: BLE001 - re-raised by `read`, on the thread of the source
            self._waiting.put(exc)

    def _step(self) -> None:
        for item in self._reader.read(_TICK):
            is_full = self._waiting.qsize() >= _MAX_WAITING
            received = self._process(item, is_full=is_full) if isinstance(item, Received) else item
            if not is_full:
                self._waiting.put(received)
        for vehicle in self.vehicles.values():
            self._execute(vehicle, vehicle.client.tick(time.monotonic()))

    def _process(self, received: Received, *, is_full: bool) -> Received | Rejection:
        """Handle a message for the ULog stream, and reassemble its data; if the queue is full, treat it as lost."""
        message, kind, now = received.message, received.message.get_type(), received.time
        vehicle = self.vehicles.get(received.system)
        if kind.startswith("LOGGING_DATA"):
            return self._process_data(received, vehicle, is_full=is_full)
        if kind == "HEARTBEAT":
            if vehicle is None:
                ids, options = {"system": SYSTEM, "component": COMPONENT}, self._options
                client = LogStreamClient(options.log, **ids, header=options.header)
                vehicle = self.vehicles[received.system] = _Vehicle(received.system, client, received.peer)
            vehicle.peer = received.peer
            armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
            self._execute(vehicle, vehicle.client.on_heartbeat(message.autopilot, now, armed=armed))
        elif vehicle is not None and kind == "COMMAND_ACK":
            target = message.target_system, message.target_component
            self._execute(vehicle, vehicle.client.on_command_ack(message.command, message.result, *target, now))
        elif vehicle is not None and kind == "TIMESYNC" and message.tc1:
            self._execute(vehicle, vehicle.client.on_timesync(message.ts1, now))
        elif vehicle is not None and vehicle.clock.add(message, now):
            vehicle.client.on_reboot()
            vehicle.reassembly, vehicle.refusal = Reassembly(), ""
        return received

    def _process_data(self, received: Received, vehicle: _Vehicle | None, *, is_full: bool) -> Received | Rejection:
        """Acknowledge and reassemble data of the ULog stream; see `_process`."""
        message, kind, now = received.message, received.message.get_type(), received.time
        target = message.target_system, message.target_component
        is_ours = target == (SYSTEM, COMPONENT)
        if vehicle and is_ours and vehicle.reassembly.is_new and message.sequence and not vehicle.refusal:
            if is_full or vehicle.client.status.state in ("stopping", "stopped"):
                return received
            if (adopted := self._adopt(vehicle, now)) or not vehicle.refusal:
                return received._replace(chunk=adopted)
        if vehicle is None or not vehicle.client.accepts(*target):
            if not is_ours:
                return received
            where, reason = (
                f"{self._reader.name} system {received.system}",
                f"{kind} of a stream that was not requested",
            )
            if vehicle is not None and vehicle.refusal:
                where, reason = f"{where}, ULog stream", "the ULog stream of an earlier process cannot be continued"
                reason += f", because {vehicle.refusal}; it restarts after disarming, or at once with log=armed"
            return Rejection(where, reason)
        begins = False
        if not is_full:
            fields = message.sequence, message.length, message.first_message_offset, message.data
            chunk = vehicle.reassembly.add(*fields)
            received, begins = received._replace(chunk=chunk), chunk.begins
            if chunk.verdict == "delivered" and not chunk.lost:  # a reboot ends the stream
                vehicle.clock.confirm()
        is_acked = kind == "LOGGING_DATA_ACKED"
        self._execute(vehicle, vehicle.client.on_data(message.sequence, now, acked=is_acked, begins=begins))
        return received

    def _adopt(self, vehicle: _Vehicle, now: float) -> Chunk | None:
        """Continue the stream of an earlier process; return its definitions, or None while its boot is unknown.

        The message that shows it is not used: an acknowledged one is repeated, and any other one counts as lost.
        """
        try:
            saved = read_stream(state_path(self._options, self._reader.name, vehicle.system), vehicle.system)
            if vehicle.clock.newest is None:
                return None
            saved.check_boot(vehicle.clock.newest, now)
        except ValueError as exc:
            vehicle.refusal = str(exc)
            return None
        vehicle.client.adopt(now)
        vehicle.reassembly.resume(saved.sequence)
        return Chunk("delivered", saved.definitions, begins=True)

    def _execute(self, vehicle: _Vehicle, commands: Iterable[Command]) -> None:
        for command in commands:
            if command.kind == "acknowledge":
                message: Any = dialect.MAVLink_logging_ack_message(vehicle.system, AUTOPILOT, command.sequence)
            elif command.kind == "ping":
                message = dialect.MAVLink_timesync_message(0, command.sequence)
            else:
                parameters = [COMMANDS[command.kind], 0, *(0,) * 7]
                message = dialect.MAVLink_command_long_message(vehicle.system, AUTOPILOT, *parameters)
            self._send(message, vehicle.peer)
