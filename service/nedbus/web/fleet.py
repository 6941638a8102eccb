"""State of a page: its vehicles and streams, and the snapshot that all panels show; no I/O."""

import math
import re
import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import count
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from nedbus import Sample, limits
from nedbus.health import (
    Fusion,
    Health,
    LogStreamStatus,
    Monitor,
    NewestMessage,
    RejectionReport,
    StreamState,
    stream_state,
)
from nedbus.monitoring import Snapshot
from nedbus.vehicle_events import FIXES, MODES, State, rank_vehicle
from nedbus_msgs import DEFAULT_TOPIC, Address
from nedbus_msgs.messages import VehicleStatus

from .stream import LONG, HistorySize, Origin, PageStream, is_position

TRUTH: Final = "vehicle_local_position_groundtruth"
_SILENT: Final = 60.0  # s without a message after which a stream may be evicted
_ARMED: Final = VehicleStatus.ARMING_STATE_ARMED
_OK: Final = State("info", "ok", None, ())
_DETAIL: Final = re.compile(r":| \(|, | within ")  # separates a state from its details


@dataclass(frozen=True, slots=True)
class StreamView:
    """Snapshot of one stream: its newest message, health and state."""

    address: Address
    stream: PageStream
    newest: NewestMessage[Any]
    health: Health
    state: StreamState
    rejected: int

    @property
    def silence(self) -> float | None:
        """Age of the last message [s], None while messages arrive."""
        if not self.state.is_silent:
            return None
        return self.health.age or 0.0


class StatusValue(NamedTuple):
    """A status value such as the flight mode, "" if unknown; `age` [s] if its stream is silent, else None."""

    text: str = ""
    age: float | None = None


@dataclass(frozen=True, slots=True)
class VehicleView:
    """Snapshot of one vehicle: its state and its streams.

    `main`: the stream of its map marker; `status`: mode, armed, battery and gps; `number`: index of its colour;
    `log`: its ULog stream over MAVLink, if any; `fusion`: the use of an external position, if it receives one.
    """

    vehicle: str
    state: State
    main: StreamView
    streams: tuple[StreamView, ...]
    status: Mapping[str, StatusValue]
    number: int
    log: LogStreamStatus | None = None
    fusion: Fusion | None = None

    @property
    def attitude(self) -> StreamView | None:
        """The stream of its attitude, None if it sends none."""
        for stream in self.streams:
            if stream.address.topic == "vehicle_attitude":
                return stream
        return None

    @property
    def grade(self) -> str:
        """The severity of the state, with "ok" for "info"."""
        if self.state.severity == "info":
            return "ok"
        return self.state.severity

    @property
    def lost(self) -> int:
        """Messages lost so far: between its service and this page, and about those of its ULog stream."""
        lost = sum(stream.health.lost for stream in self.streams)
        if self.log is not None:
            lost += self.log.lost_messages
        return lost

    @property
    def brief(self) -> str:
        """The state without details."""
        return _DETAIL.split(self.state.text, maxsplit=1)[0]

    @property
    def last_position(self) -> str:
        """The last valid position as text."""
        position = self.main.stream.valid
        projection = self.main.stream.origin.projection
        if position is None:
            return "none yet"
        text = f"{position.north:z.1f} m north, {position.east:z.1f} m east"
        if math.isfinite(position.altitude):
            name = "height"
            if position.is_altitude_global:
                name = "altitude"
            text += f", {name} {position.altitude:z.1f} m"
        if not position.common or projection is None:
            return text
        latitude, longitude = projection.reproject(position.north, position.east)
        return f"{text} ({latitude:.6f}, {longitude:.6f})"

    @property
    def has_position(self) -> bool:
        """True while valid positions are received."""
        if self.main.silence is not None or not is_position(self.main.address):
            return False
        last: Sample[Any] = self.main.newest.sample
        return bool(last.message.xy_valid) or "xy_valid" in last.provenance.missing


@dataclass(frozen=True, slots=True)
class FleetSnapshot:
    """Snapshot of all vehicles, the most severe first; `alarms`: faults of the link and of this page."""

    time: float
    vehicles: Sequence[VehicleView] = ()
    reports: Sequence[RejectionReport] = ()
    rejected: int = 0
    left_out: int = 0
    alarms: Sequence[str] = ()

    @property
    def lost(self) -> str:
        """Number of messages lost so far, of all vehicles; "about" if it includes those of a ULog stream."""
        total = sum(view.lost for view in self.vehicles)
        is_estimate = any(view.log is not None and view.log.lost_messages for view in self.vehicles)
        return f"about {total:,}" if is_estimate else f"{total:,}"

    def vehicle(self, name: str | None) -> VehicleView | None:
        """Return the vehicle of this name, or None."""
        return next((view for view in self.vehicles if view.vehicle == name), None)


