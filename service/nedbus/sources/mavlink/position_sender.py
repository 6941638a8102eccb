"""PositionSender: send positions from the bus into the vehicle on a link, on a thread of its own."""

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from typing import Final, NamedTuple, cast

from nedbus import limits
from nedbus.errors import ClosedError, DecodeError, NedbusError
from nedbus.log_event import UnexpectedErrors, about
from nedbus.mavlink import ExternalPosition
from nedbus.samples import PositionStatus, Rejection
from nedbus.sources.options import MavlinkOptions
from nedbus.timings import TIMINGS
from nedbus.transport import KeyReader, RawSample, Session, Tls, entity_name, open_client
from nedbus_msgs import BY_TOPIC, Address, codec_of, provenance_of
from nedbus_msgs.messages import TimesyncStatus

from .link import Peer

_log = logging.getLogger(__name__)

TIMESYNC_TOPIC: Final = "timesync_status"
"""Topic that PX4 publishes while a client answers its TIMESYNC; nedbus does so only with `position_clock=timesync`."""

_CONNECT_TIMEOUT: Final = 0.5  # s
_DOWNSAMPLED: Final = "rate"  # kind of refusal that is no fault of the publisher
# s between two looks for the vehicle, whose address changes after 3 s of silence
_TARGET_INTERVAL: Final = 0.1
_SHORT_ID: Final = 8  # characters of the id of a session
_FOREIGN_CLOCK: Final = (
    "another client answers TIMESYNC: if it does so on this link, PX4 stamps positions with its clock; stop it, or give"
    " the service a link of its own"
)
_EVIDENCE_TIMEOUT: Final = 10.0  # s for which an answer of another client to TIMESYNC counts


@dataclass(frozen=True, slots=True)
class BusAccess:
    """What is needed to read the bus of a service; `router`: its session if it is a router, else `routers` has one."""

    router: Session | None
    routers: tuple[str, ...]
    tls: Tls | None
    prefix: str

    @contextmanager
    def read(self, address: Address) -> Iterator[KeyReader]:
        """Receive the messages of an address inside a `with` block; raise NedbusError if no router answers.

        A second session to the own router would double the processor time.
        """
        with ExitStack() as opened:
            session = self.router
            if session is None:
                session = open_client(self.routers, timeout=_CONNECT_TIMEOUT, tls=self.tls)
                opened.callback(session.close)
            yield opened.enter_context(closing(KeyReader(session, address.key(prefix=self.prefix))))


class Target(NamedTuple):
    """The vehicle on a link that receives positions. `obstacle`: why there is none, or ""."""

    system: int = 0
    name: str = ""
    peer: Peer = None
    obstacle: str = ""


