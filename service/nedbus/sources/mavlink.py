"""Vehicles that speak MAVLink: all system ids on one link, each a vehicle of its own."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus.errors import SourceError
from nedbus_msgs import Address

from .mavlink_link import Link, Peer, check_link, open_link
from .mavlink_vehicle import OutOfOrderError, Vehicle
from .record import Home, Record, Refusal
from .spec import MavlinkOptions

_log = logging.getLogger(__name__)

_TICK: Final = 0.25  # s
_HEARTBEAT: Final = 1.0  # s
_BUFFER: Final = 2**16  # bytes that a stream's parser may keep
_SYSTEM: Final = 245  # who we are: a companion computer, as losing one is no failsafe, which losing a ground station is
_AUTOPILOT: Final = 1
_TOPIC: Final = "vehicle_local_position"
_OTHERS: Final = 255  # autopilots with another component id that are kept in mind


class MavlinkSource:
    """A link with one or many vehicles.

    What MAVLink does not tell is not provided: resets, variances of heading and tilt, accelerations, limits.
    Validity is an approximation from ESTIMATOR_STATUS: LOCAL_POSITION_NED itself is sent whether valid or not.
    """

    def __init__(self, link: str, options: MavlinkOptions, _: Home) -> None:
        check_link(link)
        self._link = link
        self._options = options
        self._us = dialect.MAVLink(None, _SYSTEM, dialect.MAV_COMP_ID_ONBOARD_COMPUTER)

    def listen(self) -> Iterator[Record | Refusal | None]:
        """Listen; raise SourceError when the link cannot be opened, or breaks."""
        with closing(open_link(self._link, baud=self._options.baud)) as link:
            try:
                yield from _Conversation(link, self._options, self._us, name=self._link).run()
            except OSError as exc:
                reason = (exc.strerror or str(exc)).lower()
                raise SourceError(f"mavlink:{self._link}", f"the link broke ({reason})") from exc


class _Conversation:
    """What is said on an open link, until it breaks."""

    def __init__(self, link: Link, options: MavlinkOptions, us: Any, *, name: str) -> None:
        self._link = link
        self._options = options
        self._us = us
        self._name = name
        self._parser = _new_parser()
        self._vehicles: dict[int, Vehicle] = {}
        self._peers: dict[int, Peer] = {}
        self._autopilots: set[tuple[int, int]] = set()  # besides component 1 of any system

    def run(self) -> Iterator[Record | Refusal | None]:
        tick = beat = 0.0
        while True:
            for data, peer in self._link.read(_TICK):
                for message in self._parse(data):
                    yield self._take(message, peer)
                if not self._link.stream and self._parser.buf_len():
                    yield Refusal(self._name, f"{self._parser.buf_len()} bytes of a message that is cut")
            yield None
            now = time.monotonic()
            if now >= tick:
                tick = now + _TICK
                self._ask(now)
            if now >= beat:
                beat = now + _HEARTBEAT
                self._say_hello()

    def _parse(self, data: bytes) -> list[Any]:
        if not self._link.stream or len(self._parser.buf) > _BUFFER:
            # Half a message in one datagram must not swallow the next one, which is somebody else's.
            self._parser = _new_parser()
        return self._parser.parse_buffer(data) or []

    def _take(self, message: Any, peer: Peer) -> Record | Refusal | None:
        raw = bytes(message.get_msgbuf())
        if message.get_type() == "BAD_DATA":
            return Refusal(self._name, f"{len(raw)} bytes that are no MAVLink")
        # Of a message that the dialect does not know only the head can be read.
        sequence, system, component = raw[4:7] if raw[0] == dialect.PROTOCOL_MARKER_V2 else raw[2:5]
        if not system or not self._is_autopilot(message, system, component):
            return None
        now = time.monotonic()
        vehicle = self._vehicles.get(system)
        if vehicle is None:
            vehicle = self._vehicles[system] = Vehicle(self._options.rate)
        self._peers[system] = peer
        vehicle.count(component, sequence, now)
        address = Address(self._vehicle_of(system), _TOPIC)
        if message.get_type() == "COMMAND_ACK":
            self._take_answer(vehicle, message, address, now)
            return None
        try:
            fields = vehicle.take(message, now)
        except OutOfOrderError as exc:
            return Refusal(str(address), f"out of order: {exc}", address)
        if fields is None:
            return None
        lost, restarted = vehicle.lost, vehicle.restarted
        vehicle.lost, vehicle.restarted = 0, False
        if restarted:
            _log.warning("%s: started again", address)
        return Record(0.0, address, fields, lost, restarted)

    def _vehicle_of(self, system: int) -> str:
        named = self._options.vehicles
        plain = f"system{system}" if str(system) in named.values() else str(system)
        return named.get(str(system), plain)

    def _is_autopilot(self, message: Any, system: int, component: int) -> bool:
        """Return whether this may tell where the vehicle is: a camera, a gimbal or a ground station may not."""
        if component == _AUTOPILOT or (system, component) in self._autopilots:
            return True
        if message.get_type() == "HEARTBEAT" and message.autopilot != dialect.MAV_AUTOPILOT_INVALID:
            if len(self._autopilots) < _OTHERS:
                self._autopilots.add((system, component))
            return True
        return False

    def _take_answer(self, vehicle: Vehicle, message: Any, address: Address, now: float) -> None:
        if message.command not in (dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAV_CMD_REQUEST_MESSAGE):
            return
        if message.target_system not in (0, _SYSTEM) or message.result == dialect.MAV_RESULT_IN_PROGRESS:
            return
        number = vehicle.answered(now)
        if number is not None and message.result != dialect.MAV_RESULT_ACCEPTED:
            _log.info("%s: does not send %s at a rate that is asked for", address, dialect.mavlink_map[number].msgname)
        self._ask(now)

    def _ask(self, now: float) -> None:
        for system, vehicle in self._vehicles.items():
            for number, rate in vehicle.requests(now):
                command = dialect.MAV_CMD_SET_MESSAGE_INTERVAL if rate else dialect.MAV_CMD_REQUEST_MESSAGE
                interval = 1e6 / rate if rate else 0
                self._send(
                    dialect.MAVLink_command_long_message(
                        system, _AUTOPILOT, command, 0, number, interval, 0, 0, 0, 0, 0
                    ),
                    self._peers[system],
                )

    def _say_hello(self) -> None:
        """Let routers and vehicles know that somebody is here."""
        hello = dialect.MAVLink_heartbeat_message(
            dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE, 3
        )
        for peer in {self._link.peer} - {None} or set(self._peers.values()):
            self._send(hello, peer)

    def _send(self, message: Any, peer: Peer) -> None:
        self._link.send(message.pack(self._us), peer)
        self._us.seq = (self._us.seq + 1) % 256


def _new_parser() -> Any:
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    return parser
