"""What of each message is looked at, and the events that follow from its change."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, Final, Literal, cast

from nedbus_msgs import RESET_COUNTERS, MapProjection, ResetTracker

from .event import Severity
from .look import Look, Values
from .rules import JUMP, POSITION, SMALL, FlagRule

Change = Literal["begin", "end", "once"]
Fields = dict[str, Any]
_NONE: Final[frozenset[str]] = frozenset()
REBOOT: Final = 1_000_000
"""Microseconds that PX4's time goes back when a vehicle reboots; less is disorder."""

LEAST: Final = JUMP[0] / 2
"""Metres to one side below which a step is no jump, whatever the velocity."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What a change of one message means; the vehicle makes an event of it.

    `flags`: those that begin or end; a condition holds for each.
    `initial`: it held at the first message: a condition, and no event.
    `first`: said of an end where the condition never held since the first message but for that.
    """

    kind: str
    change: Change
    severity: Severity
    text: str
    names: tuple[str, ...] = ()
    numbers: Mapping[str, float] = field(default_factory=dict)
    flags: tuple[str, ...] = ("",)
    on_ground: Severity | None = None
    first: str = ""
    initial: bool = False


class Watch:
    """Follow one stream; `add` yields what its messages mean, and is fast while nothing changes."""

    def __init__(
        self, names: tuple[str, ...], judge: Callable[[Fields | None, Fields], Iterator[Finding]], *, beside: str = ""
    ) -> None:
        self._look = Look(("timestamp", *names, *([beside] if beside else [])))
        self._compared = len(names)  # `beside` may change at any time, and is only told
        self._judge = judge
        self._before: Values | None = None
        self._missing = _NONE
        self.stamp = self.earlier = 0

    def add(self, message: object, missing: frozenset[str]) -> Iterator[Finding] | None:
        """Add a message; return None while nothing changes."""
        stamp, *rest = self._look(message)
        self.earlier, self.stamp, values = self.stamp, stamp, tuple(rest)
        is_same = missing is self._missing or missing == self._missing
        if is_same and self._before is not None and values[: self._compared] == self._before[: self._compared]:
            return None
        names, told = self._look.names[1:], self._missing
        before, self._before, self._missing = self._before, values, missing
        return self._judge(None if before is None else _known(names, before, told), _known(names, values, missing))

    def forget(self) -> None:
        """Begin anew: the vehicle has rebooted."""
        self._before, self.stamp, self.earlier = None, 0, 0


