"""Receive from MAVLink vehicles; every system id on a link is a vehicle."""

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus.errors import ConfigError, SourceError, system_reason
from nedbus.log_event import about
from nedbus.mavlink import AUTOPILOT, CONVERSIONS, Chunk, Received, Vehicle
from nedbus.samples import LogStreamStatus
from nedbus.sources.options import MavlinkOptions
from nedbus.sources.source import LinkCopies, LiveItem, Rejection, SourceMessage
from nedbus.timings import TIMINGS
from nedbus.transport import Session, Tls
from nedbus.ulog import LOG_MESSAGE
from nedbus_msgs import DEFAULT_TOPIC, Address

from .link import DuplicateIds, Link, Peer, name_of, open_link, parse_link
from .log_stream import LogStream
from .position_sender import TIMESYNC_TOPIC, BusAccess, PositionSender, Target, choose_target
from .reader import COMPONENT, SYSTEM, LinkReader, LogReceiver, heartbeat
from .saved_stream import StreamFile, state_path

_log = logging.getLogger(__name__)

HIGH_LATENCY_LINK: Final = (
    "a satellite link, because only HIGH_LATENCY2 arrives: global position, status and battery at its rate; nothing is"
    " sent to the vehicle"
)
"""Description of a link of a vehicle that sends only HIGH_LATENCY2."""

_STATUS_INTERVAL: Final = 1.0  # s between heartbeats, and between status reports of ULog streams


class MavlinkSource:
    """A link to one or more vehicles.

    Fields that MAVLink does not transmit are left out, not derived from others: resets, variances of heading and tilt,
    accelerations and limits of VehicleLocalPosition, and the mode of VehicleStatus.
    Validity is approximated from ESTIMATOR_STATUS, because vehicles send LOCAL_POSITION_NED even while it is invalid.
    """

    def __init__(
        self,
        link: str,
        options: MavlinkOptions,
        _: str,
        routers: tuple[str, ...],
        tls: Tls | None,
        prefix: str,
    ) -> None:
        if parse_link(link).kind != "serial" and "baud" in options.model_fields_set:
            reason = "baud= is the rate of a serial port; remove it"
            raise ConfigError(f"mavlink:{link}", reason, key="baud")
        known = {LOG_MESSAGE.name, *(topic for topic, _ in CONVERSIONS.values())}
        if not options.log and known.isdisjoint(options.chosen_topics or known):
            reason = f"MAVLink has none of these topics; choose from {', '.join(sorted(known))}"
            raise ConfigError(f"mavlink:{link}", reason, key="topics")
        self._link = link
        self._options = options
        self._routers = routers
        self._tls = tls
        self._prefix = prefix

    def listen(self, router: Session | None) -> Iterator[LiveItem]:
        """Receive messages; raise SourceError if the link cannot be opened or fails."""
        access = BusAccess(router, self._routers, self._tls, self._prefix)
        with closing(open_link(self._link, baud=self._options.baud)) as link:
            try:
                session = _LinkSession(link, self._options, name=self._link, access=access)
                with closing(session):
                    yield from session.run()
            except OSError as exc:
                reason = system_reason(exc)
                raise SourceError(f"mavlink:{self._link}", f"the link broke ({reason})") from exc


