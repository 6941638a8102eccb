"""Find what a reset changed in an estimate, and compute a track without these jumps.

A reset announces its delta, but the published values step by something else: in a real flight by (3.6, -2.7) m where
`delta_xy` is (5.8, -4.7), and at the first origin by millimetres where `delta_z` is -489 m. The step is known as
accurately as the motion in between, so the delta is used only if it agrees, or if the messages are too far apart.
Source: the resets of 15 real logs, measured by `python -m benchmarks.resets`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from operator import add, attrgetter
from statistics import fmean
from typing import Any, Final, Literal, NamedTuple

from .frames import MapProjection, wrap
from .messages.vehicle_local_position import VehicleLocalPosition as Message

Quantity = Literal["xy", "z", "vxy", "vz", "heading", "dist_bottom"]

Point = tuple[float, ...]

_VALUES: Final[Mapping[Quantity, tuple[str, ...]]] = {
    "xy": ("x", "y"),
    "z": ("z",),
    "vxy": ("vx", "vy"),
    "vz": ("vz",),
    "heading": ("heading",),
    "dist_bottom": ("dist_bottom",),
}
# The rates of change of each value in order of preference; dist_bottom falls by vz, and the heading has no rate.
_RATES: Final[Mapping[str, tuple[str, ...]]] = {
    "x": ("vx",),
    "y": ("vy",),
    "z": ("z_deriv", "vz"),
    "vx": ("ax",),
    "vy": ("ay",),
    "vz": ("az",),
    "dist_bottom": ("vz",),
}
RESET_COUNTERS: Final[Mapping[Quantity, str]] = {name: f"{name}_reset_counter" for name in _VALUES}
"""The field that counts the resets of each quantity, modulo 256."""

_FROM_ORIGIN: Final = ("xy", "z")  # quantities that a new origin changes
_ORIGIN: Final = ("ref_lat", "ref_lon", "ref_alt")
_read_origin: Final = attrgetter(*_ORIGIN)  # compared as text, in which NaN equals NaN
_VALUES_AND_RATES: Final = set(chain(*_VALUES.values(), *_RATES.values()))
JUMP_FIELDS: Final = (
    *sorted(_VALUES_AND_RATES),
    *(f"delta_{name}" for name in _VALUES),
    *_ORIGIN,
    "unaided_heading",
)
"""The fields that `jump_of` needs besides `timestamp` and the reset counter."""

# us; a larger step back in time is a reboot, a smaller one is reordering
_REBOOT: Final = 1_000_000
# s for which the rates at both ends determine the motion well enough to find a step
_MEASURED_INTERVAL: Final = 3.0
_MEASURED_WITHOUT_RATES: Final = 0.5  # s
# s; over longer intervals, a change of the rate makes the motion uncertain
_SURE_INTERVAL: Final = 0.15
# Maximum difference between a delta and the step, in m, m/s or rad: for noise, for a jerk of 120 m/s^3 (the mean of two
# rates is off by a twelfth of it times the interval cubed, but at most by _SPEED), and without rates.
_NOISE: Final = 0.003
_JERK: Final = 10.0
_SPEED: Final = 2.0
_UNKNOWN_SPEED: Final = 5.0


@dataclass(frozen=True, slots=True)
class Continuous:
    """One point of a continuous track: a message's values without the jumps of all resets since the track began.

    Frame and units are those of the message; `heading` is within [-pi, pi].
    `reset`: quantities that were reset just before this message, explained or not.
    `discontinued`: quantities with an unexplained jump, whose track restarts here with the value of the message.
    `origin_changed`: the global origin was set, or changed.
    `resets`: number of resets of each quantity since the first message.
    """

    x: float
    y: float
    z: float
    vx: float
    vy: float
    vz: float
    heading: float
    dist_bottom: float
    reset: frozenset[Quantity]
    discontinued: frozenset[Quantity]
    origin_changed: bool
    resets: Mapping[Quantity, int]


class ResetTracker:
    """Tracker of one stream, that is, one address; each EKF has its own resets and origin.

    PX4's EKF2 selector does not report resets of `dist_bottom`, whose track may therefore jump.
    """

    def __init__(self) -> None:
        self._last: Message | None = None
        self._jumps: dict[Quantity, Point] = {name: _no_jump(name) for name in _VALUES}
        self._resets: dict[Quantity, int] = dict.fromkeys(_VALUES, 0)

    def add(self, message: Message) -> Continuous:
        """Add the next message of the stream and return its values without jumps.

        All tracks restart when the timestamp goes back by over a second, which counts as a reboot of the vehicle.
        """
        last = self._last or message
        self._last = message
        rebooted = message.timestamp < last.timestamp - _REBOOT
        origin_changed = str(_read_origin(last)) != str(_read_origin(message))
        reset: set[Quantity] = set()
        discontinued: set[Quantity] = set()
        for name, counter in RESET_COUNTERS.items():
            count = (getattr(message, counter) - getattr(last, counter)) % 256
            jump: Point | None = _no_jump(name)
            if rebooted:
                jump = None
            elif count or (origin_changed and name in _FROM_ORIGIN):
                jump = jump_of(name, _by_name(last), _by_name(message))
            if count and not rebooted:
                reset.add(name)
                self._resets[name] += count
            if jump is None:
                discontinued.add(name)
                self._jumps[name] = _no_jump(name)
            elif any(jump):
                self._jumps[name] = tuple(map(add, self._jumps[name], jump))
        values: dict[str, float] = {}
        for name, fields in _VALUES.items():
            for field, jumped in zip(fields, self._jumps[name], strict=True):
                values[field] = getattr(message, field) - jumped
        values["heading"] = wrap(values["heading"])
        return Continuous(
            **values,
            reset=frozenset(reset),
            discontinued=frozenset(discontinued),
            origin_changed=origin_changed,
            resets=dict(self._resets),
        )


def _no_jump(name: Quantity) -> Point:
    return (0.0,) * len(_VALUES[name])


def _by_name(message: Message) -> dict[str, Any]:
    """Return what `jump_of` needs of a model or a row."""
    names = ("timestamp", *RESET_COUNTERS.values(), *JUMP_FIELDS)
    return {name: getattr(message, name) for name in names}


def jump_of(name: Quantity, before: Mapping[str, Any], after: Mapping[str, Any]) -> Point | None:
    """Return by how much resets or a new origin changed a quantity between two messages; None if it is unknown.

    It is the step between the messages minus the motion in between, unless an announced size agrees with that: the
    delta of a single reset, and at a new origin zero or the distance of the origins.
    `before`, `after`: JUMP_FIELDS and the others by name, NaN if not provided.
    """
    announced = _announced_jumps(name, before, after)
    seconds = (after["timestamp"] - before["timestamp"]) / 1e6
    motion = _motion_of(name, before, after, seconds)
    step = tuple(
        after[value] - before[value] - distance
        for value, distance in zip(_VALUES[name], motion.distances, strict=True)
    )
    if seconds <= 0 or not all(map(math.isfinite, step)):
        if announced:
            return announced[0]
        return None
    if name == "heading":
        step = (wrap(step[0]),)
    if motion.is_known:
        measured_interval = _MEASURED_INTERVAL
    else:
        measured_interval = _MEASURED_WITHOUT_RATES
    is_measured = seconds <= measured_interval
    if announced:
        best = min(announced, key=lambda jump: math.dist(jump, step))
        if math.dist(best, step) <= _tolerance(motion, seconds, is_measured=is_measured):
            return best
    return step if is_measured else None


def _announced_jumps(
    name: Quantity, before: Mapping[str, Any], after: Mapping[str, Any]
) -> list[Point]:
    """Return the jumps that the messages announce: the delta of a single reset, and those of a new origin."""
    jumps: list[Point] = []
    counter = RESET_COUNTERS[name]
    if (after[counter] - before[counter]) % 256 == 1:
        delta = after[f"delta_{name}"]
        if not isinstance(delta, tuple):
            delta = (delta,)
        jumps.append(delta)
    origin_before = [before[field] for field in _ORIGIN]
    origin_after = [after[field] for field in _ORIGIN]
    if name in _FROM_ORIGIN and str(origin_before) != str(origin_after):
        jumps.append(_no_jump(name))
        if name == "xy":
            projection = MapProjection(after["ref_lat"], after["ref_lon"])
            jumps.append(projection.project(before["ref_lat"], before["ref_lon"]))
        else:
            jumps.append((after["ref_alt"] - before["ref_alt"],))
    return [jump for jump in jumps if all(map(math.isfinite, jump))]


def _tolerance(motion: _Motion, seconds: float, *, is_measured: bool) -> float:
    """Return by how much a delta may differ from the step."""
    if not is_measured:
        return _UNKNOWN_SPEED * seconds + math.hypot(*motion.distances)
    if not motion.is_known:
        return _UNKNOWN_SPEED * seconds
    tolerance = _NOISE + min(_JERK * seconds**3, _SPEED * seconds)
    if seconds > _SURE_INTERVAL:
        tolerance += 2 * math.hypot(*motion.changes)
    return tolerance


class _Motion(NamedTuple):
    """The motion of the values of a quantity between two messages, by their rates.

    `distances`: how far each value moved, 0 if unknown; `changes`: by how much its rates differ, times the interval.
    """

    distances: Point
    changes: Point
    is_known: bool


def _motion_of(
    name: Quantity, before: Mapping[str, Any], after: Mapping[str, Any], seconds: float
) -> _Motion:
    if name == "heading":  # the gyroscopes' heading has no resets
        turned: float = after["unaided_heading"] - before["unaided_heading"]
        if math.isfinite(turned):
            return _Motion((wrap(turned),), (0.0,), is_known=True)
        return _Motion((0.0,), (0.0,), is_known=False)
    distances: list[float] = []
    changes: list[float] = []
    is_known = True
    for value in _VALUES[name]:
        rates = _rates_of(value, before, after)
        if not rates:
            rates = [0.0]
            is_known = False
        distances.append(fmean(rates) * seconds)
        changes.append((max(rates) - min(rates)) * seconds)
    return _Motion(tuple(distances), tuple(changes), is_known)


def _rates_of(value: str, before: Mapping[str, Any], after: Mapping[str, Any]) -> list[float]:
    """Return the finite rates of change of a value at both messages; an empty list if all are unknown."""
    for rate in _RATES.get(value, ()):
        rates = [message[rate] for message in (before, after) if math.isfinite(message[rate])]
        if value == "dist_bottom":  # which falls by vz
            rates = [-number for number in rates]
        if rates:
            return rates
    return []
