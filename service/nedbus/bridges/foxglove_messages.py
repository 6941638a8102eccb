"""Conversion of position and attitude to Foxglove's pose, transforms and location messages; no I/O, no clock."""

import math
from typing import Any, Final

from foxglove.messages import (
    FrameTransform,
    FrameTransforms,
    LocationFix,
    LocationFixPositionCovarianceType,
    Pose,
    PoseInFrame,
    Quaternion,
    Timestamp,
    Vector3,
)

from nedbus_msgs import VehicleLocalPosition
from nedbus_msgs.frames import MapProjection, ned_to_enu, quaternion_ned_to_enu, to_global, yaw_ned_to_enu

_MAP: Final = "map"
_MAX_APART: Final = 500_000  # us between a position and the attitude paired with it


class MapFrame:
    """The frame `map`, with its origin at the first global origin of any vehicle."""

    def __init__(self) -> None:
        self._projection: MapProjection | None = None
        self._altitude = math.nan

    def locate(self, message: VehicleLocalPosition) -> Vector3 | None:
        """Return the translation of a vehicle's local frame in ENU [m]; None without a global origin."""
        if not message.xy_global:
            return None
        if self._projection is None:
            self._projection = MapProjection(message.ref_lat, message.ref_lon)
        if math.isnan(self._altitude) and message.z_global:
            self._altitude = message.ref_alt
        north, east = self._projection.project(message.ref_lat, message.ref_lon)
        up = message.ref_alt - self._altitude
        return Vector3(x=east, y=north, z=up if math.isfinite(up) else 0.0)


def has_position(message: VehicleLocalPosition) -> bool:
    """Return whether the local position is finite."""
    return math.isfinite(message.x + message.y + message.z)


def orientation_of(message: VehicleLocalPosition, attitude: Any = None) -> tuple[float, float, float, float]:
    """Return the rotation from FLU to ENU as (x, y, z, w).

    Taken from a VehicleAttitude within 0.5 s of the position, else from the heading; without either, facing east.
    """
    if attitude is not None and abs(attitude.timestamp - message.timestamp) <= _MAX_APART:
        w, x, y, z = quaternion_ned_to_enu(attitude.q)
        if math.isfinite(w + x + y + z):
            return x, y, z, w
    yaw = yaw_ned_to_enu(message.heading)
    half = yaw / 2 if math.isfinite(yaw) else 0.0
    return 0.0, 0.0, math.sin(half), math.cos(half)


def to_pose(vehicle: str, message: VehicleLocalPosition, orientation: Quaternion, *, time_ns: int) -> PoseInFrame:
    """Return the pose of a vehicle in its local frame."""
    pose = Pose(position=_position(message), orientation=orientation)
    return PoseInFrame(timestamp=_stamp(time_ns), frame_id=f"{vehicle}/local", pose=pose)


def to_transforms(
    vehicle: str, message: VehicleLocalPosition, orientation: Quaternion, *, local_in_map: Vector3, time_ns: int
) -> FrameTransforms:
    """Return the transforms from map to the local frame and from the local frame to the vehicle."""
    local, stamp, no_rotation = f"{vehicle}/local", _stamp(time_ns), Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
    return FrameTransforms(transforms=[
        FrameTransform(
            timestamp=stamp, parent_frame_id=_MAP, child_frame_id=local, translation=local_in_map, rotation=no_rotation
        ),
        FrameTransform(
            timestamp=stamp, parent_frame_id=local, child_frame_id=vehicle, translation=_position(message),
            rotation=orientation,
        ),
    ])  # fmt: skip


def to_location(vehicle: str, message: VehicleLocalPosition, *, time_ns: int) -> LocationFix | None:
    """Return the global position, None if it is not valid."""
    position = to_global(message)
    if not position or not message.xy_valid:
        return None
    variance = message.eph**2 / 2
    is_known = math.isfinite(variance + message.epv)
    covariance_types = LocationFixPositionCovarianceType
    return LocationFix(
        timestamp=_stamp(time_ns),
        frame_id=vehicle,
        latitude=position.latitude,
        longitude=position.longitude,
        altitude=position.altitude,
        position_covariance=[variance, 0, 0, 0, variance, 0, 0, 0, message.epv**2] if is_known else [],
        position_covariance_type=covariance_types.Approximated if is_known else covariance_types.Unknown,
    )


def _position(message: VehicleLocalPosition) -> Vector3:
    east, north, up = ned_to_enu((message.x, message.y, message.z))
    return Vector3(x=east, y=north, z=up)


def _stamp(time_ns: int) -> Timestamp:
    return Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9)
