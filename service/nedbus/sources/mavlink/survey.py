"""Survey of a MAVLink link: who sends on it, which messages, and whether a PX4 can send its ULog stream there."""

from __future__ import annotations

import struct
import time
from collections import Counter
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus import limits
from nedbus.mavlink import NO_HEARTBEAT, Senders

from .link import DuplicateIds, Link, Packet, Peer, name_of, open_link
from .reader import COMPONENT, SYSTEM, heartbeat

_READ_TIMEOUT: Final = 0.25  # s
_HEARTBEAT_INTERVAL: Final = 1.0  # s

_BAUD: Final = 57600
_BACKEND: Final = "SDLOG_BACKEND"


@dataclass(slots=True)
class SystemTraffic:
    """What one autopilot sent during a survey.

    `messages`: their number by name, such as LOCAL_POSITION_NED. `size`: their bytes, headers included.
    `is_px4`: True once a HEARTBEAT names PX4. `log_clients`: system and component ids that receive its ULog stream.
    `log_backend`: the value of SDLOG_BACKEND; None if it has not answered. `round_trip`: the shortest one [s], measured
    with TIMESYNC; None without an answer.
    """

    messages: Counter[str] = field(default_factory=Counter)
    size: int = 0
    is_px4: bool = False
    log_clients: set[tuple[int, int]] = field(default_factory=set)
    log_backend: int | None = None
    round_trip: float | None = None

    @property
    def sends_log_to_nedbus(self) -> bool:
        """True if a client of its ULog stream has the system id of nedbus's source."""
        return any(system == SYSTEM for system, _ in self.log_clients)


@dataclass(slots=True)
class LinkSurvey:
    """What arrived on a link; `survey_link` returns one.

    `packets`: their number by address, of the first `limits.SHOWN_NAMES` addresses.
    `systems`: the autopilots by system id.
    `ignored`: why other senders are ignored, by system and component id. `duplicates`: system ids with which two
    addresses send, with a sentence that names these.
    """

    packets: Counter[str] = field(default_factory=Counter)
    systems: dict[int, SystemTraffic] = field(default_factory=dict)
    ignored: dict[tuple[int, int], str] = field(default_factory=dict)
    duplicates: dict[int, str] = field(default_factory=dict)


def survey_link(link: str, seconds: float) -> LinkSurvey:
    """Listen on a link such as udpin:0.0.0.0:14540 for some seconds, and return who sent what.

    It sends a HEARTBEAT every second to a peer that is known in advance, since some send only to addresses from which
    they received, and requests SDLOG_BACKEND and TIMESYNC from each PX4. It changes nothing on the vehicles.

    Raises ConfigError for an invalid link, SourceError if it cannot be opened.
    """
    with closing(open_link(link, baud=_BAUD)) as opened:
        surveyor = _Surveyor(opened, seconds)
        surveyor.run()
    return surveyor.survey


class _Surveyor:
    """Reception of a survey on an open link."""

    def __init__(self, link: Link, seconds: float) -> None:
        self.survey = LinkSurvey()
        self._link = link
        self._seconds = seconds
        self._senders = Senders()
        self._addresses = DuplicateIds()
        self._encoder = dialect.MAVLink(None, SYSTEM, COMPONENT)
        self._parser = _new_parser()

    def run(self) -> None:
        """Receive until the time is over."""
        now = time.monotonic()
        end = now + self._seconds
        next_heartbeat = now
        while now < end:
            if self._link.peer is not None and now >= next_heartbeat:
                next_heartbeat = now + _HEARTBEAT_INTERVAL
                self._send(heartbeat(), self._link.peer)
            for packet in self._link.read(_READ_TIMEOUT):
                self._on_packet(packet, now)
            now = time.monotonic()

    def _on_packet(self, packet: Packet, now: float) -> None:
        packets = self.survey.packets
        name = name_of(packet.peer)
        if name in packets or len(packets) < limits.SHOWN_NAMES:
            packets[name] += 1
        if not self._link.stream:
            self._parser = _new_parser()  # a datagram holds whole messages
        for message in self._parser.parse_buffer(packet.data) or []:
            # Messages of these types have no header.
            if not message.get_type().startswith(("BAD_DATA", "UNKNOWN")):
                self._on_message(message, packet.peer, now)

    def _on_message(self, message: Any, peer: Peer, now: float) -> None:
        survey = self.survey
        ids = message.get_srcSystem(), message.get_srcComponent()
        reason = self._senders.ignore_reason(message, *ids)
        if reason:
            survey.ignored[ids] = reason
            return
        if survey.ignored.get(ids) == NO_HEARTBEAT:
            del survey.ignored[ids]  # it has identified itself since
        system, _ = ids
        duplicate = self._addresses.add(system, peer, now)
        if duplicate:
            survey.duplicates[system] = duplicate
        traffic = survey.systems.setdefault(system, SystemTraffic())
        self._add(traffic, message)
        if message.get_type() == "HEARTBEAT" and traffic.is_px4:
            self._request_state(ids, peer)

    def _add(self, traffic: SystemTraffic, message: Any) -> None:
        """Add a message to what its system sent."""
        name = message.get_type()
        traffic.messages[name] += 1
        traffic.size += len(message.get_msgbuf())
        if name == "HEARTBEAT" and message.autopilot == dialect.MAV_AUTOPILOT_PX4:
            traffic.is_px4 = True
        elif name.startswith("LOGGING_DATA"):
            traffic.log_clients.add((message.target_system, message.target_component))
        elif name == "PARAM_VALUE" and message.param_id == _BACKEND:
            traffic.log_backend = _integer_of(message.param_value)
        elif name == "TIMESYNC" and message.tc1:
            self._add_round_trip(traffic, (time.monotonic_ns() - message.ts1) / 1e9)

    def _add_round_trip(self, traffic: SystemTraffic, trip: float) -> None:
        """Add a measured round trip [s]; a longer one than the survey answers another program's request."""
        if not 0 <= trip < self._seconds:
            return
        if traffic.round_trip is None or trip < traffic.round_trip:
            traffic.round_trip = trip

    def _request_state(self, ids: tuple[int, int], peer: Peer) -> None:
        """Request the parameter of the log's destination, and a round trip, from a PX4."""
        self._send(dialect.MAVLink_param_request_read_message(*ids, _BACKEND.encode(), -1), peer)
        self._send(dialect.MAVLink_timesync_message(0, time.monotonic_ns()), peer)

    def _send(self, message: Any, peer: Peer) -> None:
        self._link.send(message.pack(self._encoder), peer)


def _new_parser() -> Any:
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    return parser


def _integer_of(value: float) -> int:
    """Return the integer that PX4 sends as the bytes of a float."""
    (integer,) = struct.unpack("<i", struct.pack("<f", value))
    return int(integer)
