"""Receive from MAVLink vehicles; every system id on a link is a vehicle."""

import logging
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import closing
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus.errors import ConfigError, SourceError
from nedbus.log_event import about
from nedbus.mavlink import AUTOPILOT, CONVERSIONS, Received, Vehicle
from nedbus.sources.options import MavlinkOptions
from nedbus.sources.source import LinkCopies, LiveItem, Rejection, SourceMessage
from nedbus.timings import TIMINGS
from nedbus.transport import Session, Tls
from nedbus.ulog import LOG_MESSAGE
from nedbus_msgs import DEFAULT_TOPIC, Address

from .link import DuplicateIds, Link, Peer, name_of, open_link, parse_link
from .log_stream import LogStream
from .position_sender import TIMESYNC_TOPIC, BusAccess, PositionSender, Target, choose_target
from .reader import COMPONENT, SYSTEM, LinkReader, LogReceiver
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
            raise ConfigError(
                f"mavlink:{link}", "baud= is the rate of a serial port; remove it", key="baud"
            )
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
                with closing(
                    _LinkSession(link, self._options, name=self._link, access=access)
                ) as session:
                    yield from session.run()
            except OSError as exc:
                reason = (exc.strerror or str(exc)).lower()
                raise SourceError(f"mavlink:{self._link}", f"the link broke ({reason})") from exc


