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

from nedbus import Sample
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

from .stream import LONG, Origin, PageStream, is_position

TRUTH: Final = "vehicle_local_position_groundtruth"
# streams shown on a page, positions first; further streams are only counted
MAX_STREAMS: Final = 1000
_SILENT: Final = 60.0  # s without a message after which a stream may be evicted
_MAX_REPORTS: Final = 100  # rejection reports kept
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
        return self.health.age or 0.0 if self.state.is_silent else None


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
        return next(
            (stream for stream in self.streams if stream.address.topic == "vehicle_attitude"), None
        )

    @property
    def grade(self) -> str:
        """The severity of the state, with "ok" for "info"."""
        return "ok" if self.state.severity == "info" else self.state.severity

    @property
    def lost(self) -> int:
        """Messages lost so far: between its service and this page, and about those of its ULog stream."""
        after_service = sum(stream.health.lost for stream in self.streams)
        return after_service if self.log is None else after_service + self.log.lost_messages

    @property
    def brief(self) -> str:
        """The state without details."""
        return _DETAIL.split(self.state.text, maxsplit=1)[0]

    @property
    def last_position(self) -> str:
        """The last valid position as text."""
        position, projection = self.main.stream.valid, self.main.stream.origin.projection
        if position is None:
            return "none yet"
        text = f"{position.north:z.1f} m north, {position.east:z.1f} m east"
        name = "altitude" if position.is_altitude_global else "height"
        text += f", {name} {position.altitude:z.1f} m" if math.isfinite(position.altitude) else ""
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
    `long`: number of points in the long histories, and seconds between two points.
    """

    def __init__(
        self,
        monitor: Monitor | None = None,
        *,
        origin: Origin | None = None,
        long: tuple[int, float] = LONG,
    ) -> None:
        self.monitor, self.origin = Monitor() if monitor is None else monitor, origin or Origin()
        self.streams: dict[Address, PageStream] = {}
        self.snapshot = FleetSnapshot(0.0)
        self._long = long
        numbers = count()
        self._number_of = lru_cache(MAX_STREAMS)(lambda vehicle: next(numbers))
        self._lock = threading.Lock()  # guards `streams`
        self._rejected: Counter[Address] = Counter()
        self._reports: deque[RejectionReport] = deque(maxlen=_MAX_REPORTS)

    def add(self, sample: Sample[Any], time: float) -> None:
        """Add a sample received at `time`: seconds since the Unix epoch, or since the start of a recording."""
        address = sample.address
        is_estimate = is_position(address) and address.topic != TRUTH
        with self._lock:
            truth = self.streams.get(Address(address.vehicle, TRUTH)) if is_estimate else None
            if stream := self.streams.get(address):
                stream.add(sample, time, truth)
            elif len(self.streams) < MAX_STREAMS or (is_position(address) and self._evict(time)):
                self.streams[address] = PageStream(sample, time, truth, self.origin, self._long)

    def reject(self, reports: Sequence[RejectionReport]) -> None:
        """Add reports of rejected messages."""
        self._reports.extendleft(reports)
        for report in reports:
            self._rejected[report.address] += 1
            if len(self._rejected) > MAX_STREAMS:
                del self._rejected[next(iter(self._rejected))]

    def clear(self) -> None:
        """Remove all streams and reports for a seek; keep the common origin."""
        self.monitor = Monitor()
        for collection in (self.streams, self._rejected, self._reports):
            collection.clear()

    def update(
        self,
        now: Snapshot,
        states: Mapping[str, State],
        logs: Mapping[str, LogStreamStatus],
        fusion: Mapping[str, Fusion] = MappingProxyType({}),
    ) -> None:
        """Update `snapshot`; by vehicle: `states`, its ULog streams `logs`, and `fusion` of an external position."""
        self.reject(now.rejected)
        alive = now.alive
        with self._lock:
            newest = dict(self.monitor.items())
            for forgotten in self.streams.keys() - newest.keys():
                del self.streams[forgotten]
            streams = sorted(self.streams.items())
        views: dict[str, list[StreamView]] = {}
        for address, stream in streams:
            health = now.healths.get(address) or newest[address].health
            state = stream_state(
                health, publishers=None if alive is None else alive[address], connected=not now.link
            )
            view = StreamView(
                address, stream, newest[address], health, state, self._rejected[address]
            )
            views.setdefault(address.vehicle, []).append(view)
        vehicles = []
        for name, each in views.items():
            main = min(
                each,
                key=lambda view: (
                    view.address.topic != DEFAULT_TOPIC,
                    not is_position(view.address),
                ),
            )
            vehicle_state, number = states.get(name, _OK), self._number_of(name)
            status, log = _status(each), logs.get(name)
            vehicle = VehicleView(
                name, vehicle_state, main, tuple(each), status, number, log, fusion.get(name)
            )
            vehicles.append(vehicle)
        vehicles.sort(key=lambda view: rank_vehicle(view.vehicle, view.state.severity))
        alarms = [
            each for each in (now.link, now.behind.replace("this reader", "this page")) if each
        ]
        rejected, left_out = self._rejected.total(), len(newest) - len(streams)
        self.snapshot = FleetSnapshot(
            now.time, vehicles, tuple(self._reports), rejected, left_out, alarms
        )

    def _evict(self, time: float) -> bool:
        """Evict the longest-silent stream, positions last and only if silent; return True if one was evicted."""
        address = min(self.streams, key=lambda each: (is_position(each), self.streams[each].time))
        if is_position(address) and time - self.streams[address].time < _SILENT:
            return False
        del self.streams[address]
        return True


def _status(views: Sequence[StreamView]) -> dict[str, StatusValue]:
    known = {(view.address.topic, view.address.instance or 0): view for view in views}

    def value_of(topic: str, describe: Callable[[Any], str]) -> StatusValue:
        view = known.get((topic, 0))
        return (
            StatusValue()
            if view is None
            else StatusValue(describe(view.newest.message), view.silence)
        )

    gps = "vehicle_gps_position" if ("vehicle_gps_position", 0) in known else "sensor_gps"
    return {
        "mode": value_of(
            "vehicle_status", lambda last: MODES.get(last.nav_state, str(last.nav_state))
        ),
        "armed": value_of(
            "vehicle_status", lambda last: "armed" if last.arming_state == _ARMED else "disarmed"
        ),
        "battery": value_of(
            "battery_status",
            lambda m: f"{100 * m.remaining:.0f} %" if 0 <= m.remaining <= 1 else "",
        ),
        "gps": value_of(
            gps, lambda last: f"{FIXES.get(last.fix_type, last.fix_type)} · {last.satellites_used}"
        ),
    }