class Fleet:
    """All streams of a page; one thread may add samples while another one takes snapshots.

    `monitor`: the newest message and the health of each stream; each sample is added there first.
    `origin`: the common origin, by default the first one that two messages have.
    `long`: the size of the long histories.
    """

    def __init__(
        self,
        monitor: Monitor | None = None,
        *,
        origin: Origin | None = None,
        long: HistorySize = LONG,
    ) -> None:
        if monitor is None:
            self.monitor = Monitor()
        else:
            self.monitor = monitor
        if origin is None:
            self.origin = Origin()
        else:
            self.origin = origin
        self.streams: dict[Address, PageStream] = {}
        self.snapshot = FleetSnapshot(0.0)
        self._long = long
        numbers = count()
        self._number_of = lru_cache(limits.PAGE_STREAMS)(lambda vehicle: next(numbers))
        self._lock = threading.Lock()  # guards `streams`
        self._rejected: Counter[Address] = Counter()
        self._reports: deque[RejectionReport] = deque(maxlen=limits.SHOWN_NAMES)

    def add(self, sample: Sample[Any], time: float) -> None:
        """Add a sample received at `time`: seconds since the Unix epoch, or since the start of a recording."""
        address = sample.address
        is_estimate = is_position(address) and address.topic != TRUTH
        with self._lock:
            truth = None
            if is_estimate:
                truth = self.streams.get(Address(address.vehicle, TRUTH))
            stream = self.streams.get(address)
            if stream is not None:
                stream.add(sample, time, truth)
            elif self._has_room(address, time):
                self.streams[address] = PageStream(sample, time, truth, self.origin, self._long)

    def _has_room(self, address: Address, time: float) -> bool:
        """Return whether a new stream may be added; a position may replace another stream."""
        if len(self.streams) < limits.PAGE_STREAMS:
            return True
        return is_position(address) and self._evict(time)

    def reject(self, reports: Sequence[RejectionReport]) -> None:
        """Add reports of rejected messages."""
        self._reports.extendleft(reports)
        for report in reports:
            self._rejected[report.address] += 1
            if len(self._rejected) > limits.PAGE_STREAMS:
                oldest = next(iter(self._rejected))
                del self._rejected[oldest]

    def clear(self) -> None:
        """Remove all streams and reports for a seek; keep the common origin."""
        self.monitor = Monitor()
        self.streams.clear()
        self._rejected.clear()
        self._reports.clear()

    def update(
        self,
        now: Snapshot,
        states: Mapping[str, State],
        logs: Mapping[str, LogStreamStatus],
        fusion: Mapping[str, Fusion] = MappingProxyType({}),
    ) -> None:
        """Update `snapshot`; by vehicle: `states`, its ULog streams `logs`, and `fusion` of an external position."""
        self.reject(now.rejected)
        with self._lock:
            newest = dict(self.monitor.items())
            for forgotten in self.streams.keys() - newest.keys():
                del self.streams[forgotten]
            streams = sorted(self.streams.items())
        by_vehicle: dict[str, list[StreamView]] = {}
        for address, stream in streams:
            view = self._view(stream, address, newest[address], now)
            by_vehicle.setdefault(address.vehicle, []).append(view)
        vehicles = []
        for name, views in by_vehicle.items():
            vehicle = VehicleView(
                vehicle=name,
                state=states.get(name, _OK),
                main=min(views, key=_preference),
                streams=tuple(views),
                status=_status(views),
                number=self._number_of(name),
                log=logs.get(name),
                fusion=fusion.get(name),
            )
            vehicles.append(vehicle)
        vehicles.sort(key=lambda view: rank_vehicle(view.vehicle, view.state.severity))
        alarms = [now.link, now.behind.replace("this reader", "this page")]
        self.snapshot = FleetSnapshot(
            now.time,
            vehicles,
            reports=tuple(self._reports),
            rejected=self._rejected.total(),
            left_out=len(newest) - len(streams),
            alarms=[alarm for alarm in alarms if alarm],
        )

    def _view(
        self, stream: PageStream, address: Address, newest: NewestMessage[Any], now: Snapshot
    ) -> StreamView:
        health = now.healths.get(address) or newest.health
        if now.alive is None:
            publishers = None
        else:
            publishers = now.alive[address]
        state = stream_state(health, publishers=publishers, connected=not now.link)
        return StreamView(address, stream, newest, health, state, self._rejected[address])

    def _evict(self, time: float) -> bool:
        """Evict the longest-silent stream, positions last and only if silent; return True if one was evicted."""

        def rank(address: Address) -> tuple[bool, float]:
            return is_position(address), self.streams[address].time

        address = min(self.streams, key=rank)
        if is_position(address) and time - self.streams[address].time < _SILENT:
            return False
        del self.streams[address]
        return True


def _preference(view: StreamView) -> tuple[bool, bool]:
    """Rank a stream as the main one of its vehicle: the default topic, then another position, then any."""
    return view.address.topic != DEFAULT_TOPIC, not is_position(view.address)


def _status(views: Sequence[StreamView]) -> dict[str, StatusValue]:
    """Return the status values of a vehicle, from the first instance of each topic."""
    by_topic = {}
    for view in views:
        if not view.address.instance:
            by_topic[view.address.topic] = view

    def value_of(topic: str, describe: Callable[[Any], str]) -> StatusValue:
        view = by_topic.get(topic)
        if view is None:
            return StatusValue()
        return StatusValue(describe(view.newest.message), view.silence)

    gps = "sensor_gps"
    if "vehicle_gps_position" in by_topic:
        gps = "vehicle_gps_position"
    return {
        "mode": value_of("vehicle_status", _mode_of),
        "armed": value_of("vehicle_status", _arming_of),
        "battery": value_of("battery_status", _charge_of),
        "gps": value_of(gps, _fix_of),
    }


def _mode_of(message: Any) -> str:
    return MODES.get(message.nav_state, str(message.nav_state))


def _arming_of(message: Any) -> str:
    if message.arming_state == _ARMED:
        return "armed"
    return "disarmed"


def _charge_of(message: Any) -> str:
    remaining = message.remaining
    if 0 <= remaining <= 1:
        return f"{100 * remaining:.0f} %"
    return ""


def _fix_of(message: Any) -> str:
    fix = FIXES.get(message.fix_type, message.fix_type)
    return f"{fix} · {message.satellites_used}"
