"""Find what a reset changed in an estimate, and compute a track without these jumps.

A reset announces its delta, but the published values step by something else: in a real flight by (3.6, -2.7) m where
`delta_xy` is (5.8, -4.7), and at the first origin by millimetres where `delta_z` is -489 m. The step is known as
accurately as the motion in between, so the delta is used only if it agrees, or if the messages are too far apart.
Source: the resets of 15 real logs, measured by `python -m benchmarks.resets`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from operator import add, attrgetter, sub
from statistics import fmean
from typing import Any, Final, Literal

from .frames import MapProjection, wrap
from .messages.vehicle_local_position import VehicleLocalPosition as Message

Quantity = Literal["xy", "z", "vxy", "vz", "heading", "dist_bottom"]

Point = tuple[float, ...]

_VALUES: Final[Mapping[Quantity, tuple[str, ...]]] = {
    "xy": ("x", "y"), "z": ("z",), "vxy": ("vx", "vy"), "vz": ("vz",), "heading": ("heading",),
    "dist_bottom": ("dist_bottom",),
}  # fmt: skip
# The rates of change of each value in order of preference; dist_bottom falls by vz, and the heading has no rate.
_RATES: Final[Mapping[str, tuple[str, ...]]] = {
    "x": ("vx",), "y": ("vy",), "z": ("z_deriv", "vz"), "vx": ("ax",), "vy": ("ay",), "vz": ("az",),
    "dist_bottom": ("vz",),
}  # fmt: skip
RESET_COUNTERS: Final[Mapping[Quantity, str]] = {name: f"{name}_reset_counter" for name in _VALUES}
"""The field that counts the resets of each quantity, modulo 256."""

_ORIGIN: Final = ("ref_lat", "ref_lon", "ref_alt")
_read_origin: Final = attrgetter(*_ORIGIN)  # compared as text, in which NaN equals NaN
JUMP_FIELDS: Final = (
    *sorted({each for names in (*_VALUES.values(), *_RATES.values()) for each in names}),
    *(f"delta_{name}" for name in _VALUES), *_ORIGIN, "unaided_heading",
)  # fmt: skip
"""The fields that `jump_of` needs besides `timestamp` and the reset counter."""

# us; a larger step back in time is a reboot, a smaller one is reordering
_REBOOT: Final = 1_000_000
# s for which the rates at both ends determine the motion well enough to find a step
_MAX_INTERVAL: Final = 3.0
_MAX_UNKNOWN: Final = 0.5  # s, the same without rates
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
        self._jumps: dict[Quantity, Point] = {
            name: (0.0,) * len(values) for name, values in _VALUES.items()
        }
        self._resets: dict[Quantity, int] = dict.fromkeys(_VALUES, 0)

    def add(self, message: Message) -> Continuous:
        """Add the next message of the stream and return its values without jumps.

        All tracks restart when the timestamp goes back by over a second, which counts as a reboot of the vehicle.
        """
        last, self._last = self._last, message
        reset, discontinued = set[Quantity](), set[Quantity]()
        rebooted = last is not None and message.timestamp < last.timestamp - _REBOOT
        origin_changed = last is not None and str(_read_origin(last)) != str(_read_origin(message))
        values: dict[str, float] = {}
        for name, fields in _VALUES.items():
            zero: Point = (0.0,) * len(fields)
            jump = None if rebooted else zero
            if last is not None and not rebooted:
                counter = RESET_COUNTERS[name]
                count = (getattr(message, counter) - getattr(last, counter)) % 256
                if count:
                    reset.add(name)
                    self._resets[name] += count
                if count or (origin_changed and name in ("xy", "z")):
                    jump = jump_of(name, _by_name(last), _by_name(message))
            if jump is None:
                discontinued.add(name)
                self._jumps[name] = zero
            elif any(jump):
                self._jumps[name] = tuple(map(add, self._jumps[name], jump))
            point = (getattr(message, field) for field in fields)
            values |= zip(fields, map(sub, point, self._jumps[name]), strict=True)
        values["heading"] = wrap(values["heading"])
        return Continuous(
            **values,
            reset=frozenset(reset),
            discontinued=frozenset(discontinued),
            origin_changed=origin_changed,
            resets=dict(self._resets),
        )


def _by_name(message: Message) -> dict[str, Any]:
    """Return what `jump_of` needs of a model or a row."""
    return {
        name: getattr(message, name)
        for name in ("timestamp", *RESET_COUNTERS.values(), *JUMP_FIELDS)
    }


def jump_of(name: Quantity, before: Mapping[str, Any], after: Mapping[str, Any]) -> Point | None:
    """Return by how much resets or a new origin changed a quantity between two messages; None if it is unknown.

    It is the step between the messages minus the motion in between, unless an announced size agrees with that: the
    delta of a single reset, and at a new origin zero or the distance of the origins.
    `before`, `after`: JUMP_FIELDS and the others by name, NaN if not provided.
    """
    values, counter = _VALUES[name], RESET_COUNTERS[name]
    seconds = (after["timestamp"] - before["timestamp"]) / 1e6
    delta = after[f"delta_{name}"]
    announced = []
    if (after[counter] - before[counter]) % 256 == 1:
        announced.append(delta if isinstance(delta, tuple) else (delta,))
    if name in ("xy", "z") and str([before[each] for each in _ORIGIN]) != str(
        [after[each] for each in _ORIGIN]
    ):
        shift = MapProjection(after["ref_lat"], after["ref_lon"]).project(
            before["ref_lat"], before["ref_lon"]
        )
        announced += [
            (0.0,) * len(values),
            shift if name == "xy" else (after["ref_alt"] - before["ref_alt"],),
        ]
    announced = [jump for jump in announced if all(map(math.isfinite, jump))]
    motions = [_motion(value, before, after, seconds) for value in values]
    is_known = all(math.isfinite(moved) for moved, _ in motions)
    motion, changes = zip(
        *(each if math.isfinite(each[0]) else (0.0, 0.0) for each in motions), strict=True
    )
    step = tuple(
        after[value] - before[value] - moved for value, moved in zip(values, motion, strict=True)
    )
    if not all(map(math.isfinite, step)) or seconds <= 0:
        return announced[0] if announced else None
    if name == "heading":
        step = (wrap(step[0]),)
    is_measured = seconds <= (_MAX_INTERVAL if is_known else _MAX_UNKNOWN)
    tolerance = _UNKNOWN_SPEED * seconds
    if is_measured and is_known:
        tolerance = _NOISE + min(_JERK * seconds**3, _SPEED * seconds)
        tolerance += 2 * math.hypot(*changes) if seconds > _SURE_INTERVAL else 0.0
    elif not is_measured:
        tolerance += math.hypot(*motion)
    best = min(announced, key=lambda jump: math.dist(jump, step), default=None)
    if best is not None and math.dist(best, step) <= tolerance:
        return best
    return step if is_measured else None


def _motion(
    value: str, before: Mapping[str, Any], after: Mapping[str, Any], seconds: float
) -> tuple[float, float]:
    """Return how far a value moved by its rates at both messages, NaN if unknown, and by how much the rates differ."""
    if value == "heading":  # the gyroscopes' heading has no resets
        turned: float = after["unaided_heading"] - before["unaided_heading"]
        return (wrap(turned) if math.isfinite(turned) else math.nan), 0.0
    for name in _RATES[value]:
        if rates := [rate for rate in (before[name], after[name]) if math.isfinite(rate)]:
            sign = -1 if value == "dist_bottom" else 1
            return sign * fmean(rates) * seconds, (max(rates) - min(rates)) * seconds
    return math.nan, 0.0