class _LinkSession:
    """One open link: request and convert messages, send heartbeats; with `log=`, decode the ULog streams."""

    def __init__(
        self, link: Link, options: MavlinkOptions, *, name: str, access: BusAccess
    ) -> None:
        self._link = link
        self._options = options
        self._name = name
        self._sender = dialect.MAVLink(None, SYSTEM, COMPONENT)
        self._sending = threading.Lock()
        self._unsent = 0  # messages that the link did not accept, to be logged
        self._vehicles: dict[int, Vehicle] = {}
        self._remarks: set[tuple[int, str]] = set()  # those made, by system id
        self._copies = 0  # as last reported
        self._copies_of_removed = 0  # of vehicles that were removed
        self._senders = DuplicateIds()
        self._logs: dict[int, LogStream] = {}
        self._receiver = LogReceiver(LinkReader(link, name=name), options, self._send)
        self._positions: PositionSender | None = None
        if options.position is not None:
            self._positions = PositionSender(
                name, options, access, find_target=self._find_target, send=self._send_position
            )

    def run(self) -> Iterator[LiveItem]:
        next_requests = next_status = 0.0
        while True:
            for item in self._receiver.read(TIMINGS.source_tick):
                if isinstance(item, Received):
                    yield from self._handle(item)
                else:
                    yield item
            yield None
            now = time.monotonic()
            if now >= next_requests:
                next_requests = now + TIMINGS.source_tick
                self._send_requests(now)
                for log in self._logs.values():
                    log.log_changes()
            if now >= next_status:
                next_status = now + _STATUS_INTERVAL
                self._remove_evicted()
                for peer in self._all_peers():
                    self._send(heartbeat(), peer)
                self._log_unsent()
                yield from self._report_vehicles()
                yield from self._report_logs(now)
                if self._positions is not None:
                    yield from self._positions.rejections()
                    yield self._positions.status()

    def close(self) -> None:
        """Stop the ULog streams, and close their files."""
        if self._positions is not None:
            self._positions.close()
        for log in self._logs.values():
            log.leave()
        self._receiver.close()
        for log in self._logs.values():
            log.end()

    def _handle(self, received: Received) -> Iterator[SourceMessage | Rejection]:
        system = received.system
        now = received.time
        chunk = received.chunk
        vehicle = self._vehicles.get(system)
        if vehicle is None:
            name = self._name_of(system)
            topics = self._options.chosen_topics
            vehicle = Vehicle(name, topics, rate=self._options.rate, baud=self._link.baud)
            self._vehicles[system] = vehicle
        duplicate = self._senders.add(system, received.peer, now)
        if duplicate:
            extra = about("duplicate", source=self._name)
            _log.warning("%s: %s", self._name, duplicate, extra=extra)
        counted = chunk.lost if chunk else None
        vehicle.count_lost(received.lost, now, counted=counted, link=received.link)
        log = self._log_of(system)
        if chunk is None:
            yield from self._convert(received, vehicle, log)
        elif log is not None:
            yield from self._decode(received, chunk, vehicle, log)

    def _convert(
        self, received: Received, vehicle: Vehicle, log: LogStream | None
    ) -> Iterator[SourceMessage | Rejection]:
        """Yield what is converted from a message."""
        message = received.message
        now = received.time
        is_answer = message.get_type() == "TIMESYNC" and message.tc1
        if log is not None and is_answer and self._is_chosen(received):
            log.add_timesync(message.tc1, message.ts1, now)
        for item in vehicle.handle_all(message, now, log):
            if isinstance(item, SourceMessage):
                yield self._complete(item, vehicle, log, now)
            else:
                yield item

    def _decode(
        self, received: Received, chunk: Chunk, vehicle: Vehicle, log: LogStream
    ) -> Iterator[SourceMessage | Rejection]:
        """Yield what a part of a ULog stream contains."""
        now = received.time
        is_measured = False
        for item in log.add(chunk, now):
            if not isinstance(item, SourceMessage):
                yield item
                continue
            message = self._complete(item, vehicle, log, now)
            if not is_measured:  # the delay is that of the first message in each part
                is_measured = True
                log.add_delay(message.timestamp, time.monotonic())
            yield message
        is_sound = chunk.verdict in ("delivered", "unsynchronised")
        if is_sound and vehicle.clock.newest is not None:
            log.state.update(received.message.sequence, vehicle.clock.newest, now)

    def _complete(
        self, message: SourceMessage, vehicle: Vehicle, log: LogStream | None, now: float
    ) -> SourceMessage:
        """Return a message with the losses and the reboot before it."""
        if self._positions is not None and message.address.topic == TIMESYNC_TOPIC:
            self._positions.on_timesync_status(message.fields, now)
        if vehicle.lost or vehicle.rebooted:
            message = vehicle.report(message, log)
        if message.rebooted:
            address = Address(message.address.vehicle, DEFAULT_TOPIC)
            extra = about("rebooted", address, source=self._name)
            _log.warning("vehicle %s rebooted", address.vehicle, extra=extra)
        return message

    def _log_unsent(self) -> None:
        with self._sending:
            count = self._unsent
            self._unsent = 0
        if count:
            text = (
                "%s: %d messages to the vehicle were not sent, because the link did not accept them"
            )
            _log.warning(text, self._name, count, extra=about("dropped", source=self._name))

    def _log_of(self, system: int) -> LogStream | None:
        """Return the ULog stream of a vehicle; None without `log=`."""
        if system in self._logs or not self._options.log:
            return self._logs.get(system)
        known = self._receiver.vehicles.get(system)
        if known is None:  # removed on another thread
            return None
        state = StreamFile(state_path(self._options, self._name, system), system)
        log = LogStream(self._name_of(system), self._options, known.client, state)
        self._logs[system] = log
        return log

    def _name_of(self, system: int) -> str:
        """Return the configured name of a vehicle; by default its system id, unless another vehicle has this name."""
        names = self._options.vehicles
        own = str(system)
        if own in names:
            return names[own]
        return f"system{system}" if own in names.values() else own

    def _send_requests(self, now: float) -> None:
        for system, vehicle in self._vehicles.items():
            request = vehicle.next_request(now)
            if request is None:
                continue
            number, rate = request
            command = dialect.MAV_CMD_REQUEST_MESSAGE
            interval = 0.0
            if rate:
                command = dialect.MAV_CMD_SET_MESSAGE_INTERVAL
                interval = 1e6 / rate
            message = dialect.MAVLink_command_long_message(
                system, AUTOPILOT, command, 0, number, interval, 0, 0, 0, 0, 0
            )
            self._send_to(system, message)

    def _all_peers(self) -> set[Peer]:
        """Return the addresses of all vehicles, or the only address of the link; none that are behind a satellite."""
        reached = set()
        for system, vehicle in self._vehicles.items():
            if not vehicle.is_high_latency:
                reached.add(system)
        if self._link.peer is None:
            known = [*self._receiver.vehicles.values()]  # changed on another thread
            return {vehicle.peers.peer for vehicle in known if vehicle.system in reached}
        if self._vehicles and not reached:
            return set()
        return {self._link.peer}

    def _is_chosen(self, received: Received) -> bool:
        """Return whether a message is from the address to which the messages for its vehicle are sent."""
        known = self._receiver.vehicles.get(received.system)
        return known is not None and known.peers.peer == received.peer

    def _remark(self, system: int, subject: str, text: str) -> Iterator[Rejection]:
        """Yield a remark about a vehicle once."""
        if (system, subject) not in self._remarks:
            self._remarks.add((system, subject))
            yield Rejection(f"{self._name} system {system}{subject}", text, count=0)

    def _report_vehicles(self) -> Iterator[LinkCopies | Rejection]:
        """Yield the number of copies, and a remark on each unusual link of a vehicle."""
        copies = self._copies_of_removed
        for system, vehicle in self._vehicles.items():
            copies += vehicle.copies
            if vehicle.is_high_latency:
                yield from self._remark(system, "", HIGH_LATENCY_LINK)
            known = self._receiver.vehicles.get(system)
            if known is not None and known.peers.second is not None:
                first = name_of(known.peers.peer)
                second = name_of(known.peers.second)
                text = f"also arrives from {second}; requests go to {first} only"
                yield from self._remark(system, ", second address", text)
            if vehicle.copies:
                text = "its messages come again, or late, over a second link: each is used once, the first time"
                yield from self._remark(system, ", second link", text)
        if copies != self._copies:
            self._copies = copies
            yield LinkCopies(copies)

    def _report_logs(self, now: float) -> Iterator[LogStreamStatus]:
        """Yield the status of each ULog stream, and request the time of its vehicle."""
        for system, log in self._logs.items():
            yield log.status(now)
            if not self._vehicles[system].is_high_latency:
                self._send_to(system, dialect.MAVLink_timesync_message(0, log.request_time()))

    def _remove_evicted(self) -> None:
        """Forget the vehicles that the receiver has removed."""
        known = dict(self._receiver.vehicles)  # changed on another thread
        for system in [*self._vehicles]:
            log = self._logs.get(system)
            if system in known and (log is None or log.serves(known[system].client)):
                continue
            self._copies_of_removed += self._vehicles.pop(system).copies
            self._remarks = {remark for remark in self._remarks if remark[0] != system}
            if log is not None:
                del self._logs[system]
                log.end()

    def _send_to(self, system: int, message: Any) -> None:
        """Send a message to a vehicle, unless it was removed."""
        known = self._receiver.vehicles.get(system)
        if known is not None:
            self._send(message, known.peers.peer)

    def _find_target(self) -> Target:
        """Return the vehicle for positions; called on the thread of PositionSender."""
        targets = []
        for vehicle in [*self._receiver.vehicles.values()]:  # changed on another thread
            name = self._name_of(vehicle.system)
            targets.append(Target(vehicle.system, name, vehicle.peers.peer))
        return choose_target(targets)

    def _send_position(self, frame: bytes, peer: Peer) -> bool:
        try:
            return self._link.send(frame, peer)
        except OSError:  # the link breaks; the thread that reads it reports that
            return False

    def _send(self, message: Any, peer: Peer) -> None:
        with self._sending:  # the thread of LogReceiver also sends
            if not self._link.send(message.pack(self._sender), peer):
                self._unsent += 1
            self._sender.seq = (self._sender.seq + 1) % 256
