"""Receive from MAVLink vehicles; every system id on a link is a vehicle."""

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

from .fields import CONVERSIONS
from .link import Link, Peer, open_link, parse_link
from .vehicle import Vehicle

_log = logging.getLogger(__name__)

_TICK: Final = 0.25  # s
_HEARTBEAT_INTERVAL: Final = 1.0  # s
_MAX_BUFFER: Final = 2**16  # bytes kept by the parser of a stream
# Of a companion computer: unlike a ground station, its loss triggers no failsafe.
_SYSTEM: Final = 245
_AUTOPILOT: Final = 1  # component id; cameras, gimbals and ground stations have others


class MavlinkSource:
    """A link to one or several vehicles.

    Fields that MAVLink does not transmit are not provided, and not derived from others: resets, variances of heading
    and tilt, accelerations and limits of VehicleLocalPosition, and the mode of VehicleStatus.
    Validity is approximated from ESTIMATOR_STATUS, as LOCAL_POSITION_NED is sent even while it is invalid.
    """

    def __init__(self, link: str, options: MavlinkOptions, _: SourceContext) -> None:
        parse_link(link)
        known = {topic for topic, _ in CONVERSIONS.values()}
        if known.isdisjoint(options.chosen_topics or known):
            reason = f"MAVLink has none of these topics; choose from {', '.join(sorted(known))}"
            raise ConfigError(f"mavlink:{link}", reason, key="topics")
        self._link = link
        self._options = options

    def listen(self, _: Session | None) -> Iterator[SourceMessage | Rejection | None]:
        """Receive; raise SourceError if the link cannot be opened or breaks."""
        with closing(open_link(self._link, baud=self._options.baud)) as link:
            try:
                yield from _LinkSession(link, self._options, name=self._link).run()
            except OSError as exc:
                reason = (exc.strerror or str(exc)).lower()
                raise SourceError(f"mavlink:{self._link}", f"the link broke ({reason})") from exc


class _LinkSession:
    """One open link: parse messages, request streams, send heartbeats."""

    def __init__(self, link: Link, options: MavlinkOptions, *, name: str) -> None:
        self._link = link
        self._options = options
        self._name = name
        self._sender = dialect.MAVLink(None, _SYSTEM, dialect.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._parser = _new_parser()
        self._vehicles: dict[int, Vehicle] = {}
        self._peers: dict[int, Peer] = {}

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
        # If the dialect does not have the message, only its header can be parsed.
        sequence, system, component = raw[4:7] if raw[0] == dialect.PROTOCOL_MARKER_V2 else raw[2:5]
        if not system or component != _AUTOPILOT:
            return None
        now = time.monotonic()
        vehicle = self._vehicles.get(system)
        if vehicle is None:
            vehicle = self._vehicles[system] = Vehicle(self._name_of(system), self._options)
        self._peers[system] = peer
        vehicle.track_sequence(sequence, now)
        converted = vehicle.handle(message, now)
        if isinstance(converted, SourceMessage) and converted.rebooted:
            address = Address(converted.address.vehicle, DEFAULT_TOPIC)
            _log.warning("%s: the vehicle rebooted", address, extra=about("rebooted", address, source=self._name))
        return converted

    def _name_of(self, system: int) -> str:
        configured = self._options.vehicles
        default = f"system{system}" if str(system) in configured.values() else str(system)
        return configured.get(str(system), default)

    def _send_requests(self, now: float) -> None:
        for system, vehicle in self._vehicles.items():
            if request := vehicle.next_request(now):
                number, rate = request
                command = dialect.MAV_CMD_SET_MESSAGE_INTERVAL if rate else dialect.MAV_CMD_REQUEST_MESSAGE
                parameters = [number, 1e6 / rate if rate else 0, 0, 0, 0, 0, 0]
                message = dialect.MAVLink_command_long_message(system, _AUTOPILOT, command, 0, *parameters)
                self._send(message, self._peers[system])

    def _send_heartbeat(self) -> None:
        """Announce this component: routers and vehicles send only to components that they know."""
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
