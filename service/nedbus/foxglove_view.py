"""Live vehicles in Foxglove: all fields for plots, poses and frames for the 3D view, places for the map.

    /<vehicle>/<topic>     px4_msgs/msg/VehicleLocalPosition, every field as it is
    /<vehicle>/pose        foxglove.PoseInFrame, ENU and FLU, of vehicle_local_position
    /<vehicle>/location    foxglove.LocationFix, while the position is valid and has a global origin
    /tf                    foxglove.FrameTransforms: map -> <vehicle>/local -> <vehicle>

Vehicles with different origins stand beside each other in `map`, whose origin is that of the first one that has one.
"""

from __future__ import annotations

import logging
import math
import socket
import threading
import time
from dataclasses import dataclass
from typing import Final

import foxglove
from foxglove.channels import FrameTransformsChannel, LocationFixChannel, PoseInFrameChannel
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

from nedbus_msgs import (
    ANY,
    CURRENT,
    ROS2_TYPE,
    Address,
    MapProjection,
    VehicleLocalPosition,
    downgrade,
    encode_cdr,
    message_definition,
    ned_to_enu,
    to_global,
    yaw_ned_to_enu,
)

from .bus import Bus
from .errors import ListenError, NoDataError
from .intake import Sample

_log = logging.getLogger(__name__)

DEFAULT_PORT: Final = 8765
"""The port that Foxglove proposes."""

_POSE_TOPIC: Final = "vehicle_local_position"
_LOOK: Final = 1.0  # s between two looks at who is there
_MAP: Final = "map"
_HINT: Final = "choose another port with --port"


@dataclass(slots=True, eq=False)
class _Vehicle:
    """The channels of one vehicle, and where its local frame stands in the map."""

    pose: PoseInFrameChannel
    location: LocationFixChannel
    origin: tuple[float, float, float] | None = None
    place: Vector3 | None = None