class _LinkSession:
    """One open link: request and convert messages, send heartbeats; with `log=`, decode the ULog streams."""

    def __init__(
        self, link: Link, options: MavlinkOptions, *, name: str, access: BusAccess | None = None
    ) -> None:
        self._link = link
        self._options = options
        self._name = name
        self._sender = dialect.MAVLink(None, SYSTEM, COMPONENT)
        self._sending = threading.Lock()
        self._unsent = 0  # messages that the link did not accept, to be logged
        self._vehicles: dict[int, Vehicle] = {}
        self._remarked: set[int] = set()  # system ids whose second address was reported
        self._copied: set[int] = set()  # system ids whose copies were reported
        # as last reported; those of vehicles that were removed
        self._copies = self._copies_of_removed = 0
        self._high_latency: set[int] = set()  # system ids whose satellite link was reported
        self._senders = DuplicateIds()
        self._logs: dict[int, LogStream] = {}
        self._receiver = LogReceiver(LinkReader(link, name=name), options, self._send)
        self._positions: PositionSender | None = None
        if options.position is not None and access is not None:
            find, send = self._find_target, self._send_position
            self._positions = PositionSender(name, options, access, find_target=find, send=send)

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
                # Routers and vehicles send only to components that have announced themselves.
                kind, autopilot = dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID
                heartbeat = dialect.MAVLink_heartbeat_message(
                    kind, autopilot, 0, 0, dialect.MAV_STATE_ACTIVE, 3
                )
                self._remove_evicted()
                for peer in self._all_peers():
                    self._send(heartbeat, peer)
                self._log_unsent()
                yield from self._report_copies()
                for system, log in self._logs.items():
                    yield log.status(now)
                    if self._vehicles[system].is_high_latency:
                        continue
                    self._send_to(system, dialect.MAVLink_timesync_message(0, log.request_time()))
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
        message = received.message
        system = received.system
        now = received.time
        chunk = received.chunk
        vehicle = self._vehicles.get(system)
        if vehicle is None:
            options, name = self._options, self._name_of(system)
            vehicle = Vehicle(name, options.chosen_topics, rate=options.rate, baud=self._link.baud)
            self._vehicles[system] = vehicle
        if text := self._senders.add(system, received.peer, now):
            _log.warning("%s: %s", self._name, text, extra=about("duplicate", source=self._name))
        yield from self._second_address(system)
        vehicle.count_lost(
            received.lost, now, counted=chunk.lost if chunk else None, link=received.link
        )
        log = self._log_of(system)
        if (
            log is not None
            and message.get_type() == "TIMESYNC"
            and message.tc1
            and self._is_chosen(received)
        ):
            log.add_timesync(message.tc1, message.ts1, now)
        if chunk is None:
            items: Iterable[SourceMessage | Rejection] = vehicle.handle_all(message, now, log)
            if vehicle.is_high_latency and system not in self._high_latency:
                self._high_latency.add(system)
                yield Rejection(f"{self._name} system {system}", HIGH_LATENCY_LINK, count=0)
        else:
            items = log.add(chunk, now) if log is not None else ()
        # the delay is that of the first message in each part of a stream
        is_measured = log is None or chunk is None
        for each in items:
            if not isinstance(each, SourceMessage):
                yield each
                continue
            if self._positions is not None and each.address.topic == TIMESYNC_TOPIC:
                self._positions.on_timesync_status(each.fields, now)
            item = vehicle.report(each, log) if vehicle.lost or vehicle.rebooted else each
            if log is not None and not is_measured:
                is_measured = True
                log.add_delay(item.timestamp, time.monotonic())
            if item.rebooted:
                address = Address(item.address.vehicle, DEFAULT_TOPIC)
                extra = about("rebooted", address, source=self._name)
                _log.warning("vehicle %s rebooted", address.vehicle, extra=extra)
            yield item
        if (
            log
            and chunk
            and chunk.verdict in ("delivered", "unsynchronised")
            and vehicle.clock.newest is not None
        ):
            log.state.update(message.sequence, vehicle.clock.newest, now)

    def _log_unsent(self) -> None:
        with self._sending:
            count, self._unsent = self._unsent, 0
        if count:
            text = (
                "%s: %d messages to the vehicle were not sent, because the link did not accept them"
            )
            _log.warning(text, self._name, count, extra=about("dropped", source=self._name))

    def _log_of(self, system: int) -> LogStream | None:
        """Return the ULog stream of a vehicle; None without `log=`."""
        known = self._receiver.vehicles.get(system)
        if system not in self._logs and self._options.log and known is not None:
            client = known.client
            state = StreamFile(state_path(self._options, self._name, system), system)
            self._logs[system] = LogStream(self._name_of(system), self._options, client, state)
        return self._logs.get(system)

    def _name_of(self, system: int) -> str:
        configured = self._options.vehicles
        default = f"system{system}" if str(system) in configured.values() else str(system)
        return configured.get(str(system), default)

    def _send_requests(self, now: float) -> None:
        for system, vehicle in self._vehicles.items():
            if request := vehicle.next_request(now):
                number, rate = request
                command = (
                    dialect.MAV_CMD_SET_MESSAGE_INTERVAL
                    if rate
                    else dialect.MAV_CMD_REQUEST_MESSAGE
                )
                parameters = [number, 1e6 / rate if rate else 0, 0, 0, 0, 0, 0]
                message = dialect.MAVLink_command_long_message(
                    system, AUTOPILOT, command, 0, *parameters
                )
                self._send_to(system, message)

    def _all_peers(self) -> set[Peer]:
        """Return the addresses of all vehicles, or the only address of the link; none that are behind a satellite."""
        reached = {
            system for system, vehicle in self._vehicles.items() if not vehicle.is_high_latency
        }
        if self._link.peer is not None:
            return {self._link.peer} if reached or not self._vehicles else set()
        known = [*self._receiver.vehicles.values()]  # changed on another thread
        return {vehicle.peers.peer for vehicle in known if vehicle.system in reached}

    def _is_chosen(self, received: Received) -> bool:
        """Return whether a message is from the address to which the messages for its vehicle are sent."""
        known = self._receiver.vehicles.get(received.system)
        return known is not None and known.peers.peer == received.peer

    def _second_address(self, system: int) -> Iterator[Rejection]:
        """Yield a remark, once, if a vehicle's id also arrives from another address."""
        known = self._receiver.vehicles.get(system)
        if known is None or known.peers.second is None or system in self._remarked:
            return
        self._remarked.add(system)
        text = f"also arrives from {name_of(known.peers.second)}; requests go to {name_of(known.peers.peer)} only"
        yield Rejection(f"{self._name} system {system}, second address", text, count=0)

    def _report_copies(self) -> Iterator[LinkCopies | Rejection]:
        """Yield the number of copies, and a remark on the first ones of each vehicle."""
        for system, vehicle in self._vehicles.items():
            if vehicle.copies and system not in self._copied:
                self._copied.add(system)
                text = "its messages come again, or late, over a second link: each is used once, the first time"
                yield Rejection(f"{self._name} system {system}, second link", text, count=0)
        copies = self._copies_of_removed + sum(
            vehicle.copies for vehicle in self._vehicles.values()
        )
        if copies != self._copies:
            self._copies = copies
            yield LinkCopies(copies)

    def _remove_evicted(self) -> None:
        """Forget the vehicles that the receiver has removed."""
        known = dict(self._receiver.vehicles)  # changed on another thread
        for system in [*self._vehicles]:
            log = self._logs.get(system)
            if system in known and (log is None or log.serves(known[system].client)):
                continue
            self._copies_of_removed += self._vehicles.pop(system).copies
            self._copied.discard(system)
            self._remarked.discard(system)
            if log is not None:
                del self._logs[system]
                log.end()

    def _send_to(self, system: int, message: Any) -> None:
        """Send a message to a vehicle, unless it was removed."""
        if (known := self._receiver.vehicles.get(system)) is not None:
            self._send(message, known.peers.peer)

    def _find_target(self) -> Target:
        """Return the vehicle for positions; called on the thread of PositionSender."""
        known = [*self._receiver.vehicles.values()]  # changed on another thread
        return choose_target(
            {each.system: (self._name_of(each.system), each.peers.peer) for each in known}
        )

    def _send_position(self, frame: bytes, peer: Peer) -> bool:
        try:
            return self._link.send(frame, peer)
        except OSError:  # the link breaks; the thread that reads it reports that
            return False

    def _send(self, message: Any, peer: Peer) -> None:
        with self._sending:  # the thread of LogReceiver also sends
            self._unsent += not self._link.send(message.pack(self._sender), peer)
            self._sender.seq = (self._sender.seq + 1) % 256
