"""Event detector for the position estimate: flags, resets, origin changes and unexplained jumps."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

from nedbus_msgs import JUMP_FIELDS, RESET_COUNTERS, Quantity, jump_of
from nedbus_msgs.frames import GlobalPosition, MapProjection

from .detectors import ChangeDetector, Fields, Finding, detect_flags, read_fields
from .event import ALONE, Event
from .kinds import Severity, flagged
from .rules import JUMP_DISTANCE, JUMP_SHARE, LARGE_CORRECTION, SMALL_RESET, WILD

_KINDS: Final = flagged("VehicleLocalPosition")
_FLAGS: Final = tuple(flag for kind in _KINDS for flag in kind.flags if flag != "xy_valid")
_COMPARED: Final = ("xy_valid", *_FLAGS, *RESET_COUNTERS.values(), "ref_timestamp")
_MIN_STEP: Final = JUMP_DISTANCE / 2  # m along one axis; smaller steps are never jumps
_CHECKED_INTERVAL: Final = 0.5  # s between messages; longer ones are not checked for jumps
_SMALLEST_MOVE: Final = 0.01  # m of an origin; less is rounding


class _Reset(NamedTuple):
    """A quantity with a reset counter: names of its values in the event's `numbers`, and its text."""

    names: tuple[str, ...]
    text: str


_RESETS: Final[Mapping[Quantity, _Reset]] = {
    "xy": _Reset(("north", "east"), "xy by {size:.1f} m ({north:z.1f} north, {east:z.1f} east)"),
    "z": _Reset(("up",), "height by {up:z.1f} m"),
    "vxy": _Reset(("v_north", "v_east"), "vxy by {size:.1f} m/s"),
    "vz": _Reset(("v_up",), "vz by {v_up:z.1f} m/s"),
    "heading": _Reset(("heading",), "heading by {degrees:z.0f} deg"),
}
_POSITION: Final[tuple[Quantity, ...]] = ("xy", "z")
_VELOCITY: Final[tuple[Quantity, ...]] = ("vxy", "vz")
_DIRECTIONS: Final = re.compile(r" \(.*\)")  # in the text of a reset of xy
_DURATION: Final = re.compile(r" in [\d.]+ s")  # in the text of a jump
_ORIGIN: Final = ("ref_lat", "ref_lon", "ref_alt")
# read when a compared field changes, with their defaults
_CONTEXT: Final = dict.fromkeys(JUMP_FIELDS, math.nan)


class _Motion(NamedTuple):
    """Position [m] and velocity [m/s]; NaN if unknown."""

    x: float = math.nan
    y: float = math.nan
    vx: float = math.nan
    vy: float = math.nan


class _Step(NamedTuple):
    """Motion that velocity does not explain: its begin [s], and how far it led north and east [m]."""

    begin: float
    north: float
    east: float

    @property
    def distance(self) -> float:
        return math.hypot(self.north, self.east)

    def followed_by(self, step: _Step) -> _Step:
        return _Step(self.begin, self.north + step.north, self.east + step.east)


@dataclass(frozen=True, slots=True)
class _Left:
    """When an origin changed [us], and the one before."""

    stamp: int = 0
    origin: tuple[Any, ...] = ()


