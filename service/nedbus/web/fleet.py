"""All streams of a page, and the one picture of their states that everything on the page shows; no I/O."""

from __future__ import annotations

import math
import re
import threading
from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

from nedbus.client import Health, RejectionReport, Sample, StreamState, describe_stream, health_of_last, stream_state
from nedbus.events import FIXES, MODES, Condition, State
from nedbus_msgs import DEFAULT_TOPIC, Address

from .stream import LONG, Origin, Place, Stream, is_position

Grade = Literal["bad", "watch", "ok"]
GRADES: Final[tuple[Grade, ...]] = ("bad", "watch", "ok")

TRUTH: Final = "vehicle_local_position_groundtruth"
MAX_STREAMS: Final = 1000
"""Streams that a page shows, positions before others; more are counted."""

_OVER: Final = 600.0  # s after which nobody needs to look for what has gone
_SILENT: Final = 60.0  # s after which a stream makes room for another
_REPORTS: Final = 100  # rejected messages that are shown
_ARMED: Final = 2
_DIGITS: Final = re.compile(r"(\d+)")
_DETAIL: Final = re.compile(r":| \(|, | within ")  # behind it a state goes into details
_SHORT: Final = 32  # characters of a state in a row


@dataclass(frozen=True, slots=True)
class Line:
    """One stream at one moment: its health and its state, both in words."""

    address: Address
    stream: Stream
    health: Health
    state: StreamState
    rejected: int

    @property
    def words(self) -> str:
        """Its state and its flags, in words."""
        return describe_stream(self.health, self.state)


@dataclass(frozen=True, slots=True)
class Facts:
    """What other messages say of a vehicle, as text; "" where they say nothing."""

    mode: str = ""
    armed: str = ""
    battery: str = ""
    gps: str = ""


@dataclass(frozen=True, slots=True)
class Row:
    """One vehicle at one moment: its grade, why and since when, and its streams.

    `main`: the stream that its marker shows; `rank`: its place among the others, 0 for the worst; what was switched
    off long ago comes last. `number`: for its colour.
    """

    vehicle: str
    grade: Grade
    text: str
    since: float | None
    conditions: tuple[Condition, ...]
    main: Line
    lines: tuple[Line, ...]
    facts: Facts
    rank: int
    number: int

    @property
    def brief(self) -> str:
        """Its state in a few words."""
        text = _DETAIL.split(self.text, maxsplit=1)[0]
        return text if len(text) <= _SHORT else f"{text[: _SHORT - 1]}…"

    def at(self, state: State) -> Row:
        """Return this vehicle with the state that it had at another time."""
        grade: Grade = "ok" if state.severity == "info" else state.severity
        return replace(self, grade=grade, text=state.text, since=state.since, conditions=state.conditions)

    @property
    def where(self) -> str:
        """Where it was last, as far as it was valid."""
        return describe_place(self.main.stream)

    @property
    def is_here(self) -> bool:
        """Whether its position is valid and arrives."""
        last = self.main.stream.last
        fresh = self.main.state.name not in ("disconnected", "gone", "stale")
        return fresh and last is not None and is_position(self.main.address) and bool(last.message.xy_valid)


@dataclass(frozen=True, slots=True)
class Picture:
    """All vehicles at one moment, the worst first; `link`: "" or what is wrong with it; `own`: with this page."""

    time: float
    rows: Sequence[Row] = ()
    reports: Sequence[RejectionReport] = ()
    rejected: int = 0
    left_out: int = 0
    link: str = ""
    own: str = ""

    @property
    def rate(self) -> float:
        """Messages a second, of all streams."""
        return sum(line.health.rate or 0.0 for row in self.rows for line in row.lines)

    @property
    def lost(self) -> int:
        """Messages that were lost, of all streams."""
        return sum(line.health.lost for row in self.rows for line in row.lines)

    def row(self, vehicle: str | None) -> Row | None:
        """Return the row of a vehicle."""
        return next((row for row in self.rows if row.vehicle == vehicle), None)


