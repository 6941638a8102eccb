"""Frame conversions as in PX4: NED and ENU, FRD and FLU, local and global positions; height, speed and Euler angles.

Angles are in radians, latitudes and longitudes in degrees, lengths in metres.
Source: PX4's MapProjection (azimuthal equidistant, on a sphere); results agree with PX4's own
`vehicle_global_position` within 1e-10 degrees.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    from .messages.vehicle_local_position import VehicleLocalPosition as Message

__all__ = [
    "DERIVED", "DerivedField", "GlobalPosition", "MapProjection", "Ned", "Vector", "derive", "derived_from",
    "enu_to_ned", "euler_to_quaternion", "flu_to_frd", "frd_to_flu", "ned_to_enu",
    "quaternion_enu_to_ned", "quaternion_ned_to_enu", "quaternion_to_euler", "to_global", "to_local",
    "variances_enu_to_ned", "variances_ned_to_enu", "yaw_enu_to_ned", "yaw_ned_to_enu",
]  # fmt: skip

EARTH_RADIUS: Final = 6_371_000.0
"""Earth radius in PX4's MapProjection [m]."""

Vector = tuple[float, float, float]
_Quaternion = tuple[float, float, float, float]


class Ned(NamedTuple):
    """North, east and down: a position [m] or a velocity [m/s]."""

    north: float
    east: float
    down: float


def ned_to_enu(vector: Vector) -> Vector:
    """Convert a position, velocity or acceleration from NED to ENU, or vice versa."""
    north, east, down = vector
    return east, north, -down


def frd_to_flu(vector: Vector) -> Vector:
    """Convert a vector from the body frame FRD (PX4) to FLU (ROS), or vice versa."""
    forward, right, down = vector
    return forward, -right, -down


def yaw_ned_to_enu(yaw: float) -> float:
    """Convert a heading (clockwise from north) to ENU yaw (counterclockwise from east) in [-pi, pi], or vice versa."""
    return wrap(math.pi / 2 - yaw)


def variances_ned_to_enu(variances: Vector) -> Vector:
    """Convert variances of north, east and down to east, north and up, or vice versa; no sign changes."""
    north, east, down = variances
    return east, north, down


def quaternion_ned_to_enu(q: Sequence[float]) -> _Quaternion:
    """Convert an attitude (w, x, y, z) from PX4's convention (FRD to NED) to ROS's (FLU to ENU), or vice versa."""
    w, x, y, z = (value * math.sqrt(0.5) for value in q)
    return w + z, x + y, x - y, w - z


# Each conversion swaps axes or is a half turn, and is therefore its own inverse.
enu_to_ned = ned_to_enu
flu_to_frd = frd_to_flu
yaw_enu_to_ned = yaw_ned_to_enu
variances_enu_to_ned = variances_ned_to_enu
quaternion_enu_to_ned = quaternion_ned_to_enu


def wrap(angle: float) -> float:
    """Wrap an angle to [-pi, pi]; NaN for NaN and infinities."""
    if not math.isfinite(angle):
        return math.nan
    return math.remainder(angle, math.tau)


def euler_to_quaternion(roll: float, pitch: float, yaw: float) -> _Quaternion:
    """Return the rotation from body FRD to NED (w, x, y, z) for roll, pitch and heading."""
    cos_roll = math.cos(roll / 2)
    sin_roll = math.sin(roll / 2)
    cos_pitch = math.cos(pitch / 2)
    sin_pitch = math.sin(pitch / 2)
    cos_yaw = math.cos(yaw / 2)
    sin_yaw = math.sin(yaw / 2)
    w = cos_roll * cos_pitch * cos_yaw + sin_roll * sin_pitch * sin_yaw
    x = sin_roll * cos_pitch * cos_yaw - cos_roll * sin_pitch * sin_yaw
    y = cos_roll * sin_pitch * cos_yaw + sin_roll * cos_pitch * sin_yaw
    z = cos_roll * cos_pitch * sin_yaw - sin_roll * sin_pitch * cos_yaw
    return w, x, y, z


def quaternion_to_euler(q: Sequence[float]) -> Vector:
    """Return roll, pitch and heading of a rotation from body FRD to NED (w, x, y, z); NaN for zeros, which are none."""
    norm = math.hypot(*q)
    if not norm:
        return math.nan, math.nan, math.nan
    roll, pitch, yaw = _euler(_OF_NUMBERS, [element / norm for element in q])
    return roll, pitch, yaw