class PositionDetector(ChangeDetector):
    """Detector for VehicleLocalPosition and other estimates with the same fields."""

    def __init__(self) -> None:
        super().__init__(_COMPARED, [*_CONTEXT], self._detect_position)
        self._read_motion = read_fields(("x", "y", "vx", "vy"), math.nan)
        self._motion: tuple[float, ...] = _Motion()
        self._motion_before: tuple[float, ...] = self._motion
        self._jump: _Step | None = None  # in progress
        self._left = _Left()

    def add(self, message: object, missing: frozenset[str]) -> Iterator[Finding] | None:
        """Return the findings in a message, None if nothing has changed."""
        before = self._motion
        motion = self._read_motion(message)
        self._motion_before = before
        self._motion = motion
        findings = super().add(message, missing)
        if findings is not None:
            return findings
        north = abs(motion[0] - before[0])
        east = abs(motion[1] - before[1])
        has_moved = north > _MIN_STEP or east > _MIN_STEP
        is_valid = self._state[0]
        step = None
        if has_moved and is_valid:
            step = self._unexplained_step()
        if step is None and self._jump is None:
            return None
        return self._track_jump(step)

    @property
    def unknown(self) -> tuple[str, ...]:
        """Flags that the last message did not provide."""
        last = dict(zip(_COMPARED, self._state, strict=False))
        return tuple(name for name in last if last[name] is None or name in self.missing)

    def reset(self) -> None:
        """Discard the state after a reboot of the vehicle."""
        super().reset()
        self._jump = None

    def _detect_position(self, before: Fields, after: Fields) -> Iterator[Finding]:
        if before:
            yield from self._detect_corrections(_with_context(before), _with_context(after))
        yield from detect_flags(_KINDS, before, after)

    def _detect_corrections(self, before: Fields, after: Fields) -> Iterator[Finding]:
        yield from self._detect_origin(before, after)
        quantities = [name for name in _RESETS if _was_reset(name, before, after)]
        if quantities:
            yield _reset(quantities, before, after)
        # as text, because NaN equals NaN
        is_same_origin = str(_origin_of(before)) == str(_origin_of(after))
        is_comparable = after["xy_valid"] and "xy" not in quantities and is_same_origin
        step = None
        if is_comparable:
            step = self._unexplained_step()
        yield from self._track_jump(step)

    def _detect_origin(self, before: Fields, after: Fields) -> Iterator[Finding]:
        finding = _change_of_origin(before, after)
        if finding is None:
            return
        returned_to = _Left(self.earlier, _origin_of(after))
        is_back = self._left == returned_to and self.stamp - self.earlier <= 1e6 * WILD
        self._left = _Left(self.stamp, _origin_of(before))
        if is_back:
            numbers = {**finding.numbers, ALONE: 1}
            finding = replace(finding, numbers=numbers)
        yield finding

    def _unexplained_step(self) -> _Step | None:
        """Return the motion since the last message that velocity does not explain; None if below the jump limit."""
        seconds = (self.stamp - self.earlier) / 1e6
        if not 0 < seconds <= _CHECKED_INTERVAL:
            return None
        before = _Motion._make(self._motion_before)
        motion = _Motion._make(self._motion)
        mean_vx = (motion.vx + before.vx) / 2
        mean_vy = (motion.vy + before.vy) / 2
        north = motion.x - before.x - mean_vx * seconds
        east = motion.y - before.y - mean_vy * seconds
        speed = math.hypot(motion.vx, motion.vy)
        limit = JUMP_DISTANCE + JUMP_SHARE * speed * seconds
        if north * north + east * east > limit * limit:
            return _Step(self.earlier / 1e6, north, east)
        return None  # also for NaN

    def _track_jump(self, step: _Step | None) -> Iterator[Finding]:
        """Add a step to the jump in progress; yield the jump when it ends."""
        jump = self._jump
        self._jump = step
        if jump is None:
            return
        if step is not None:
            self._jump = jump.followed_by(step)
        elif jump.distance > JUMP_DISTANCE:  # otherwise one message was wild
            yield self._jump_of(jump)

    def _jump_of(self, jump: _Step) -> Finding:
        distance = jump.distance
        seconds = self.stamp / 1e6 - jump.begin
        return Finding(
            "jump",
            "once",
            f"position jumped by {distance:.1f} m in {seconds:.2f} s without a reset",
            numbers={
                "distance": distance,
                "north": jump.north,
                "east": jump.east,
                "begin": jump.begin,
            },
            is_large=distance >= LARGE_CORRECTION,
        )


def _with_context(fields: Fields) -> Fields:
    """Return fields with the defaults of those in `_CONTEXT` that were not provided."""
    known = {name: value for name, value in fields.items() if value is not None}
    return fields | _CONTEXT | known


def _origin_of(fields: Fields) -> tuple[Any, ...]:
    return tuple(fields[name] for name in _ORIGIN)


def _was_reset(name: Quantity, before: Fields, after: Fields) -> bool:
    counter = RESET_COUNTERS[name]
    if before[counter] is None or after[counter] is None:
        return False
    return bool(before[counter] != after[counter])


