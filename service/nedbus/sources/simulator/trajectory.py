"""The path of the simulated vehicle: take-off, then figures of eight at 20 m."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from nedbus_msgs import wrap

_ALTITUDE: Final = 20.0  # m
CLIMB: Final = 10.0  # s until it is there
_SIZE: Final = 40.0  # m
_STEP: Final = 1e-3  # s, of the derivatives

Vector = tuple[float, ...]  # north, east, down


class Truth(NamedTuple):
    """The true state: position [m], velocity [m/s], acceleration [m/s^2] in local NED, heading [rad]."""

    position: Vector
    velocity: Vector
    acceleration: Vector
    heading: float


def truth_at(time: float, direction: float) -> Truth:
    """Return the truth at a time [s] since the start; `direction` [rad] is that of the figures."""
    positions = [_position(time + offset, direction) for offset in (-_STEP, 0.0, _STEP)]
    axes = list(zip(*positions, strict=True))
    velocity = tuple((after - before) / (2 * _STEP) for before, _, after in axes)
    acceleration = tuple((after - 2 * now + before) / _STEP**2 for before, now, after in axes)
    moving = math.hypot(velocity[0], velocity[1]) > 0.5
    heading = math.atan2(velocity[1], velocity[0]) if moving else wrap(direction + math.pi / 4)
    return Truth(positions[1], velocity, acceleration, heading)


def _position(time: float, direction: float) -> Vector:
    climb = _smoothstep(time / CLIMB)
    # The phase starts slowly after the climb and then advances evenly, one figure a minute.
    late = max(0.0, time - 8.0)
    phase = math.tau / 60.0 * (late - 6.0 * (1.0 - math.exp(-late / 6.0)))
    along, across = _SIZE * math.sin(phase), _SIZE / 2 * math.sin(2 * phase)
    cos, sin = math.cos(direction), math.sin(direction)
    down = -climb * (_ALTITUDE + 2.0 * math.sin(phase / 2) ** 2)
    return along * cos - across * sin, along * sin + across * cos, down


def _smoothstep(part: float) -> float:
    """Rise from 0 to 1 with continuous acceleration."""
    part = min(1.0, max(0.0, part))
    return part**3 * (10 - 15 * part + 6 * part**2)
