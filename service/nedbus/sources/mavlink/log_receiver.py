"""Requests and acknowledges the ULog streams of all vehicles on a link, in the thread that reads it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus.sources.options import MavlinkOptions
from nedbus.sources.source import Rejection

from .fields import is_reboot
from .log_client import Command, LogStreamClient
from .log_reassembly import Reassembly
from .reader import Received
from .senders import AUTOPILOT, Peer

_KINDS: Final = ("LOGGING_DATA_ACKED", "LOGGING_DATA")
_COMMANDS: Final = {"start": dialect.MAV_CMD_LOGGING_START, "stop": dialect.MAV_CMD_LOGGING_STOP}


@dataclass(slots=True)
class _Vehicle:
    client: LogStreamClient
    peer: Peer
    reassembly: Reassembly = field(default_factory=Reassembly)
    newest: int = 0  # ms since boot


class LogReceiver:
    """The streams by system id. `send`: sends a MAVLink message to a peer; it must not wait."""

    def __init__(
        self, options: MavlinkOptions, name: str, send: Callable[[Any, Peer], object], *, system: int, component: int
    ) -> None:
        self._options, self._name, self._send = options, name, send
        self._ids = system, component
        self._vehicles: dict[int, _Vehicle] = {}

    def client(self, system: int) -> LogStreamClient | None:
        """Return the client of a vehicle; None before its first heartbeat."""
        vehicle = self._vehicles.get(system)
        return vehicle.client if vehicle is not None else None

    def take(self, received: Received, *, has_room: bool) -> Received | Rejection:
        """Acknowledge a message and reassemble its data; without room it is lost, as if the link had lost it."""
        message, kind, now = received.message, received.message.get_type(), received.time
        vehicle = self._vehicles.get(received.system)
        if kind in _KINDS:
            target = message.target_system, message.target_component
            if vehicle is None or not vehicle.client.accepts(*target):
                if target != self._ids:
                    return received
                return Rejection(f"{self._name} system {received.system}", f"{kind} of a stream that was not requested")
            begins = False
            if has_room:
                fields = message.sequence, message.length, message.first_message_offset, message.data
                received = received._replace(piece=vehicle.reassembly.add(*fields))
                begins = received.piece is not None and received.piece.begins
            is_acked = kind == _KINDS[0]
            self._act(received.system, vehicle.client.on_data(message.sequence, now, acked=is_acked, begins=begins))
            return received
        if kind == "HEARTBEAT":
            if vehicle is None:
                system, component = self._ids
                client = LogStreamClient(self._options.log, system=system, component=component)
                vehicle = self._vehicles[received.system] = _Vehicle(client, received.peer)
            vehicle.peer = received.peer
            armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
            self._act(received.system, vehicle.client.on_heartbeat(message.autopilot, now, armed=armed))
        elif vehicle is not None and kind == "COMMAND_ACK":
            target = message.target_system, message.target_component
            commands = vehicle.client.on_command_ack(message.command, message.result, *target, now)
            self._act(received.system, commands)
        elif vehicle is not None and (ms := getattr(message, "time_boot_ms", None)) is not None:
            if is_reboot(ms, vehicle.newest):
                vehicle.client.on_reboot()
                vehicle.newest = ms
            vehicle.newest = max(ms, vehicle.newest)
        return received

    def tick(self, now: float) -> None:
        """Send the commands that are due."""
        for system, vehicle in self._vehicles.items():
            self._act(system, vehicle.client.tick(now))

    def stop(self, now: float) -> None:
        """Send STOP to each vehicle; go on with `take` and `tick` while `is_stopping`."""
        for system, vehicle in self._vehicles.items():
            self._act(system, vehicle.client.stop(now))

    @property
    def is_stopping(self) -> bool:
        """True while PX4 has not confirmed a STOP."""
        return any(vehicle.client.status.state == "stopping" for vehicle in self._vehicles.values())

    def _act(self, system: int, commands: Iterable[Command]) -> None:
        for command in commands:
            if command.kind == "acknowledge":
                message: Any = dialect.MAVLink_logging_ack_message(system, AUTOPILOT, command.sequence)
            else:
                parameters = [_COMMANDS[command.kind], 0, *(0,) * 7]
                message = dialect.MAVLink_command_long_message(system, AUTOPILOT, *parameters)
            self._send(message, self._vehicles[system].peer)