def _reset(quantities: Sequence[Quantity], before: Fields, after: Fields) -> Finding:
    numbers: dict[str, float] = {}
    known: list[str] = []
    unknown: list[str] = []
    for name in quantities:
        size = jump_of(name, before, after)
        if size is None:
            unknown.append(f"{name} by an unknown amount")
            continue
        is_down = name in ("z", "vz")
        values = [-value for value in size] if is_down else size
        numbers |= zip(_RESETS[name].names, values, strict=True)
        known.append(_describe(name, numbers))
    sizes = [abs(size) for name, size in numbers.items() if name != "heading"]
    is_small = not unknown and all(size < SMALL_RESET for size in sizes)
    is_large = any(size >= LARGE_CORRECTION for size in sizes)
    severity: Severity | None = None
    if is_small:
        severity = "info"
    return Finding(
        "reset",
        "once",
        f"reset of {', '.join(known + unknown)}",
        tuple(quantities),
        numbers,
        severity=severity,
        is_large=is_large,
    )


def _describe(name: Quantity, numbers: Mapping[str, float]) -> str:
    """Return the text for a quantity of a reset, whose `numbers` have its sizes."""
    reset = _RESETS[name]
    sizes = {key: numbers[key] for key in reset.names}
    first, *_ = sizes.values()
    size = math.hypot(*sizes.values())
    return reset.text.format(**sizes, size=size, degrees=math.degrees(first))


def _sizes_of(reset: Event) -> dict[Quantity, float]:
    """Return the known sizes of a reset [m, m/s], without that of the heading."""
    sizes: dict[Quantity, float] = {}
    for name in (*_POSITION, *_VELOCITY):
        keys = _RESETS[name].names
        is_known = reset.numbers.keys() >= set(keys)
        if is_known and name in reset.names:
            values = [reset.numbers[key] for key in keys]
            sizes[name] = math.hypot(*values)
    return sizes


def large_part(reset: Event) -> str:
    """Return the text of a reset, without the quantities that a large one moved little."""
    sizes = _sizes_of(reset)
    large = [
        _describe(name, reset.numbers)
        for name in _RESETS
        if sizes.get(name, 0.0) >= LARGE_CORRECTION
    ]
    if not large:
        return reset.text
    return f"reset of {', '.join(large)}"


def short_text(correction: Event) -> str:
    """Return a short text of a reset or jump: of a reset, the largest part of position and of velocity."""
    if correction.kind != "reset":
        return _DURATION.sub("", correction.text)
    sizes = _sizes_of(correction)
    parts = []
    for names in _POSITION, _VELOCITY:
        largest = max(names, key=lambda name: sizes.get(name, 0.0))
        if sizes.get(largest, 0.0) >= SMALL_RESET:
            text = _describe(largest, correction.numbers)
            parts.append(_DIRECTIONS.sub("", text))
    if not parts:
        return correction.text
    return f"reset of {', '.join(parts)}"


def _change_of_origin(before: Fields, after: Fields) -> Finding | None:
    """Return an origin that was set or moved; one that was not provided before, and `ref_timestamp`, are ignored."""
    if not _has_origin(after):
        return None
    if _has_origin(before):
        return _move_of_origin(before, after)
    if before["xy_global"] is None:
        return None
    origin = GlobalPosition.wrapped(after["ref_lat"], after["ref_lon"], math.nan)
    text = f"origin set at {origin.latitude:.6f}, {origin.longitude:.6f}"
    numbers = {"latitude": origin.latitude, "longitude": origin.longitude}
    return Finding("origin_set", "once", text, numbers=numbers)


def _has_origin(fields: Fields) -> bool:
    return bool(fields["xy_global"]) and math.isfinite(fields["ref_lat"] + fields["ref_lon"])


def _move_of_origin(before: Fields, after: Fields) -> Finding | None:
    projection = MapProjection(before["ref_lat"], before["ref_lon"])
    north, east = projection.project(after["ref_lat"], after["ref_lon"])
    distance = math.hypot(north, east)
    up = after["ref_alt"] - before["ref_alt"]
    if not math.isfinite(up):
        up = 0.0
    largest = max(distance, abs(up))
    if largest < _SMALLEST_MOVE:
        return None
    severity: Severity | None = None
    if largest < SMALL_RESET:
        severity = "info"
    text = f"origin moved by {distance:.1f} m, {up:z.1f} m up"
    numbers = {"distance": distance, "up": up}
    return Finding("origin_moved", "once", text, numbers=numbers, severity=severity)
