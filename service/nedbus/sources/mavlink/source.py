"""Receive from vehicles that speak MAVLink: every system id on a link is a vehicle."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus.errors import ConfigError, SourceError
from nedbus.log_event import about
from nedbus.sources.options import MavlinkOptions
from nedbus.sources.source import Rejection, SourceContext, SourceMessage
from nedbus.transport import Session
from nedbus_msgs import DEFAULT_TOPIC, Address

from .fields import SAID
from .link import Link, Peer, check_link, open_link
from .vehicle import Vehicle

_log = logging.getLogger(__name__)

_TICK: Final = 0.25  # s
_HEARTBEAT_INTERVAL: Final = 1.0  # s
_MAX_BUFFER: Final = 2**16  # bytes that a stream's parser may keep
# Ours: a companion computer, as losing one triggers no failsafe, which losing a ground station does.
_SYSTEM: Final = 245
_AUTOPILOT: Final = 1
_MAX_AUTOPILOTS: Final = 255  # with another component id


class MavlinkSource:
    """A link with one or many vehicles.

    What MAVLink does not transmit is not provided: of a position resets, variances of heading and tilt, accelerations,
    limits; of the state the mode. Nothing is derived that a vehicle did not say.
    Validity is an approximation from ESTIMATOR_STATUS: LOCAL_POSITION_NED itself is sent whether valid or not.
    """

    def __init__(self, link: str, options: MavlinkOptions, _: SourceContext) -> None:
        check_link(link)
        known = {topic for topic, _ in SAID.values()}
        if known.isdisjoint(options.chosen_topics or known):
            reason = f"MAVLink says nothing of these topics, but of {', '.join(sorted(known))}"
            raise ConfigError(f"mavlink:{link}", reason, key="topics")
        self._link = link
        self._options = options
        self._sender = dialect.MAVLink(None, _SYSTEM, dialect.MAV_COMP_ID_ONBOARD_COMPUTER)

    def listen(self, _: Session | None) -> Iterator[SourceMessage | Rejection | None]:
        """Receive; raise SourceError when the link cannot be opened, or breaks."""
        with closing(open_link(self._link, baud=self._options.baud)) as link:
            try:
                yield from _LinkSession(link, self._options, self._sender, name=self._link).run()
            except OSError as exc:
                reason = (exc.strerror or str(exc)).lower()
                raise SourceError(f"mavlink:{self._link}", f"the link broke ({reason})") from exc


class _LinkSession:
    """One open link: parse what arrives, request streams, send heartbeats."""

    def __init__(self, link: Link, options: MavlinkOptions, sender: Any, *, name: str) -> None:
        self._link = link
        self._options = options
        self._sender = sender
        self._name = name
        self._parser = _new_parser()
        self._vehicles: dict[int, Vehicle] = {}
        self._peers: dict[int, Peer] = {}
        self._autopilots: set[tuple[int, int]] = set()  # besides component 1 of any system
        self._denied: set[tuple[str, int]] = set()  # vehicles, and what they do not send: each is logged once

    def run(self) -> Iterator[SourceMessage | Rejection | None]:
        next_requests = next_heartbeat = 0.0
        while True:
            for data, peer in self._link.read(_TICK):
                for message in self._parse(data):
                    yield self._handle(message, peer)
                if not self._link.stream and self._parser.buf_len():
                    yield Rejection(self._name, f"{self._parser.buf_len()} bytes of a truncated message")
            yield None
            now = time.monotonic()
            if now >= next_requests:
                next_requests = now + _TICK
                self._send_requests(now)
            if now >= next_heartbeat:
                next_heartbeat = now + _HEARTBEAT_INTERVAL
                self._send_heartbeat()

    def _parse(self, data: bytes) -> list[Any]:
        if not self._link.stream or len(self._parser.buf) > _MAX_BUFFER:
            # Half a message in one datagram must not consume the next one, which may have another sender.
            self._parser = _new_parser()
        return self._parser.parse_buffer(data) or []

    def _handle(self, message: Any, peer: Peer) -> SourceMessage | Rejection | None:
        raw = bytes(message.get_msgbuf())
        if message.get_type() == "BAD_DATA":
            return Rejection(self._name, f"{len(raw)} bytes that are not MAVLink")
        # Of a message that is not in the dialect only the header can be parsed.
        sequence, system, component = raw[4:7] if raw[0] == dialect.PROTOCOL_MARKER_V2 else raw[2:5]
        if not system or not self._is_autopilot(message, system, component):
            return None
        now = time.monotonic()
        name = self._vehicle_of(system)
        vehicle = self._vehicles.get(system)
        if vehicle is None:
            vehicle = self._vehicles[system] = Vehicle(name, self._options)
        self._peers[system] = peer
        vehicle.track_sequence(component, sequence, now)
        address = Address(name, DEFAULT_TOPIC)
        if message.get_type() == "COMMAND_ACK":
            self._handle_ack(vehicle, message, address, now)
            return None
        said = vehicle.handle(message, now)
        if isinstance(said, SourceMessage) and said.rebooted:
            _log.warning("%s: the vehicle rebooted", address, extra=about("rebooted", address, source=self._name))
        return said

    def _vehicle_of(self, system: int) -> str:
        configured = self._options.vehicles
        default = f"system{system}" if str(system) in configured.values() else str(system)
        return configured.get(str(system), default)

    def _is_autopilot(self, message: Any, system: int, component: int) -> bool:
        """Return whether this is from an autopilot, not from a camera, a gimbal or a ground station."""
        if component == _AUTOPILOT or (system, component) in self._autopilots:
            return True
        if message.get_type() == "HEARTBEAT" and message.autopilot != dialect.MAV_AUTOPILOT_INVALID:
            if len(self._autopilots) < _MAX_AUTOPILOTS:
                self._autopilots.add((system, component))
            return True
        return False

    def _handle_ack(self, vehicle: Vehicle, message: Any, address: Address, now: float) -> None:
        if message.command not in (dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAV_CMD_REQUEST_MESSAGE):
            return
        if message.target_system not in (0, _SYSTEM) or message.result == dialect.MAV_RESULT_IN_PROGRESS:
            return
        number = vehicle.acknowledge(now)
        is_denied = message.result != dialect.MAV_RESULT_ACCEPTED
        if number is not None and is_denied and vehicle.has(number) and (address.vehicle, number) not in self._denied:
            self._denied.add((address.vehicle, number))
            name = dialect.mavlink_map[number].msgname
            extra = about("unsupported", address, source=self._name)
            _log.info("%s: does not send %s when it is requested", address, name, extra=extra)
        self._send_requests(now)

    def _send_requests(self, now: float) -> None:
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

    def _send_heartbeat(self) -> None:
        """Announce this component: routers and vehicles send nothing to one that they do not know."""
        heartbeat = dialect.MAVLink_heartbeat_message(
            dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE, 3
        )
        for peer in {self._link.peer} - {None} or set(self._peers.values()):
            self._send(heartbeat, peer)

    def _send(self, message: Any, peer: Peer) -> None:
        self._link.send(message.pack(self._sender), peer)
        self._sender.seq = (self._sender.seq + 1) % 256


def _new_parser() -> Any:
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    return parser
