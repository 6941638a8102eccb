"""A continuous track of a stream whose estimator resets: what the deltas and counters of the message are for.

When an estimator corrects itself its position jumps, and the message says by how much.
A delta explains a jump only if its counter rose by exactly one since the last message that was seen.
A new origin resets as well, and then the delta may describe a jump that never came: what came is looked at.
Source: counted on real logs, among them one where `delta_z` says -179.5 m and z moved by 2 mm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from .frames import MapProjection, wrap
from .position import VehicleLocalPosition

Quantity = Literal["xy", "z", "vxy", "vz", "heading", "dist_bottom"]


@dataclass(frozen=True, slots=True)
class _Row:
    """Where a quantity stands in the message."""

    values: tuple[str, ...]
    delta: str
    counter: str
    rates: tuple[str, ...] = ()


_ROWS: Final[Mapping[Quantity, _Row]] = {
    "xy": _Row(("x", "y"), "delta_xy", "xy_reset_counter", ("vx", "vy")),
    "z": _Row(("z",), "delta_z", "z_reset_counter", ("vz",)),
    "vxy": _Row(("vx", "vy"), "delta_vxy", "vxy_reset_counter", ("ax", "ay")),
    "vz": _Row(("vz",), "delta_vz", "vz_reset_counter", ("az",)),
    "heading": _Row(("heading",), "delta_heading", "heading_reset_counter"),
    "dist_bottom": _Row(("dist_bottom",), "delta_dist_bottom", "dist_bottom_reset_counter"),
}
_NEAR: Final = 2.0  # m that a position may differ from a guess at a new origin, and still be explained by it

Point = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Continuous:
    """One message of a continuous track: its values without the jumps of all resets since the track began.

    Frame and units are the message's; `heading` is within [-pi, pi].
    `reset`: the quantities that were reset just before this message, explained or not.
    `lost`: those whose jump nothing explains: their track begins anew here, with the message's own value.
    `origin_changed`: the global origin is new, or another one.
    `resets`: how many resets of each there were since the first message.
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
    lost: frozenset[Quantity]
    origin_changed: bool
    resets: Mapping[Quantity, int]


@dataclass(slots=True)
class ResetTracker:
    """Follow one stream, one vehicle's topic and instance; each EKF has resets, and an origin, of its own.

    The selector of several EKFs does not tell of resets of `dist_bottom`: there the track of that may jump.
    """

    _last: VehicleLocalPosition | None = None
    _jumps: dict[Quantity, Point] = field(default_factory=lambda: {name: _zero(row) for name, row in _ROWS.items()})
    _resets: dict[Quantity, int] = field(default_factory=lambda: dict.fromkeys(_ROWS, 0))

    def add(self, message: VehicleLocalPosition) -> Continuous:
        """Take the next message, or Row, of the stream, and return it without jumps.

        A time that goes back is a vehicle that started again: everything begins anew.
        """
        last, self._last = self._last, message
        reset: set[Quantity] = set()
        lost: set[Quantity] = set()
        moved = last is not None and _origin(last) != _origin(message)
        if last is not None and message.timestamp < last.timestamp:
            lost.update(_ROWS)
        elif last is not None:
            for name, row in _ROWS.items():
                count = (getattr(message, row.counter) - getattr(last, row.counter)) % 256
                shifts = moved and name in ("xy", "z")
                if not count and not shifts:
                    continue
                if count:
                    reset.add(name)
                    self._resets[name] += count
                jump = _new_origin(name, row, last, message, count) if shifts else _delta(row, message, count)
                if jump is None:
                    lost.add(name)
                else:
                    self._jumps[name] = tuple(a + b for a, b in zip(self._jumps[name], jump, strict=True))
        for name in lost:
            self._jumps[name] = _zero(_ROWS[name])
        values = {
            word: value - jump
            for name, row in _ROWS.items()
            for word, value, jump in zip(row.values, _values(row, message), self._jumps[name], strict=True)
        }
        values["heading"] = wrap(values["heading"])
        return Continuous(
            **values,
            reset=frozenset(reset),
            lost=frozenset(lost),
            origin_changed=moved,
            resets=dict(self._resets),
        )


def _delta(row: _Row, message: VehicleLocalPosition, count: int) -> Point | None:
    """Return the jump that the message tells of, None if it does not tell of all of it."""
    delta = getattr(message, row.delta)
    jump: Point = delta if isinstance(delta, tuple) else (delta,)
    return jump if count == 1 and all(map(math.isfinite, jump)) else None


def _new_origin(
    name: Quantity, row: _Row, last: VehicleLocalPosition, message: VehicleLocalPosition, count: int
) -> Point | None:
    """Return the jump that a new origin made: none, the delta, or the way from origin to origin, whichever came."""
    guesses = [_zero(row), _delta(row, message, count), _between_origins(name, last, message)]
    seconds = (message.timestamp - last.timestamp) / 1e6
    speeds = [getattr(last, rate) for rate in row.rates]
    motion = [speed * seconds if math.isfinite(speed) else 0.0 for speed in speeds]
    came = [now - then - way for now, then, way in zip(_values(row, message), _values(row, last), motion, strict=True)]
    reach = _NEAR + math.hypot(*motion) / 2
    best = min((guess for guess in guesses if guess is not None), key=lambda guess: math.dist(guess, came))
    return best if math.dist(best, came) <= reach else None


def _between_origins(name: Quantity, last: VehicleLocalPosition, message: VehicleLocalPosition) -> Point | None:
    """Return how far a place moves in the local frame when its origin does."""
    if name == "z":
        step = message.ref_alt - last.ref_alt
        return (step,) if math.isfinite(step) else None
    if not (last.xy_global and message.xy_global):
        return None
    return MapProjection(message.ref_lat, message.ref_lon).project(last.ref_lat, last.ref_lon)


def _origin(message: VehicleLocalPosition) -> tuple[float | None, ...]:
    """Return the origin in a form in which no origin equals no origin."""
    values = (message.ref_lat, message.ref_lon, message.ref_alt)
    return tuple(value if math.isfinite(value) else None for value in values)


def _values(row: _Row, message: VehicleLocalPosition) -> Point:
    return tuple(getattr(message, word) for word in row.values)


def _zero(row: _Row) -> Point:
    return (0.0,) * len(row.values)
