"""Compute a continuous track of a stream despite estimator resets, from the deltas and reset counters of its messages.

When an estimator corrects itself, its position jumps, and the message contains the delta.
A delta explains a jump only if its counter rose by exactly one since the previous message.
A new origin also counts as a reset, but its delta may describe a jump that did not happen, so it is checked against
the values. Source: real logs; in one of them `delta_z` is -179.5 m, although z moved by 2 mm.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from operator import add, sub
from typing import Final, Literal

from .frames import MapProjection, wrap
from .messages.vehicle_local_position import VehicleLocalPosition as Message

Quantity = Literal["xy", "z", "vxy", "vz", "heading", "dist_bottom"]

Point = tuple[float, ...]

_VALUES: Final[Mapping[Quantity, tuple[str, ...]]] = {
    "xy": ("x", "y"), "z": ("z",), "vxy": ("vx", "vy"), "vz": ("vz",), "heading": ("heading",),
    "dist_bottom": ("dist_bottom",),
}  # fmt: skip
RESET_COUNTERS: Final[Mapping[Quantity, str]] = {name: f"{name}_reset_counter" for name in _VALUES}
"""The field that counts the resets of each quantity, modulo 256."""

_TOLERANCE: Final = 2.0  # [m]; maximum difference between the observed jump at a new origin and a candidate


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
        self._jumps: dict[Quantity, Point] = {name: (0.0,) * len(values) for name, values in _VALUES.items()}
        self._resets: dict[Quantity, int] = dict.fromkeys(_VALUES, 0)

    def add(self, message: Message) -> Continuous:
        """Add the next message of the stream and return its values without jumps.

        All tracks restart when the timestamp goes back, which counts as a reboot of the vehicle.
        """
        last, self._last = self._last, message
        reset, discontinued = set[Quantity](), set[Quantity]()
        origin_changed = last is not None and _origin(last) != _origin(message)
        rebooted = last is not None and message.timestamp < last.timestamp
        values: dict[str, float] = {}
        for name, fields in _VALUES.items():
            zero: Point = (0.0,) * len(fields)
            count, jump = 0, None if rebooted else zero
            if last is not None and not rebooted:
                counter = RESET_COUNTERS[name]
                count = (getattr(message, counter) - getattr(last, counter)) % 256
                if origin_changed and name in ("xy", "z"):
                    jump = _jump_of_new_origin(name, last, message, count)
                elif count:
                    jump = _delta(name, message, count)
            if count:
                reset.add(name)
                self._resets[name] += count
            if jump is None:
                discontinued.add(name)
                self._jumps[name] = zero
            elif any(jump):
                self._jumps[name] = tuple(map(add, self._jumps[name], jump))
            values |= zip(fields, map(sub, _point(message, fields), self._jumps[name]), strict=True)
        values["heading"] = wrap(values["heading"])
        return Continuous(
            **values,
            reset=frozenset(reset),
            discontinued=frozenset(discontinued),
            origin_changed=origin_changed,
            resets=dict(self._resets),
        )


def _point(message: Message, fields: Iterable[str]) -> Point:
    return tuple(getattr(message, name) for name in fields)


def _delta(name: Quantity, message: Message, count: int) -> Point | None:
    """Return the delta of a single reset; None after several resets, or if the delta is not provided."""
    delta = getattr(message, f"delta_{name}")
    jump: Point = delta if isinstance(delta, tuple) else (delta,)
    return jump if count == 1 and all(map(math.isfinite, jump)) else None


def _jump_of_new_origin(name: Quantity, last: Message, message: Message, count: int) -> Point | None:
    """Return the jump at a new origin: zero, the delta or the origin's shift, by best fit; None if none fits."""
    fields = _VALUES[name]
    candidates = [(0.0,) * len(fields), _delta(name, message, count)]
    step = message.ref_alt - last.ref_alt
    if name == "z" and math.isfinite(step):
        candidates.append((step,))
    elif name == "xy" and last.xy_global and message.xy_global:
        candidates.append(MapProjection(message.ref_lat, message.ref_lon).project(last.ref_lat, last.ref_lon))
    seconds = (message.timestamp - last.timestamp) / 1e6
    rates = _point(last, (f"v{each}" for each in fields))
    motion = [rate * seconds if math.isfinite(rate) else 0.0 for rate in rates]
    now, before = _point(message, fields), _point(last, fields)
    observed = [new - old - moved for new, old, moved in zip(now, before, motion, strict=True)]
    tolerance = _TOLERANCE + math.hypot(*motion) / 2
    best = min((jump for jump in candidates if jump is not None), key=lambda jump: math.dist(jump, observed))
    return best if math.dist(best, observed) <= tolerance else None


def _origin(message: Message) -> tuple[float | None, ...]:
    """Return the origin with None for NaN, so that missing origins compare equal."""
    values = (message.ref_lat, message.ref_lon, message.ref_alt)
    return tuple(value if math.isfinite(value) else None for value in values)