class Functions(NamedTuple):
    """Functions of numbers, or of arrays."""

    sqrt: Callable[[Any], Any]
    atan2: Callable[[Any, Any], Any]


_OF_NUMBERS: Final = Functions(math.sqrt, math.atan2)


def _euler(functions: Functions, q: Any) -> tuple[Any, Any, Any]:
    """Return roll, pitch and yaw [rad] of the elements of q, numbers or arrays."""
    w, x, y, z = q
    # both times the cosine of pitch
    sine_roll = 2 * (w * x + y * z)
    cosine_roll = 1 - 2 * (x * x + y * y)
    cosine_pitch = functions.sqrt(sine_roll * sine_roll + cosine_roll * cosine_roll)
    roll = functions.atan2(sine_roll, cosine_roll)
    pitch = functions.atan2(2 * (w * y - z * x), cosine_pitch)
    yaw = functions.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return roll, pitch, yaw


class DerivedField(NamedTuple):
    """A quantity computed from fields of a message; NaN while the flag is false, or q is not a rotation.

    `meaning`: with unit and frame. `fields`: on which it depends. `flag`: the field that declares these valid, or "".
    `compute`: the quantity, given functions of numbers or of arrays, and the values of `fields`.
    """

    meaning: str
    fields: tuple[str, ...]
    flag: str
    compute: Callable[..., Any]


def _angle(meaning: str, index: int, scale: float = 1.0) -> DerivedField:
    """Return one of roll, pitch and yaw [rad], times a scale."""
    return DerivedField(
        meaning, ("q",), "", lambda functions, q: scale * _euler(functions, q)[index]
    )


_DEGREES: Final = 180.0 / math.pi

DERIVED: Final[Mapping[str, DerivedField]] = {
    "height": DerivedField(
        "-z, height above the origin of the local frame [m]",
        ("z",),
        "z_valid",
        lambda _, z: -z,
    ),
    "speed": DerivedField(
        "horizontal speed, the norm of vx and vy [m/s]",
        ("vx", "vy"),
        "v_xy_valid",
        lambda functions, vx, vy: functions.sqrt(vx * vx + vy * vy),
    ),
    "roll": _angle(
        "roll about the forward axis, the last of the rotations yaw, pitch, roll from NED to body FRD [rad]",
        0,
    ),
    "pitch": _angle(
        "pitch, positive nose up, within a quarter turn; after yaw and before roll [rad]", 1
    ),
    "yaw": _angle(
        "yaw, clockwise from north; the first of the rotations from NED to body FRD [rad]", 2
    ),
    "roll_deg": _angle("roll [deg]", 0, _DEGREES),
    "pitch_deg": _angle("pitch [deg]", 1, _DEGREES),
    "yaw_deg": _angle("yaw [deg]", 2, _DEGREES),
}
"""Quantities that tables and commands offer by name for each message with their fields."""


def derived_from(fields: Iterable[str]) -> list[str]:
    """Return the names in DERIVED of the quantities that a message with these fields has, except its own fields."""
    own = set(fields)
    names: list[str] = []
    for name, derived in DERIVED.items():
        needed = set(derived.fields)
        if derived.flag:
            needed.add(derived.flag)
        if name not in own and own.issuperset(needed):
            names.append(name)
    return names


def derive(message: object, name: str) -> float:
    """Return a quantity of DERIVED of a message or row; NaN while it is invalid."""
    derived = DERIVED[name]
    values = [getattr(message, field) for field in derived.fields]
    if derived.flag and getattr(message, derived.flag) is not True:
        return math.nan
    if not derived.flag and not is_rotation(values[0]):
        return math.nan
    return float(derived.compute(_OF_NUMBERS, *values))


def is_rotation(q: Any) -> Any:
    """Return whether q has norm 1 within 0.001, as a valid message has; false for zeros and NaN."""
    w, x, y, z = q
    squared = w * w + x * x + y * y + z * z
    # `&`, because `and` does not work on arrays
    return (squared >= 0.999**2) & (squared <= 1.001**2)