@dataclass(slots=True)
class Fleet:
    """Follow all streams; samples may come from another thread than the one that asks for pictures.

    `long`: size and step of the longer histories.
    """

    origin: Origin = field(default_factory=Origin)
    long: tuple[int, float] = LONG
    streams: dict[Address, Stream] = field(default_factory=dict)
    picture: Picture = field(default_factory=lambda: Picture(0.0))
    _numbers: dict[str, int] = field(default_factory=dict)
    _truths: dict[str, Stream] = field(default_factory=dict)
    _left_out: set[Address] = field(default_factory=set)
    _rejected: Counter[Address] = field(default_factory=Counter)
    _reports: deque[RejectionReport] = field(default_factory=lambda: deque(maxlen=_REPORTS))
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, sample: Sample[Any], time: float) -> None:
        """Add a sample at this time [s since the epoch]."""
        address = sample.address
        stream = self.streams.get(address)
        if stream is None:
            if len(self.streams) >= MAX_STREAMS and not (is_position(address) and self._make_room(time)):
                if len(self._left_out) < MAX_STREAMS:
                    self._left_out.add(address)
                return
            stream = Stream(self.origin, self.long)
            with self._lock:
                self.streams[address] = stream
                self._left_out.discard(address)
            if address.topic == TRUTH:
                self._truths[address.vehicle] = stream
        stream.add(sample, time, None if address.topic == TRUTH else self._truths.get(address.vehicle))

    def reject(self, reports: Sequence[RejectionReport]) -> None:
        """Add reports of rejected messages."""
        self._reports.extendleft(reports)
        for report in reports:
            if report.address in self._rejected or len(self._rejected) < MAX_STREAMS:
                self._rejected[report.address] += 1

    def clear(self) -> None:
        """Forget all but the common origin: the time has jumped."""
        with self._lock:
            for part in (self.streams, self._truths, self._left_out, self._rejected, self._reports):
                part.clear()

    def look(
        self,
        time: float,
        healths: Mapping[Address, Health],
        states: Mapping[str, State],
        *,
        alive: Collection[Address] | None = None,
        link: str = "",
        own: str = "",
    ) -> Picture:
        """Make and keep the picture at this time [s].

        `states`: of vehicles, by name. `alive`: what is published now, None if that is not known.
        """
        with self._lock:
            streams = sorted(self.streams.items())
        lines: dict[str, list[Line]] = {}
        for address, stream in streams:
            if stream.last is None:
                continue
            health = healths.get(address) or replace(health_of_last(stream.last), age=time - stream.time)
            state = stream_state(health, alive=None if alive is None else address in alive, connected=not link)
            line = Line(address, stream, health, state, self._rejected[address])
            lines.setdefault(address.vehicle, []).append(line)
        rows = [self._row(vehicle, each, states.get(vehicle), time, own) for vehicle, each in lines.items()]
        rows.sort(key=lambda row: (row.rank, natural(row.vehicle)))
        rejected = self._rejected.total()
        self.picture = Picture(time, rows, tuple(self._reports), rejected, len(self._left_out), link, own)
        return self.picture

    def _row(self, vehicle: str, lines: Sequence[Line], state: State | None, time: float, own: str) -> Row:
        main = min(lines, key=lambda line: (line.address.topic != DEFAULT_TOPIC, not is_position(line.address)))
        state = state or State("info", "ok", None, ())
        grade: Grade = "ok" if state.severity == "info" else state.severity
        text, since = state.text, state.since
        if grade == "ok" and main.state.name == "slow" and not own:  # else it is this page that is slow
            grade, text = "watch", str(main.state)
        kinds = [condition.kind for condition in state.conditions]
        is_over = "gone" in kinds[:1] and since is not None and time - since > _OVER
        rank = len(GRADES) if is_over else GRADES.index(grade)
        number = self._numbers.setdefault(vehicle, len(self._numbers)) if len(self._numbers) < MAX_STREAMS else 0
        return Row(
            vehicle, grade, text, since, state.conditions, main, tuple(lines), self._facts(vehicle), rank, number
        )

    def _facts(self, vehicle: str) -> Facts:
        status = self._last(vehicle, "vehicle_status")
        battery = self._last(vehicle, "battery_status", 0)
        gps = self._last(vehicle, "vehicle_gps_position") or self._last(vehicle, "sensor_gps", 0)
        left = getattr(battery, "remaining", math.nan)
        return Facts(
            "" if status is None else MODES.get(status.nav_state, str(status.nav_state)),
            "" if status is None else "armed" if status.arming_state == _ARMED else "disarmed",
            f"{100 * left:.0f} %" if 0 <= left <= 1 else "",
            "" if gps is None else f"{FIXES.get(gps.fix_type, gps.fix_type)} · {gps.satellites_used}",
        )

    def _last(self, vehicle: str, topic: str, instance: int | None = None) -> Any:
        stream = self.streams.get(Address(vehicle, topic, instance))
        return stream.last.message if stream is not None and stream.last is not None else None

    def _make_room(self, time: float) -> bool:
        """Forget one that is no position, or was silent for longest, if that was a minute; return whether there was."""
        with self._lock:
            address = min(self.streams, key=lambda each: (is_position(each), self.streams[each].time))
            if is_position(address) and time - self.streams[address].time < _SILENT:
                return False
            del self.streams[address]
            if address.topic == TRUTH:
                del self._truths[address.vehicle]
        return True


def natural(name: str) -> list[tuple[bool, int, str]]:
    """Return a key that sorts uav-2 before uav-10."""
    return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in _DIGITS.split(name)]


def places_at(stream: Stream | None, times: Sequence[float]) -> list[Place | None]:
    """Return where a stream was at these times [s], as its histories have it; None where they do not reach back."""
    found: list[Place | None] = [None] * len(times)
    for history in (stream.long, stream.minute) if stream is not None and times else ():
        points = history.points(0, history.written)
        points = points[points[:, 1] == points[:, 1]]  # those with a valid position
        if not len(points):
            continue
        after = points[:, 0].searchsorted([time * 1e3 for time in times], side="right").tolist()
        for index, at in enumerate(after):
            if at > 0:  # where it was valid last
                row = points[at - 1]
                found[index] = Place(float(row[1]), float(row[2]), math.nan, True)
    return found


def last_place(stream: Stream, time: float) -> Place | None:
    """Return where a stream was valid last by a time [s]."""
    points = stream.long.points(0, stream.long.written)
    points = points[(points[:, 1] == points[:, 1]) & (points[:, 0] <= time * 1e3)]
    return Place(float(points[-1, 1]), float(points[-1, 2]), math.nan, True) if len(points) else None


def describe_place(stream: Stream) -> str:
    """Return the last valid position of a stream in words."""
    place, projection = stream.valid, stream.origin.projection
    if place is None:
        return "nowhere: it never had a valid position"
    text = f"{place.north:z.1f} m north, {place.east:z.1f} m east"
    text += f", altitude {place.altitude:z.1f} m" if math.isfinite(place.altitude) else ""
    if not place.common or projection is None:
        return text
    latitude, longitude = projection.reproject(place.north, place.east)
    return f"{text} ({latitude:.6f}, {longitude:.6f})"
