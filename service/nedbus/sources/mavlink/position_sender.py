"""PositionSender: send positions from the bus into the vehicle on a link, on a thread of its own."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, cast

from pymavlink.dialects.v20 import common as dialect

from nedbus.client import Bus, Sample, Subscription, connect
from nedbus.errors import NedbusError
from nedbus.log_event import about
from nedbus.mavlink import ExternalPosition
from nedbus.samples import PositionStatus, Rejection
from nedbus.sources.options import MavlinkOptions
from nedbus.timings import TIMINGS
from nedbus.transport import Tls
from nedbus_msgs import Address

from .link import Peer

_log = logging.getLogger(__name__)

COMPONENT: Final = dialect.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
TIMESYNC_TOPIC: Final = "timesync_status"
"""Topic that PX4 publishes while a client answers its TIMESYNC; nedbus does so only with `position_clock=timesync`."""

_CONNECT_TIMEOUT: Final = 0.5  # s
_DOWNSAMPLED: Final = "rate"  # kind of refusal that is no fault of the publisher
_SHORT_ID: Final = 8  # characters of the id of a session
_EVIDENCE_TIMEOUT: Final = 10.0  # s for which an answer of another client to TIMESYNC counts


@dataclass(frozen=True, slots=True)
class BusAccess:
    """What is needed to subscribe to the bus of a service."""

    routers: tuple[str, ...]
    tls: Tls | None
    prefix: str

    def open(self) -> Bus:
        """Connect; raise NedbusError."""
        return connect(self.routers, timeout=_CONNECT_TIMEOUT, prefix=self.prefix, tls=self.tls)


class Target(NamedTuple):
    """The vehicle on a link that receives positions. `obstacle`: why there is none, or ""."""

    system: int = 0
    name: str = ""
    peer: Peer = None
    obstacle: str = ""


class PositionSender:
    """Send each position of one address as ODOMETRY to the vehicle on a link, as the component of a VIO.

    `find_target`: returns the vehicle. `send`: sends a message with the ids of an encoder; returns whether the link
    accepted it. Both are called on this object's thread.
    """

    def __init__(
        self,
        name: str,
        options: MavlinkOptions,
        access: BusAccess,
        *,
        find_target: Callable[[], Target],
        send: Callable[[Any, Any, Peer], bool],
    ) -> None:
        self._name, self._access = name, access
        self._address = cast("Address", options.position)
        self._clock = options.position_clock
        self._find_target, self._send = find_target, send
        self._core, self._lock = ExternalPosition(), threading.Lock()
        self._encoder = dialect.MAVLink(None, 0, COMPONENT)
        self._reported = Counter[str]()
        self._answered = -float("inf")  # time of an answer to TIMESYNC by another client
        self._stop, self._subscription = threading.Event(), cast("Subscription[Any] | None", None)
        text = "PX4 stamps them on arrival" if self._clock == "arrival" else "PX4's TIMESYNC is answered"
        extra = about("position", source=name)
        _log.info("%s: positions of %s are sent into the vehicle; %s", name, self._address, text, extra=extra)
        self._thread = threading.Thread(target=self._run, name="nedbus-position", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop sending."""
        self._stop.set()
        if self._subscription is not None:
            self._subscription.close()
        self._thread.join()

    def on_foreign_timesync(self, now: float) -> None:
        """Note that another client has answered the vehicle's TIMESYNC."""
        self._answered = now

    def status(self) -> PositionStatus:
        """Return what was sent and left out so far."""
        target = self._find_target()
        with self._lock:
            core = self._core
            warnings = list(core.warnings.values())
            if self._clock == "arrival" and time.monotonic() - self._answered < _EVIDENCE_TIMEOUT:
                warnings.append("another client answers TIMESYNC: on this link, PX4 would use its clock for positions")
            is_active = time.monotonic() - core.last_sent < TIMINGS.stale
            return PositionStatus(
                vehicle=target.name, address=str(self._address), sender=core.sender, sent=core.sent,
                rate=core.rate if is_active else 0.0, age=core.age if core.sent else None, clock=self._clock,
                left_out=tuple(sorted(core.left_out.items())), reasons=tuple(core.reasons.values()),
                warnings=tuple(warnings),
            )  # fmt: skip

    def rejections(self) -> Iterator[Rejection]:
        """Yield what was refused since the last call; positions above the maximum rate are not refused."""
        with self._lock:
            counts, reasons = Counter(self._core.left_out), dict(self._core.reasons)
            warnings = dict(self._core.warnings)
        for kind, count in (counts - self._reported).items():
            if kind != _DOWNSAMPLED:
                yield Rejection(
                    f"{self._name} position of {self._address}, {kind}", reasons.get(kind, kind), count=count
                )
        self._reported = counts
        for kind, text in warnings.items():
            yield Rejection(f"{self._name} position of {self._address}, {kind}", text, count=0)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                with self._access.open() as bus:
                    self._follow(bus)
            except NedbusError as exc:  # the router is not up yet, or closed the session
                _log.debug("%s: no positions: %s", self._name, exc)
                self._stop.wait(TIMINGS.source_tick)

    def _follow(self, bus: Bus) -> None:
        """Send what arrives until `close`: of several unread positions, only the newest.

        Without a timeout the samples are received on this thread: no other thread has to hand them over.
        """
        topic, vehicle = self._address.topic, self._address.vehicle
        with bus.subscribe(topic, vehicle=vehicle, mode="latest") as subscription:
            self._subscription = subscription
            if self._stop.is_set():  # before `close` could see the subscription
                return
            for sample in subscription:
                if not (sample.retained or sample.stored):  # it is older than this subscription
                    self._handle(sample)
            self._note_unread(subscription.counts.dropped)

    def _note_unread(self, count: int) -> None:
        with self._lock:
            self._core.left_out["superseded"] += count

    def _handle(self, sample: Sample[Any]) -> None:
        target = self._find_target()
        with self._lock:
            if target.obstacle:
                self._core.refuse("vehicle", target.obstacle)
                return
            if target.name == self._address.vehicle:
                text = f"{self._address} is the vehicle's own name, so its echo would be sent back: publish another one"
                self._core.refuse("address", text)
                return
            outcome = self._core.add(sample.message, sender_of(sample), time.monotonic())
        if outcome.message is None:
            return
        self._encoder.srcSystem = target.system
        if not self._send(outcome.message, self._encoder, target.peer):
            with self._lock:
                self._core.refuse("link", "the link did not accept it: it is too slow, or broken")


def sender_of(sample: Sample[Any]) -> str:
    """Return the publisher of a sample: its source, and the id of its session."""
    name = sample.source or "a publisher"
    if sample.stamp is None:
        return name
    return f"{name} (session {str(sample.stamp.get_id())[:_SHORT_ID]})"


def choose_target(vehicles: Mapping[int, tuple[str, Peer]]) -> Target:
    """Return the only vehicle on a link, by system id with name and address, or why there is none."""
    if not vehicles:
        return Target(obstacle="no vehicle has been received on this link: check the link")
    if len(vehicles) > 1:
        names = ", ".join(name for name, _ in vehicles.values())
        return Target(obstacle=f"this link has several vehicles ({names}): give each its own link and position=")
    [(system, (name, peer))] = vehicles.items()
    return Target(system, name, peer)