class PositionWatch:
    """Follow the position that a vehicle is judged by: its flags, resets, origin, and jumps that nothing explains."""

    _FLAGS: Final = tuple(name for rule in POSITION for name in rule.flags)
    _STATE: Final = ("xy_valid", *_FLAGS[1:], *RESET_COUNTERS.values(), "ref_timestamp")
    _QUICK: Final = ("timestamp", "x", "y", "vx", "vy")
    _ALL: Final = (
        "timestamp", "x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "heading", "dist_bottom", "delta_xy", "delta_z",
        "delta_vxy", "delta_vz", "delta_heading", "delta_dist_bottom", *RESET_COUNTERS.values(), "xy_global",
        "z_global", "ref_lat", "ref_lon", "ref_alt", *(name for name in _FLAGS if not name.endswith("global")),
    )  # fmt: skip

    def __init__(self) -> None:
        self._quick, self._state, self._all = Look(self._QUICK, math.nan), Look(self._STATE), Look(self._ALL)
        self._last: object = None
        self._values: Values = ()
        self._held: Values | None = None
        self._slide: tuple[float, float, float] | None = None  # begin [s], and how far by now [m], of a jump
        self._missing = _NONE
        self.stamp = self.earlier = 0

    def add(self, message: object, missing: frozenset[str]) -> Iterator[Finding] | None:
        """Add a message; return None while nothing changes."""
        before, values, state = self._values, self._quick(message), self._state(message)
        last, self._last, self._values = self._last, message, values
        self.earlier, self.stamp = self.stamp, values[0]
        if state != self._held or not (missing is self._missing or missing == self._missing):
            self._held, told, self._missing = state, self._missing, missing
            return self._change(last, told, message, missing)
        moved = state[0] and (abs(values[1] - before[1]) > LEAST or abs(values[2] - before[2]) > LEAST)
        slid = _slide(before, values) if moved else None
        return None if slid is None and self._slide is None else self._follow_slide(slid)

    def forget(self) -> None:
        """Begin anew: the vehicle has rebooted."""
        self._last = self._held = self._slide = None
        self.stamp = self.earlier = 0

    def _change(
        self, last: object, told: frozenset[str], message: object, missing: frozenset[str]
    ) -> Iterator[Finding]:
        """Judge what is different; `told` were missing before, `missing` are now."""
        names = self._all.names
        after, values = _known(names, self._all(message), missing), _complete(self._all, message)
        if last is None:
            yield from judge_flags(POSITION, None, after)
            return
        before, earlier = _known(names, self._all(last), told), _complete(self._all, last)
        tracker = ResetTracker()
        tracker.add(cast("Any", SimpleNamespace(**earlier)))
        track = tracker.add(cast("Any", SimpleNamespace(**values)))
        yield from _origins(earlier, values)
        quantities = [name for name in RESET_COUNTERS if name in track.reset and name != "dist_bottom"]
        if quantities:
            yield _reset(quantities, values, track)
        slid = None
        if values["xy_valid"] and not track.origin_changed and "xy" not in track.reset:
            slid = _slide(self._quick(last), self._quick(message))
        yield from self._follow_slide(slid)
        yield from judge_flags(POSITION, before, after)

    def _follow_slide(self, slid: tuple[float, float, float] | None) -> Iterator[Finding]:
        """Add a step of a jump, or tell of the jump when it has ended."""
        begun = self._slide
        if slid is not None:
            self._slide = slid if begun is None else (begun[0], begun[1] + slid[1], begun[2] + slid[2])
            return
        self._slide = None
        if begun is not None:
            distance, seconds = math.hypot(*begun[1:]), self.stamp / 1e6 - begun[0]
            text = f"position jumps by {distance:.1f} m within {seconds:.2f} s, without a reset"
            numbers = {"distance": distance, "north": begun[1], "east": begun[2], "begin": begun[0]}
            yield Finding("jump", "once", "watch", text, numbers=numbers)


def judge_flags(rules: tuple[FlagRule, ...], before: Fields | None, after: Fields) -> Iterator[Finding]:
    """Yield what begins and ends; a flag that is None is not told, and changes nothing."""
    for rule in rules:
        begun: list[str] = []
        ended: list[str] = []
        initial: list[str] = []
        gone: list[str] = []
        for name in rule.flags:
            now, was = after.get(name), None if before is None else before.get(name)
            if now is None:
                if was == rule.bad:
                    gone.append(name)
                continue
            if before is None or was is None:
                if now == rule.bad and rule.initial:
                    initial.append(name)
            elif was != now:
                (begun if now == rule.bad else ended).append(name)
        if initial:
            yield _flagged(rule, "begin", initial, initial=True)
        if gone:  # nobody tells any more whether it holds
            yield _flagged(rule, "end", gone, initial=True)
        if begun:
            yield _flagged(rule, "begin", begun)
        if ended:
            yield _flagged(rule, "end", ended)


def _flagged(rule: FlagRule, change: Change, flags: list[str], *, initial: bool = False) -> Finding:
    words = ", ".join(rule.flags[name] for name in flags)
    severity: Severity = rule.severity if change == "begin" else "info"
    if rule.minor.issuperset(flags):
        severity = "info"
    text = (rule.begin if change == "begin" else rule.end).format(words)
    return Finding(
        rule.kind, change, severity, text, tuple(flags), flags=tuple(flags), on_ground=rule.on_ground,
        first=rule.first, initial=initial,
    )  # fmt: skip


def _slide(before: Values, after: Values) -> tuple[float, float, float] | None:
    """Return begin [s], north and east [m] of a step beyond what the velocity explains; None if it explains it."""
    seconds = (after[0] - before[0]) / 1e6
    if not 0 < seconds <= 0.5:
        return None
    north = after[1] - before[1] - (after[3] + before[3]) / 2 * seconds
    east = after[2] - before[2] - (after[4] + before[4]) / 2 * seconds
    limit = JUMP[0] + JUMP[1] * math.hypot(after[3], after[4]) * seconds
    if north * north + east * east > limit * limit:
        return before[0] / 1e6, north, east
    return None


