"""All streams of a page, and the one picture of their states that everything on the page shows; no I/O."""

from __future__ import annotations

import math
import threading
from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

from nedbus.client import Health, RejectionReport, Sample, StreamState, describe_stream, health_of_last, stream_state
from nedbus_msgs import DEFAULT_TOPIC, FLAGS, Address

from .stream import Origin, Stream, is_position

Condition = Literal["disconnected", "gone", "stale", "invalid", "dead reckoning", "slow", "ok"]
CONDITIONS: Final[tuple[Condition, ...]] = (
    "disconnected", "gone", "stale", "invalid", "dead reckoning", "slow", "ok",
)  # fmt: skip
"""What a stream may be in, the worst first."""

TRUTH: Final = "vehicle_local_position_groundtruth"
MAX_STREAMS: Final = 1000
"""Streams that a page shows, positions before others; more are counted."""

_OVER: Final = 600.0  # s after which nobody needs to look for what has gone
_SILENT: Final = 60.0  # s after which a stream makes room for another
_REPORTS: Final = 100  # rejected messages that are shown
_VALIDITY: Final = tuple(name for name, flag in FLAGS.items() if flag.label and not flag.inverted)


@dataclass(frozen=True, slots=True)
class Line:
    """One stream at one moment: its condition, what is wrong in words, and since when [s since the epoch].

    `rank`: its place among the others, 0 for the worst; what was switched off long ago comes last.
    """

    address: Address
    stream: Stream
    health: Health
    condition: Condition
    words: str
    since: float
    rejected: int
    rank: int

    @property
    def where(self) -> str:
        """Where it was last, as far as it was valid."""
        place, projection = self.stream.valid, self.stream.origin.projection
        if place is None:
            return "nowhere: it never had a valid position"
        text = f"{place.north:.1f} m north, {place.east:.1f} m east"
        text += f", altitude {place.altitude:.1f} m" if math.isfinite(place.altitude) else ""
        if not place.common or projection is None:
            return text
        latitude, longitude = projection.reproject(place.north, place.east)
        return f"{text} ({latitude:.6f}, {longitude:.6f})"


@dataclass(frozen=True, slots=True)
class Picture:
    """All streams at one moment, by address; `rate` [messages/s]; `link`: "" or what is wrong with the link."""

    time: float
    lines: Sequence[Line] = ()
    reports: Sequence[RejectionReport] = ()
    rejected: int = 0
    left_out: int = 0
    link: str = ""

    @property
    def rate(self) -> float:
        """Messages a second, of all streams."""
        return sum(line.health.rate or 0.0 for line in self.lines)

    def worst_first(self) -> list[Line]:
        """Return the lines, those of the worst condition first."""
        return sorted(self.lines, key=lambda line: (line.rank, line.address))


@dataclass(slots=True)
class Fleet:
    """Follow all streams; samples may come from another thread than the one that asks for pictures."""

    origin: Origin = field(default_factory=Origin)
    streams: dict[Address, Stream] = field(default_factory=dict)
    picture: Picture = field(default_factory=lambda: Picture(0.0))
    _truths: dict[str, Stream] = field(default_factory=dict)
    _left_out: set[Address] = field(default_factory=set)
    _since: dict[Address, tuple[str, float]] = field(default_factory=dict)
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
            stream = Stream(self.origin)
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
            for part in (self.streams, self._truths, self._left_out, self._since, self._rejected, self._reports):
                part.clear()

    def look(
        self,
        time: float,
        healths: Mapping[Address, Health],
        *,
        alive: Collection[Address] | None = None,
        link: str = "",
    ) -> Picture:
        """Make and keep the picture at this time [s]; `alive`: what is published now, None if that is not known."""
        with self._lock:
            streams = sorted(self.streams.items())
        lines = []
        for address, stream in streams:
            if stream.last is None:
                continue
            health = healths.get(address) or replace(health_of_last(stream.last), age=time - stream.time)
            is_alive = None if alive is None else address in alive
            state = stream_state(health, alive=is_alive, connected=not link)
            condition = _condition(health, state)
            words = describe_stream(health, state).removeprefix(state.name).removeprefix(": ")
            begin = self._begin(address, condition, time, health)
            is_over = condition == "gone" and time - begin > _OVER
            rank = len(CONDITIONS) if is_over else CONDITIONS.index(condition)
            lines.append(Line(address, stream, health, condition, words, begin, self._rejected[address], rank))
        rejected = self._rejected.total()
        self.picture = Picture(time, lines, tuple(self._reports), rejected, len(self._left_out), link)
        return self.picture

    def _make_room(self, time: float) -> bool:
        """Forget one that is no position, or was silent for longest, if that was a minute; return whether there was."""
        with self._lock:
            address = min(self.streams, key=lambda each: (is_position(each), self.streams[each].time))
            if is_position(address) and time - self.streams[address].time < _SILENT:
                return False
            del self.streams[address]
            self._since.pop(address, None)
            if address.topic == TRUTH:
                del self._truths[address.vehicle]
        return True

    def _begin(self, address: Address, condition: Condition, time: float, health: Health) -> float:
        known = self._since.get(address)
        if known is not None and known[0] == condition:
            return known[1]
        begin = time - (health.age or 0.0) if condition in {"gone", "stale", "disconnected"} else time
        if known is not None and {known[0], condition} <= {"gone", "stale", "disconnected"}:
            begin = known[1]  # the same silence
        self._since[address] = condition, begin
        return begin


def main_line(lines: Sequence[Line]) -> Line:
    """Return the line of a vehicle that its marker shows: vehicle_local_position, else another position, if any."""
    return min(lines, key=lambda line: (line.address.topic != DEFAULT_TOPIC, not is_position(line.address)))


def _condition(health: Health, state: StreamState) -> Condition:
    """Return the worst that holds: silence, then what the flags of the last second say, then a slow stream."""
    flags = health.flags or {}
    if state.name not in {"ok", "slow"}:
        return state.name
    if any(flags.get(name, 1.0) < 1.0 for name in _VALIDITY):
        return "invalid"
    return "dead reckoning" if flags.get("dead_reckoning") else state.name
