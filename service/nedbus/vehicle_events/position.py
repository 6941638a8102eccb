"""Event detector for the position estimate: flags, resets, origin changes and unexplained jumps."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

from nedbus_msgs import JUMP_FIELDS, RESET_COUNTERS, Quantity, jump_of
from nedbus_msgs.frames import GlobalPosition, MapProjection

from .detectors import ChangeDetector, Fields, Finding, detect_flags, read_fields
from .event import ALONE, Event
from .kinds import Severity, flagged
from .rules import JUMP_DISTANCE, JUMP_SHARE, LARGE_CORRECTION, MAX_ALONE, SMALL_RESET

_KINDS: Final = flagged("VehicleLocalPosition")
_COMPARED: Final = (
    "xy_valid", *(flag for kind in _KINDS for flag in kind.flags if flag != "xy_valid"), *RESET_COUNTERS.values(),
    "ref_timestamp",
)  # fmt: skip
_MIN_STEP: Final = JUMP_DISTANCE / 2  # m along one axis; smaller steps are never jumps
_MAX_INTERVAL: Final = 0.5  # s between messages; longer intervals are not checked for jumps
# By quantity with a reset counter: names of its values in the event's `numbers`, and text.
_RESETS: Final[Mapping[Quantity, tuple[tuple[str, ...], str]]] = {
    "xy": (("north", "east"), "xy by {size:.1f} m ({north:z.1f} north, {east:z.1f} east)"),
    "z": (("up",), "height by {up:z.1f} m"),
    "vxy": (("v_north", "v_east"), "vxy by {size:.1f} m/s"),
    "vz": (("v_up",), "vz by {v_up:z.1f} m/s"),
    "heading": (("heading",), "heading by {degrees:z.0f} deg"),
}
_POSITION: Final[tuple[Quantity, ...]] = ("xy", "z")
_VELOCITY: Final[tuple[Quantity, ...]] = ("vxy", "vz")
_DIRECTIONS: Final = re.compile(r" \(.*\)")  # in the text of a reset of xy
_DURATION: Final = re.compile(r" in [\d.]+ s")  # in the text of a jump
_ORIGIN: Final = ("ref_lat", "ref_lon", "ref_alt")
# read when a compared field changes, with their defaults
_CONTEXT: Final = dict.fromkeys(JUMP_FIELDS, math.nan)

Step = tuple[float, float, float]  # begin [s], unexplained motion north and east [m]


class PositionDetector(ChangeDetector):
    """Detector for VehicleLocalPosition and other estimates with the same fields."""

    def __init__(self) -> None:
        super().__init__(_COMPARED, [*_CONTEXT], self._detect_position)
        self._read_motion = read_fields(("x", "y", "vx", "vy"), math.nan)
        self._motion: tuple[float, ...] = ()
        self._motion_before: tuple[float, ...] = ()
        self._jump: Step | None = None  # in progress
        # time when an origin changed [us], and the one before
        self._left: tuple[int, object] = (0, ())

    def add(self, message: object, missing: frozenset[str]) -> Iterator[Finding] | None:
        """Return the findings in a message, None if nothing has changed."""
        before, motion = self._motion, self._read_motion(message)
        self._motion_before, self._motion = before, motion
        if (found := super().add(message, missing)) is not None:
            return found
        has_moved = abs(motion[0] - before[0]) > _MIN_STEP or abs(motion[1] - before[1]) > _MIN_STEP
        step = self._unexplained_step() if has_moved and self._state[0] else None
        return None if step is None and self._jump is None else self._track_jump(step)

    @property
    def unknown(self) -> tuple[str, ...]:
        """Flags that the last message did not provide."""
        last, absent = zip(_COMPARED, self._state, strict=False), self.missing
        return tuple(name for name, value in last if value is None or name in absent)

    def reset(self) -> None:
        """Discard the state after a reboot of the vehicle."""
        super().reset()
        self._jump = None

    def _detect_position(self, before: Fields, after: Fields) -> Iterator[Finding]:
        if before:
            earlier, values = (
                {
                    name: _CONTEXT.get(name) if value is None else value
                    for name, value in fields.items()
                }
                for fields in (before, after)
            )
            for found in _detect_origin(earlier, values):
                old, new = ([each[name] for name in _ORIGIN] for each in (earlier, values))
                is_back = (
                    self._left == (self.earlier, new)
                    and self.stamp - self.earlier <= 1e6 * MAX_ALONE
                )
                self._left = self.stamp, old
                yield replace(found, numbers={**found.numbers, ALONE: 1}) if is_back else found
            counts = [
                (name, [each[RESET_COUNTERS[name]] for each in (earlier, values)])
                for name in _RESETS
            ]
            quantities = [name for name, each in counts if None not in each and each[0] != each[1]]
            if quantities:
                yield _reset(quantities, earlier, values)
            # NaN equals NaN
            is_same_origin = all(str(earlier[name]) == str(values[name]) for name in _ORIGIN)
            is_comparable = values["xy_valid"] and "xy" not in quantities and is_same_origin
            yield from self._track_jump(self._unexplained_step() if is_comparable else None)
        yield from detect_flags(_KINDS, before, after)

    def _unexplained_step(self) -> Step | None:
        """Return the motion since the last message that velocity does not explain; None if below the jump limit."""
        seconds = (self.stamp - self.earlier) / 1e6
        if not 0 < seconds <= _MAX_INTERVAL:
            return None
        (x_before, y_before, vx_before, vy_before) = self._motion_before
        (x, y, vx, vy) = self._motion
        north = x - x_before - (vx + vx_before) / 2 * seconds
        east = y - y_before - (vy + vy_before) / 2 * seconds
        limit = JUMP_DISTANCE + JUMP_SHARE * math.hypot(vx, vy) * seconds
        return (
            (self.earlier / 1e6, north, east)
            if north * north + east * east > limit * limit
            else None
        )

    def _track_jump(self, step: Step | None) -> Iterator[Finding]:
        """Add a step to the jump in progress; yield the jump when it ends."""
        jump, self._jump = self._jump, step
        if jump is not None and step is not None:
            self._jump = (jump[0], jump[1] + step[1], jump[2] + step[2])
        elif jump is not None and (distance := math.hypot(*jump[1:])) > JUMP_DISTANCE:
            # else one message was wild
            seconds = self.stamp / 1e6 - jump[0]
            text = f"position jumped by {distance:.1f} m in {seconds:.2f} s without a reset"
            numbers = {"distance": distance, "north": jump[1], "east": jump[2], "begin": jump[0]}
            yield Finding(
                "jump", "once", text, numbers=numbers, is_large=distance >= LARGE_CORRECTION
            )


def _reset(quantities: Sequence[Quantity], before: Fields, after: Fields) -> Finding:
    numbers: dict[str, float] = {}
    known, unknown = [], []
    for name in quantities:
        size = jump_of(name, before, after)
        if size is None:
            unknown.append(f"{name} by an unknown amount")
            continue
        up = [-value for value in size] if name in ("z", "vz") else size
        numbers |= zip(_RESETS[name][0], up, strict=True)
        known.append(_describe(name, numbers))
    sizes = [abs(size) for name, size in numbers.items() if name != "heading"]
    is_small = not unknown and all(size < SMALL_RESET for size in sizes)
    is_large = any(size >= LARGE_CORRECTION for size in sizes)
    text = f"reset of {', '.join(known + unknown)}"
    severity: Severity | None = "info" if is_small else None
    return Finding(
        "reset", "once", text, tuple(quantities), numbers, severity=severity, is_large=is_large
    )


def _describe(name: Quantity, numbers: Mapping[str, float]) -> str:
    """Return the text for a quantity of a reset, whose `numbers` have its sizes."""
    names, text = _RESETS[name]
    sizes = {each: numbers[each] for each in names}
    return text.format(
        **sizes, size=math.hypot(*sizes.values()), degrees=math.degrees(sizes[names[0]])
    )


def _sizes_of(reset: Event) -> dict[Quantity, float]:
    """Return the known sizes of a reset [m, m/s], without that of the heading."""
    return {
        name: math.hypot(*(reset.numbers[each] for each in _RESETS[name][0]))
        for name in _RESETS
        if name != "heading" and name in reset.names and reset.numbers.keys() >= {*_RESETS[name][0]}
    }


def large_part(reset: Event) -> str:
    """Return the text of a reset, without the quantities that a large one moved little."""
    sizes = _sizes_of(reset)
    large = [name for name, size in sizes.items() if size >= LARGE_CORRECTION]
    return (
        f"reset of {', '.join(_describe(name, reset.numbers) for name in large)}"
        if large
        else reset.text
    )


def short_text(correction: Event) -> str:
    """Return a short text of a reset or jump: of a reset, the largest part of position and of velocity."""
    if correction.kind != "reset":
        return _DURATION.sub("", correction.text)
    sizes = _sizes_of(correction)
    parts = []
    for names in _POSITION, _VELOCITY:
        name = max(names, key=lambda each: sizes.get(each, 0.0))
        if sizes.get(name, 0.0) >= SMALL_RESET:
            parts.append(_DIRECTIONS.sub("", _describe(name, correction.numbers)))
    return f"reset of {', '.join(parts)}" if parts else correction.text


def _detect_origin(before: Fields, after: Fields) -> Iterator[Finding]:
    """Yield an origin that was set or moved; one that was not provided before, and `ref_timestamp`, are ignored."""
    had, has = (
        each["xy_global"] and math.isfinite(each["ref_lat"] + each["ref_lon"])
        for each in (before, after)
    )
    if has and not had and before["xy_global"] is not None:
        origin = GlobalPosition.wrapped(after["ref_lat"], after["ref_lon"], math.nan)
        text = f"origin set at {origin.latitude:.6f}, {origin.longitude:.6f}"
        numbers = {"latitude": origin.latitude, "longitude": origin.longitude}
        yield Finding("origin_set", "once", text, numbers=numbers)
    elif has and had:
        moved = MapProjection(before["ref_lat"], before["ref_lon"]).project(
            after["ref_lat"], after["ref_lon"]
        )
        distance, up = math.hypot(*moved), after["ref_alt"] - before["ref_alt"]
        up = up if math.isfinite(up) else 0.0
        if distance >= 0.01 or abs(up) >= 0.01:
            text = f"origin moved by {distance:.1f} m, {up:z.1f} m up"
            severity: Severity | None = "info" if max(distance, abs(up)) < SMALL_RESET else None
            yield Finding(
                "origin_moved",
                "once",
                text,
                numbers={"distance": distance, "up": up},
                severity=severity,
            )