def _reset(quantities: Sequence[str], values: Fields, track: Any) -> Finding:
    """Return a reset, with its size as far as the message tells it: deltas of what was not reset are old."""
    numbers: dict[str, float] = {}
    words = []
    explained = {name for name in quantities if name not in track.discontinued}
    if "xy" in explained:
        numbers |= {"north": values["x"] - track.x, "east": values["y"] - track.y}
        size = math.hypot(numbers["north"], numbers["east"])
        words.append(f"xy by {size:.1f} m ({_signed(numbers['north'])} north, {_signed(numbers['east'])} east)")
    if "z" in explained:
        numbers["up"] = track.z - values["z"]
        words.append(f"height by {_signed(numbers['up'])} m")
    if "vxy" in explained:
        numbers |= {"v_north": values["vx"] - track.vx, "v_east": values["vy"] - track.vy}
        words.append(f"vxy by {math.hypot(numbers['v_north'], numbers['v_east']):.1f} m/s")
    if "vz" in explained:
        numbers["v_up"] = track.vz - values["vz"]
        words.append(f"vz by {_signed(numbers['v_up'])} m/s")
    is_small = all(abs(each) < SMALL for each in numbers.values()) and explained.issuperset(quantities)
    if "heading" in explained:
        numbers["heading"] = values["delta_heading"]
        words.append(f"heading by {_signed(math.degrees(numbers['heading']), 0)} deg")
    words += [f"{name} by an unknown amount" for name in quantities if name not in explained]
    severity: Severity = "info" if is_small else "watch"
    return Finding(
        "reset", "once", severity, f"reset of {', '.join(words)}", tuple(quantities), numbers, on_ground="info"
    )


def _origins(before: Fields, after: Fields) -> Iterator[Finding]:
    """Yield an origin that is set, or moves; one that only has a new time does not."""
    had, has = (each["xy_global"] and math.isfinite(each["ref_lat"] + each["ref_lon"]) for each in (before, after))
    if has and not had:
        text = f"origin set at {after['ref_lat']:.6f}, {after['ref_lon']:.6f}"
        numbers = {"latitude": after["ref_lat"], "longitude": after["ref_lon"]}
        yield Finding("origin_set", "once", "info", text, numbers=numbers)
    elif has and had:
        moved = MapProjection(before["ref_lat"], before["ref_lon"]).project(after["ref_lat"], after["ref_lon"])
        up = after["ref_alt"] - before["ref_alt"]
        up = up if math.isfinite(up) else 0.0
        distance = math.hypot(*moved)
        if distance >= 0.01 or abs(up) >= 0.01:
            numbers = {"distance": distance, "up": up}
            text = f"origin moved by {distance:.1f} m, {_signed(up)} m up"
            severity: Severity = "info" if max(distance, abs(up)) < SMALL else "watch"
            yield Finding("origin_moved", "once", severity, text, numbers=numbers, on_ground="info")


def _signed(value: float, digits: int = 1) -> str:
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _complete(look: Look, message: object) -> Fields:
    """Return the fields by name, with PX4's values for those that are not given."""
    return {
        name: _ABSENT.get(name, 0) if value is None else value
        for name, value in zip(look.names, look(message), strict=True)
    }


def _known(names: tuple[str, ...], values: Values, missing: frozenset[str]) -> Fields:
    return {name: None if name in missing else value for name, value in zip(names, values, strict=True)}


_ABSENT: Final[Mapping[str, object]] = {
    **dict.fromkeys(("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "heading", "dist_bottom"), math.nan),
    **dict.fromkeys(("delta_z", "delta_vz", "delta_heading", "delta_dist_bottom"), math.nan),
    **dict.fromkeys(("ref_lat", "ref_lon", "ref_alt"), math.nan),
    **dict.fromkeys(("delta_xy", "delta_vxy"), (math.nan, math.nan)),
}