class FoxgloveView:
    """Serve what is on a bus to Foxglove, over its WebSocket protocol; a context manager that ends it.

    Only what somebody looks at is encoded; a client that is too slow misses the oldest.

    Raises ListenError when the port is taken.
    """

    def __init__(self, bus: Bus, *, host: str = "127.0.0.1", port: int = DEFAULT_PORT) -> None:
        self._bus = bus
        self._context = foxglove.Context()
        self._schema = foxglove.Schema(
            name=ROS2_TYPE, encoding="ros2msg", data=message_definition(CURRENT.name).encode()
        )
        self._plots: dict[Address, foxglove.Channel] = {}
        self._vehicles: dict[str, _Vehicle] = {}
        self._map: MapProjection | None = None
        self._map_altitude = math.nan
        _require_free(host, port)
        try:
            self._server = foxglove.start_server(name="nedbus", host=host, port=port, context=self._context)
        except RuntimeError as exc:
            raise ListenError([f"ws://{host}:{port}"], "it is taken", hint=_HINT) from exc
        self._frames = FrameTransformsChannel("/tf", context=self._context)
        self.url = f"ws://{host}:{self._server.port}"

    def run(self, stop: threading.Event, *, vehicle: str = ANY) -> None:
        """Serve until `stop` is set, or the bus is closed."""
        with self._bus.subscribe(vehicle=vehicle) as subscription:
            look = time.monotonic() + _LOOK
            while not stop.is_set():
                if time.monotonic() >= look:
                    self._part_from_gone()
                    look = time.monotonic() + _LOOK
                try:
                    self.show(subscription.receive(0.1))
                except NoDataError:
                    continue

    def show(self, sample: Sample) -> None:
        """Show one sample."""
        when = sample.sent or sample.received
        plot = self._plots.get(sample.address)
        if plot is None:
            plot = self._plots[sample.address] = foxglove.Channel(
                f"/{sample.address}", schema=self._schema, message_encoding="cdr", context=self._context
            )
        if plot.has_sinks():
            payload = encode_cdr(downgrade(sample.message, CURRENT.name), layout=CURRENT.name)
            plot.log(payload, log_time=when)
        if sample.topic == _POSE_TOPIC:
            self._show_pose(sample.vehicle, sample.message, when)

    def close(self) -> None:
        """End the server; clients see the end of the connection."""
        self._server.stop()

    def __enter__(self) -> FoxgloveView:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _show_pose(self, name: str, message: VehicleLocalPosition, when: int) -> None:
        vehicle = self._vehicles.get(name)
        if vehicle is None:
            vehicle = self._vehicles[name] = _Vehicle(
                PoseInFrameChannel(f"/{name}/pose", context=self._context),
                LocationFixChannel(f"/{name}/location", context=self._context),
            )
        stamp = Timestamp(sec=when // 10**9, nsec=when % 10**9)
        if math.isfinite(message.x + message.y + message.z):
            east, north, up = ned_to_enu((message.x, message.y, message.z))
            yaw = yaw_ned_to_enu(message.heading)
            half = yaw / 2 if math.isfinite(yaw) else 0.0
            position = Vector3(x=east, y=north, z=up)
            orientation = Quaternion(x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))
            pose = Pose(position=position, orientation=orientation)
            vehicle.pose.log(PoseInFrame(timestamp=stamp, frame_id=f"{name}/local", pose=pose), log_time=when)
            transforms = [
                FrameTransform(
                    timestamp=stamp,
                    parent_frame_id=_MAP,
                    child_frame_id=f"{name}/local",
                    translation=self._place(vehicle, message),
                    rotation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
                ),
                FrameTransform(
                    timestamp=stamp,
                    parent_frame_id=f"{name}/local",
                    child_frame_id=name,
                    translation=position,
                    rotation=orientation,
                ),
            ]
            self._frames.log(FrameTransforms(transforms=transforms), log_time=when)
        place = to_global(message)
        if place and message.xy_valid:
            variance = message.eph**2 / 2
            known = math.isfinite(variance + message.epv)
            covariance = [variance, 0, 0, 0, variance, 0, 0, 0, message.epv**2] if known else []
            kinds = LocationFixPositionCovarianceType
            vehicle.location.log(
                LocationFix(
                    timestamp=stamp,
                    frame_id=name,
                    latitude=place.latitude,
                    longitude=place.longitude,
                    altitude=place.altitude,
                    position_covariance=covariance,
                    position_covariance_type=kinds.Approximated if known else kinds.Unknown,
                ),
                log_time=when,
            )

    def _place(self, vehicle: _Vehicle, message: VehicleLocalPosition) -> Vector3:
        """Return where the vehicle's local frame stands in the map."""
        origin = (message.ref_lat, message.ref_lon, message.ref_alt)
        if vehicle.place is not None and vehicle.origin == origin:
            return vehicle.place
        if not message.xy_global:
            return Vector3(x=0.0, y=0.0, z=0.0)
        if self._map is None:
            self._map = MapProjection(message.ref_lat, message.ref_lon)
        if math.isnan(self._map_altitude) and message.z_global:
            self._map_altitude = message.ref_alt
        north, east = self._map.project(message.ref_lat, message.ref_lon)
        height = message.ref_alt - self._map_altitude
        vehicle.origin = origin
        vehicle.place = Vector3(x=east, y=north, z=height if math.isfinite(height) else 0.0)
        return vehicle.place

    def _part_from_gone(self) -> None:
        """Close the channels of what is no longer there."""
        if not self._bus.connected:
            return  # nobody can be seen
        there = {address for addresses in self._bus.vehicles().values() for address in addresses}
        for address in self._plots.keys() - there:
            self._plots.pop(address).close()
        gone = self._vehicles.keys() - {address.vehicle for address in there if address.topic == _POSE_TOPIC}
        for name in gone:
            vehicle = self._vehicles.pop(name)
            vehicle.pose.close()
            vehicle.location.close()


def _require_free(host: str, port: int) -> None:
    """Raise ListenError unless the port can be listened on: the SDK tells no more than that something went wrong."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as exc:
        raise ListenError([f"ws://{host}:{port}"], (exc.strerror or str(exc)).lower(), hint=_HINT) from exc