@dataclass(frozen=True, slots=True)
class MapProjection:
    """PX4's azimuthal equidistant projection around an origin: latitude, longitude [deg] <-> north, east [m]."""

    latitude: float
    longitude: float

    def project(self, latitude: float, longitude: float) -> tuple[float, float]:
        """Return north and east [m] of a latitude and longitude [deg]."""
        sine, cosine = _sine_and_cosine(self.latitude)
        sine_other, cosine_other = _sine_and_cosine(latitude)
        difference = math.radians(longitude - self.longitude)
        cosine_difference = math.cos(difference)
        cosine_angle = sine * sine_other + cosine * cosine_other * cosine_difference
        angle = math.acos(min(1.0, max(-1.0, cosine_angle)))
        scale = EARTH_RADIUS
        if math.sin(angle):
            scale = EARTH_RADIUS * (angle / math.sin(angle))
        north = scale * (cosine * sine_other - sine * cosine_other * cosine_difference)
        east = scale * cosine_other * math.sin(difference)
        return north, east

    def reproject(self, north: float, east: float) -> tuple[float, float]:
        """Return latitude and longitude [deg] of a point [m]; the longitude is within [-180, 180]."""
        x = north / EARTH_RADIUS
        y = east / EARTH_RADIUS
        angle = math.hypot(x, y)
        if not angle:
            return self.latitude, math.remainder(self.longitude, 360.0)
        sine, cosine = _sine_and_cosine(self.latitude)
        sine_angle = math.sin(angle)
        cosine_angle = math.cos(angle)
        axial = cosine_angle * sine + x * sine_angle * cosine / angle
        radial = cosine_angle * cosine - x * sine_angle * sine / angle
        eastward = y * sine_angle / angle
        # PX4 uses an arc sine, which is inexact at the poles; elsewhere the result is the same.
        latitude = math.degrees(math.atan2(axial, math.hypot(radial, eastward)))
        turned = math.degrees(math.atan2(eastward, radial))
        return latitude, math.remainder(self.longitude + turned, 360.0)


@dataclass(slots=True)
class CommonOrigin:
    """The common origin of several vehicles: the first one that two successive messages of a vehicle have.

    `projection`: its projection, None before the first origin; provisional until the second message.
    `altitude`: its altitude [m], NaN if unknown.
    """

    projection: MapProjection | None = None
    altitude: float = math.nan
    _vehicle: object = None
    _first: tuple[float, ...] = ()
    _is_confirmed: bool = False

    def update(self, vehicle: object, message: Message) -> MapProjection:
        """Add a message with a global origin; return the projection."""
        projection = self.projection
        if projection is None or (not self._is_confirmed and vehicle == self._vehicle):
            origin: tuple[float, ...] = (message.ref_lat, message.ref_lon)
            if message.z_global:
                origin = (*origin, message.ref_alt)
            self._is_confirmed = origin == self._first
            if projection is None or not self._is_confirmed:
                self._vehicle = vehicle
                self._first = origin
                self.altitude = math.nan
                projection = MapProjection(message.ref_lat, message.ref_lon)
                self.projection = projection
        if math.isnan(self.altitude) and message.z_global:
            self.altitude = message.ref_alt
        return projection


class GlobalPosition(NamedTuple):
    """Latitude and longitude [deg, WGS84], and altitude above mean sea level [m], which is NaN if unknown."""

    latitude: float
    longitude: float
    altitude: float

    @classmethod
    def wrapped(cls, latitude: float, longitude: float, altitude: float) -> GlobalPosition:
        """Return a position with a longitude within [-180, 180], which PX4 up to 1.15 exceeds at the antimeridian."""
        if math.isfinite(longitude):
            longitude = math.remainder(longitude, 360.0)
        return cls(latitude, longitude, altitude)


def to_global(message: Message) -> GlobalPosition | None:
    """Return the global position of a message; None if `xy_global` is false, or if x or y is not finite.

    The altitude is NaN while only the horizontal origin is known.
    x, y and z are converted whether valid or not; `message.global_position` is None while one of them is invalid.
    """
    if not message.xy_global or not math.isfinite(message.x + message.y):
        return None
    projection = MapProjection(message.ref_lat, message.ref_lon)
    latitude, longitude = projection.reproject(message.x, message.y)
    altitude = math.nan
    if message.z_global:
        altitude = message.ref_alt - message.z
    return GlobalPosition(latitude, longitude, altitude)


def to_local(position: GlobalPosition, origin: Message) -> Vector | None:
    """Return x, y and z of a global position in the local frame of the message `origin`; None without a global origin.

    z is NaN while only the horizontal origin is known.
    """
    if not origin.xy_global:
        return None
    projection = MapProjection(origin.ref_lat, origin.ref_lon)
    x, y = projection.project(position.latitude, position.longitude)
    z = math.nan
    if origin.z_global:
        z = origin.ref_alt - position.altitude
    return x, y, z


def _sine_and_cosine(degrees: float) -> tuple[float, float]:
    angle = math.radians(degrees)
    return math.sin(angle), math.cos(angle)
