"""Frames: NED and ENU, FRD and FLU, and the way between local and global positions, as PX4 computes it.

Angles are radians, latitudes and longitudes degrees, lengths metres.
Source: PX4's MapProjection (azimuthal equidistant, on a sphere), so that a position agrees with PX4's own
`vehicle_global_position` to the last digits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

from .position import VehicleLocalPosition

EARTH_RADIUS: Final = 6_371_000.0
"""Radius of PX4's sphere [m]."""

Vector = tuple[float, float, float]


def ned_to_enu(vector: Vector) -> Vector:
    """Return a position, velocity or acceleration of NED in ENU."""
    north, east, down = vector
    return east, north, -down


def enu_to_ned(vector: Vector) -> Vector:
    """Return a position, velocity or acceleration of ENU in NED."""
    east, north, up = vector
    return north, east, -up


def frd_to_flu(vector: Vector) -> Vector:
    """Return a vector of the body frame FRD (PX4) in FLU (ROS)."""
    forward, right, down = vector
    return forward, -right, -down


def flu_to_frd(vector: Vector) -> Vector:
    """Return a vector of the body frame FLU (ROS) in FRD (PX4)."""
    forward, left, up = vector
    return forward, -left, -up


def yaw_ned_to_enu(yaw: float) -> float:
    """Return a heading, clockwise from north, as ENU has it: counterclockwise from east, within [-pi, pi]."""
    return wrap(math.pi / 2 - yaw)


def yaw_enu_to_ned(yaw: float) -> float:
    """Return a yaw, counterclockwise from east, as NED has it: clockwise from north, within [-pi, pi]."""
    return wrap(math.pi / 2 - yaw)


def variances_ned_to_enu(variances: Vector) -> Vector:
    """Return variances of north, east and down as those of east, north and up: none of them changes its sign."""
    north, east, down = variances
    return east, north, down


def variances_enu_to_ned(variances: Vector) -> Vector:
    """Return variances of east, north and up as those of north, east and down: none of them changes its sign."""
    east, north, up = variances
    return north, east, up


def wrap(angle: float) -> float:
    """Return the same angle within [-pi, pi]."""
    return math.remainder(angle, math.tau) if math.isfinite(angle) else math.nan


@dataclass(frozen=True, slots=True)
class MapProjection:
    """The plane that touches PX4's sphere at an origin: latitude and longitude [deg] <-> north and east [m]."""

    latitude: float
    longitude: float

    def project(self, latitude: float, longitude: float) -> tuple[float, float]:
        """Return north and east [m] of a place."""
        sine, cosine = _sine_and_cosine(self.latitude)
        sine_there, cosine_there = _sine_and_cosine(latitude)
        turn = math.radians(longitude - self.longitude)
        angle = math.acos(_clip(sine * sine_there + cosine * cosine_there * math.cos(turn)))
        scale = EARTH_RADIUS * (angle / math.sin(angle) if math.sin(angle) else 1.0)
        north = scale * (cosine * sine_there - sine * cosine_there * math.cos(turn))
        return north, scale * cosine_there * math.sin(turn)

    def reproject(self, north: float, east: float) -> tuple[float, float]:
        """Return latitude and longitude [deg] of a point [m]; the longitude is within [-180, 180]."""
        x, y = north / EARTH_RADIUS, east / EARTH_RADIUS
        angle = math.hypot(x, y)
        if not angle:
            return self.latitude, self.longitude
        sine, cosine = _sine_and_cosine(self.latitude)
        near, far = math.cos(angle), math.sin(angle)
        up = near * sine + x * far * cosine / angle
        along, aside = cosine * near - x * sine * far / angle, y * far / angle
        # PX4's arc sine is not exact at the poles; elsewhere this is the same.
        latitude = math.degrees(math.atan2(up, math.hypot(along, aside)))
        return latitude, math.remainder(self.longitude + math.degrees(math.atan2(aside, along)), 360.0)


class GlobalPosition(NamedTuple):
    """A place on the earth: latitude and longitude [deg, WGS84], altitude above mean sea level [m], NaN if unknown."""

    latitude: float
    longitude: float
    altitude: float


@dataclass(frozen=True, slots=True)
class NoOrigin:
    """The answer for a message without a global origin; it is false, so `if place := to_global(message):` reads well.

    `reason` says what is missing.
    """

    reason: str

    def __bool__(self) -> Literal[False]:
        return False


def to_global(message: VehicleLocalPosition) -> GlobalPosition | NoOrigin:
    """Return where a message, or a Row, is on the earth; NoOrigin while it has none.

    The altitude is NaN while only the horizontal origin is known.
    The position is that of x, y and z, valid or not: look at `xy_valid` and `z_valid`.
    """
    if not message.xy_global:
        return NoOrigin("xy_global is false: x and y have no global origin yet")
    if not math.isfinite(message.x + message.y):
        return NoOrigin("x and y are not provided")
    latitude, longitude = MapProjection(message.ref_lat, message.ref_lon).reproject(message.x, message.y)
    return GlobalPosition(latitude, longitude, message.ref_alt - message.z if message.z_global else math.nan)


def to_local(place: GlobalPosition, origin: VehicleLocalPosition) -> Vector | NoOrigin:
    """Return x, y and z of a place in the local frame of a message, or a Row; NoOrigin while that has none.

    z is NaN while only the horizontal origin is known.
    """
    if not origin.xy_global:
        return NoOrigin("xy_global is false: x and y have no global origin yet")
    x, y = MapProjection(origin.ref_lat, origin.ref_lon).project(place.latitude, place.longitude)
    return x, y, origin.ref_alt - place.altitude if origin.z_global else math.nan


def _sine_and_cosine(degrees: float) -> tuple[float, float]:
    angle = math.radians(degrees)
    return math.sin(angle), math.cos(angle)


def _clip(value: float) -> float:
    return min(1.0, max(-1.0, value))
