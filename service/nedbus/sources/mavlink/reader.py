"""Readers of a link: LinkReader yields the messages of autopilots, LogReceiver queues them for the source."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus import limits
from nedbus.mavlink import (
    AUTOPILOT,
    Chunk,
    Reassembly,
    Received,
    SequenceCounter,
    new_clock,
    new_parser,
    parse,
    read_time,
)
from nedbus.sources.options import MavlinkOptions
from nedbus.sources.source import LinkLoad, Rejection
from nedbus.timeline import TimeKind, VehicleClock

from .link import Link, Peer, PeerChoice
from .log_client import COMMANDS, Command, LogStreamClient
from .receive_queue import ReceiveQueue, join_data
from .saved_stream import read_stream, state_path

# Ids of a companion computer: its loss, unlike that of a ground station, triggers no failsafe.
SYSTEM: Final = 245
COMPONENT: Final = dialect.MAV_COMP_ID_ONBOARD_COMPUTER

# s without a message until a vehicle can be removed in favour of another one
_MIN_SILENCE: Final = 5.0
_TICK: Final = 0.05  # s, the longest wait of the thread
# s between two reads during a stream: several messages at once need less processor time
_PAUSE: Final = 0.02
# ... while TIMESYNC is answered: PX4 discards answers that take over 10 ms
_ANSWER_PAUSE: Final = 0.002
_STOP_TIMEOUT: Final = 0.8  # s for vehicles to confirm the end of their streams
_NO_PARAMETERS: Final = (0,) * 7  # of a command


def heartbeat() -> Any:
    """Return the message that announces this component: others send only to announced ones."""
    return dialect.MAVLink_heartbeat_message(
        type=dialect.MAV_TYPE_ONBOARD_CONTROLLER,
        autopilot=dialect.MAV_AUTOPILOT_INVALID,
        base_mode=0,
        custom_mode=0,
        system_status=dialect.MAV_STATE_ACTIVE,
        mavlink_version=3,
    )


class LinkReader:
    """Parse the MAVLink messages of a link."""

    def __init__(self, link: Link, *, name: str) -> None:
        self.link = link
        self.name = name
        self._parser = new_parser()

    def read(self, timeout: float) -> Iterator[Received | Rejection]:
        """Yield the messages of autopilots; wait up to `timeout` seconds for the first. Raises OSError."""
        for data, peer, now in self.link.read(timeout):
            # Pymavlink frees parsed bytes only once no partial message follows them.
            del self._parser.buf[: self._parser.buf_index]
            self._parser.buf_index = 0
            yield from parse(self._parser, data, self.name, peer, now)
            if not self.link.stream and self._parser.buf_len():
                yield Rejection(self.name, f"truncated message ({self._parser.buf_len()} B)")
                # the next datagram may be from another sender
                self._parser = new_parser(self._parser.senders)


@dataclass(slots=True)
class _Vehicle:
    """State of one vehicle on the thread of the link.

    `peers`: where the messages for it are sent. `last`: time of its last message [s].
    `refusal`: why the stream of an earlier process cannot be continued.
    """

    system: int
    client: LogStreamClient
    peers: PeerChoice
    last: float
    sequence: SequenceCounter = field(default_factory=SequenceCounter)
    reassembly: Reassembly = field(default_factory=Reassembly)
    clock: VehicleClock = field(default_factory=new_clock)
    is_known: bool = False  # a heartbeat has arrived
    refusal: str = ""


class LogReceiver:
    """Read a link on a dedicated thread, which acknowledges PX4's log stream even while publishing blocks.

    `send`: sends a MAVLink message to a peer, without blocking.
    `vehicles`: by system id, at most 100; for a further one, the one that has been silent longest is removed.
    Without the option `log`, no stream is requested.
    """

    def __init__(
        self, reader: LinkReader, options: MavlinkOptions, send: Callable[[Any, Peer], object]
    ) -> None:
        self._reader = reader
        self._options = options
        self._send = send
        self.vehicles: dict[int, _Vehicle] = {}
        self._waiting = ReceiveQueue()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="nedbus-mavlink", daemon=True)
        self._thread.start()

    def read(self, timeout: float) -> Iterator[Received | Rejection | LinkLoad]:
        """Yield messages; wait up to `timeout` seconds for the first. Raises the error that ended the thread."""
        return self._waiting.read(timeout, lost_by_host=self._reader.link.dropped)

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
            while self._is_any("stopping") and time.monotonic() < end:
                self._step()
        except BaseException as exc:  # noqa: BLE001 - re-raised by `read`, on the thread of the source
            self._waiting.fail(exc)

    def _step(self) -> None:
        if self._is_any("streaming"):
            time.sleep(_ANSWER_PAUSE if self._answers_timesync else _PAUSE)
        items = list[Received | Rejection]()
        try:
            for item in self._reader.read(_TICK):
                items.append(self._process(item) if isinstance(item, Received) else item)
        finally:  # the link may break
            if items:
                self._waiting.put(*join_data(items))
        for vehicle in self.vehicles.values():
            self._execute(vehicle, vehicle.client.tick(time.monotonic()))

    def _is_any(self, state: str) -> bool:
        """Return whether a ULog stream is in this state."""
        return any(vehicle.client.status.state == state for vehicle in self.vehicles.values())

    def _process(self, received: Received) -> Received | Rejection:
        """Count the losses before a message; handle it for the ULog stream, and reassemble its data."""
        now = received.time
        vehicle = self.vehicles.get(received.system) or self._add_vehicle(received)
        if vehicle is None:
            reason = (
                f"a link has up to {limits.MAVLINK_VEHICLES}; give the others a link of their own"
            )
            return Rejection(f"{self._reader.name} further vehicles", reason)
        vehicle.last = now
        vehicle.peers.add(received.peer, now)
        if self._answers_timesync:
            self._answer_timesync(received, vehicle)
        lost = vehicle.sequence.add(received.sequence, now)
        link = vehicle.sequence.link
        if lost or link:
            received = received._replace(lost=lost, link=link)
        if not self._options.log:
            return received
        if received.message.get_type().startswith("LOGGING_DATA"):
            return self._process_data(received, vehicle)
        if received.peer == vehicle.peers.peer:  # not another link, or a stranger
            self._follow_state(vehicle, received)
        return received

    def _add_vehicle(self, received: Received) -> _Vehicle | None:
        """Add the vehicle of a message; return None if the link has too many."""
        now = received.time
        if len(self.vehicles) == limits.MAVLINK_VEHICLES and not self._evict(now):
            return None
        client = LogStreamClient(
            {self._options.log}, system=SYSTEM, component=COMPONENT, header=self._options.header
        )
        peers = PeerChoice(received.peer, now)
        vehicle = _Vehicle(received.system, client, peers, now)
        self.vehicles[received.system] = vehicle
        return vehicle

    @property
    def _answers_timesync(self) -> bool:
        return self._options.position is not None and self._options.position_clock == "timesync"

    def _answer_timesync(self, received: Received, vehicle: _Vehicle) -> None:
        """Answer PX4's request with the clock of ODOMETRY's time_usec.

        PX4 takes the answer as the middle of the round trip, so it names the middle of the time that it waited here.
        """
        message = received.message
        if message.get_type() != "TIMESYNC" or message.tc1 or received.peer != vehicle.peers.peer:
            return
        middle = (received.time + time.monotonic()) / 2
        self._send(dialect.MAVLink_timesync_message(int(1e9 * middle), message.ts1), received.peer)

    def _evict(self, now: float) -> bool:
        """Remove the vehicle that has been silent longest; return False if none has been silent for long enough."""
        oldest = min(self.vehicles.values(), key=lambda vehicle: vehicle.last)
        if now - oldest.last < _MIN_SILENCE:
            return False
        del self.vehicles[oldest.system]
        return True

    def _follow_state(self, vehicle: _Vehicle, received: Received) -> None:
        """Pass a message that changes the state of the ULog stream to its client."""
        message = received.message
        kind = message.get_type()
        now = received.time
        client = vehicle.client
        if kind == "HEARTBEAT":
            vehicle.is_known = True
            armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
            self._execute(vehicle, client.on_heartbeat(message.autopilot, now, armed=armed))
        elif kind == "COMMAND_ACK":
            target = message.target_system, message.target_component
            answer = client.on_command_ack(message.command, message.result, *target, now)
            self._execute(vehicle, answer)
        elif kind == "TIMESYNC" and message.tc1:
            self._execute(vehicle, client.on_timesync(message.ts1, now))
        else:
            reading = read_time(vehicle.clock, message, now)
            if reading is not None and reading.kind is TimeKind.REBOOT:
                client.on_reboot()
                vehicle.reassembly = Reassembly()
                vehicle.refusal = ""

    def _process_data(self, received: Received, vehicle: _Vehicle) -> Received | Rejection:
        """Acknowledge and reassemble data of the ULog stream; see `_process`."""
        message = received.message
        now = received.time
        target = message.target_system, message.target_component
        is_ours = target == (SYSTEM, COMPONENT) and vehicle.is_known
        is_running = vehicle.reassembly.is_new and message.sequence > 0
        if is_ours and is_running and not vehicle.refusal:
            if vehicle.client.status.state in ("stopping", "stopped"):
                return received
            definitions = self._adopt(vehicle, now)
            if not vehicle.refusal:
                return received._replace(chunk=definitions)
        if not vehicle.client.accepts(*target):
            # before a HEARTBEAT, perhaps the stream of an earlier process
            return self._refuse(received, vehicle) if is_ours else received
        chunk = vehicle.reassembly.add(
            message.sequence, message.length, message.first_message_offset, message.data, now
        )
        # takes a third of the time of `_replace`
        received = Received(*received[:-3], chunk, link=received.link)
        if chunk.verdict == "delivered" and not chunk.lost:  # a reboot ends the stream
            vehicle.clock.confirm()
        acked = message.get_type() == "LOGGING_DATA_ACKED"
        answer = vehicle.client.on_data(message.sequence, now, acked=acked, begins=chunk.begins)
        self._execute(vehicle, answer)
        return received

    def _refuse(self, received: Received, vehicle: _Vehicle) -> Rejection:
        where = f"{self._reader.name} system {received.system}"
        if not vehicle.refusal:
            kind = received.message.get_type()
            return Rejection(where, f"{kind} of a stream that was not requested")
        reason = (
            f"the ULog stream of an earlier process cannot be continued, because {vehicle.refusal}"
        )
        remedy = "it restarts after disarming, or at once with log=armed"
        return Rejection(f"{where}, ULog stream", f"{reason}; {remedy}")

    def _adopt(self, vehicle: _Vehicle, now: float) -> Chunk | None:
        """Continue the stream of an earlier process; return its definitions, or None while its boot is unknown.

        The message that shows it is not used: an acknowledged one is repeated, and any other one counts as lost.
        """
        path = state_path(self._options, self._reader.name, vehicle.system)
        try:
            saved = read_stream(path, vehicle.system)
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
            message: Any
            if command.kind == "acknowledge":
                message = dialect.MAVLink_logging_ack_message(
                    vehicle.system, AUTOPILOT, command.sequence
                )
            elif command.kind == "ping":
                message = dialect.MAVLink_timesync_message(0, command.sequence)
            else:
                number = COMMANDS[command.kind]
                message = dialect.MAVLink_command_long_message(
                    vehicle.system, AUTOPILOT, number, 0, *_NO_PARAMETERS
                )
            self._send(message, vehicle.peers.peer)