class PositionSender:
    """Send each position of one address as ODOMETRY to the vehicle on a link, as the component of a VIO.

    `find_target`: returns the vehicle. `send`: sends a frame; returns whether the link accepted it. Both are called on
    this object's thread.
    """

    def __init__(
        self,
        name: str,
        options: MavlinkOptions,
        access: BusAccess,
        *,
        find_target: Callable[[], Target],
        send: Callable[[bytes, Peer], bool],
    ) -> None:
        self._name = name
        self._access = access
        self._address = cast("Address", options.position)
        self._clock = options.position_clock
        self._find_target = find_target
        self._send = send
        self._core = ExternalPosition()
        self._lock = threading.Lock()
        self._sequence = 0  # of MAVLink
        self._reported = Counter[str]()
        self._answered = -math.inf  # time of an answer to TIMESYNC by another client
        self._decode = codec_of(BY_TOPIC[self._address.topic]).decode_row  # faster than a model
        self._target = Target()
        self._target_due = -math.inf
        self._sender = SenderName(self._address.topic)
        self._stop = threading.Event()
        self._reader: KeyReader | None = None
        text = "%s: unexpected error, left out a position (logged once)"
        self._errors = UnexpectedErrors(_log, text, name)
        stamps = "PX4's TIMESYNC is answered"
        if self._clock == "arrival":
            stamps = "PX4 stamps them on arrival"
        text = "%s: positions of %s are sent into the vehicle; %s"
        _log.info(text, name, self._address, stamps, extra=about("position", source=name))
        self._thread = threading.Thread(target=self._run, name="nedbus-position", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop sending."""
        self._stop.set()
        reader = self._reader
        if reader is not None:
            reader.close()
        self._thread.join()

    def on_timesync_status(self, fields: Mapping[str, object], now: float) -> None:
        """Note that another client has answered the vehicle's TIMESYNC; over DDS, it concerns DDS alone."""
        if fields.get("source_protocol") != TimesyncStatus.SOURCE_PROTOCOL_DDS:
            self._answered = now

    def status(self) -> PositionStatus:
        """Return what was sent and left out so far."""
        target = self._find_target()
        with self._lock:
            core = self._core
            warnings = list(core.warnings.values())
            if self._clock == "arrival" and time.monotonic() - self._answered < _EVIDENCE_TIMEOUT:
                warnings.append(_FOREIGN_CLOCK)
            is_active = time.monotonic() - core.last_sent < TIMINGS.stale
            return PositionStatus(
                vehicle=target.name,
                address=str(self._address),
                sender=core.sender,
                sent=core.sent,
                rate=core.rate if is_active else 0.0,
                age=core.age if core.sent else None,
                clock=self._clock,
                left_out=tuple(sorted(core.left_out.items())),
                reasons=tuple(core.reasons.values()),
                warnings=tuple(warnings),
            )

    def rejections(self) -> Iterator[Rejection]:
        """Yield what was refused since the last call; positions above the maximum rate are not refused."""
        with self._lock:
            counts = Counter(self._core.left_out)
            reasons = dict(self._core.reasons)
            warnings = dict(self._core.warnings)
        place = f"{self._name} position of {self._address}"
        for kind, count in (counts - self._reported).items():
            if kind != _DOWNSAMPLED:
                yield Rejection(f"{place}, {kind}", reasons.get(kind, kind), count=count)
        self._reported = counts
        for kind, text in warnings.items():
            yield Rejection(f"{place}, {kind}", text, count=0)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                with self._access.read(self._address) as self._reader:
                    self._follow(self._reader)
            except NedbusError as exc:  # the router is not up yet, or its session was closed
                _log.debug("%s: no positions: %s", self._name, exc)
                self._stop.wait(TIMINGS.source_tick)

    def _follow(self, reader: KeyReader) -> None:
        """Send what arrives until `close`: of several unread positions, only the newest."""
        before = 0
        while not self._stop.is_set():
            try:
                raw = reader.receive()
            except ClosedError:
                self._stop.wait(TIMINGS.source_tick)  # unless this object was closed
                return
            try:
                self._handle(raw, reader.superseded - before)
            except BaseException as exc:  # a panic of Zenoh is not an Exception
                if not self._errors.survives(exc):
                    raise
            before = reader.superseded

    def _handle(self, raw: RawSample, superseded: int) -> None:
        now = time.monotonic()
        if now >= self._target_due:
            self._target = self._find_target()
            self._target_due = now + _TARGET_INTERVAL
        target = self._target
        with self._lock:
            core = self._core
            if superseded:
                core.left_out["superseded"] += superseded
            if target.obstacle:
                core.refuse("vehicle", target.obstacle)
                return
            if target.name == self._address.vehicle:
                text = f"{self._address} is the vehicle's own name, so its echo would be sent back: publish another one"
                core.refuse("address", text)
                return
            try:
                position = self._decode(raw.payload.to_bytes())
            except DecodeError as exc:
                text = f"the message cannot be decoded: {exc}; use the same version of nedbus"
                core.refuse("invalid", text)
                return
            outcome = core.add(position, self._sender.of(raw), now)
        if outcome.odometry is None:
            return
        frame = outcome.odometry.frame(
            outcome.time_usec, system=target.system, sequence=self._sequence
        )
        self._sequence = (self._sequence + 1) % 256
        if not self._send(frame, target.peer):
            with self._lock:
                self._core.refuse("link", "the link did not accept it: it is too slow, or broken")


class SenderName:
    """The publisher of samples as text: its source, and the id of its session; described again when it changes."""

    def __init__(self, topic: str) -> None:
        self._definition = BY_TOPIC[topic]
        self._publisher: str | None = None  # its `entity_name`
        self._name = ""

    def of(self, raw: RawSample) -> str:
        """Return the publisher of a sample."""
        publisher = None
        if raw.source_info is not None:
            publisher = entity_name(raw.source_info.source_id)
        if publisher != self._publisher or not self._name:
            self._publisher = publisher
            encoding = str(raw.encoding)[: limits.ENCODING_TEXT]
            source = provenance_of(self._definition, encoding).source
            self._name = source or "a publisher"
            if publisher is not None:
                self._name += f" (session {publisher[:_SHORT_ID]})"
        return self._name


def choose_target(vehicles: Sequence[Target]) -> Target:
    """Return the only vehicle on a link, or why there is none."""
    if not vehicles:
        return Target(obstacle="no vehicle has been received on this link: check the link")
    if len(vehicles) > 1:
        names = ", ".join(vehicle.name for vehicle in vehicles)
        text = f"this link has several vehicles ({names}): give each its own link and position="
        return Target(obstacle=text)
    return vehicles[0]
