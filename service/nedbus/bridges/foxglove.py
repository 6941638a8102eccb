"""Foxglove server for live vehicles: all fields for plots, poses and frames for 3D, positions for the Map panel.

    /<vehicle>/<topic>     px4_msgs/msg/..., every field
    /<vehicle>/pose        foxglove.PoseInFrame in ENU and FLU, from vehicle_local_position and vehicle_attitude
    /<vehicle>/location    foxglove.LocationFix, while the position is valid and has a global origin
    /tf                    foxglove.FrameTransforms: map -> <vehicle>/local -> <vehicle>

Vehicles with different origins share the frame `map`, whose origin is the first global origin that two messages have.
"""

from __future__ import annotations

import math
import threading
import time
from typing import Any, Final

import foxglove
from foxglove import messages
from foxglove.channels import FrameTransformsChannel, LocationFixChannel, PoseInFrameChannel

from nedbus import Bus, Sample
from nedbus.errors import ListenError
from nedbus.health import Monitor
from nedbus.timings import TIMINGS
from nedbus_msgs import (
    DEFAULT_TOPIC,
    Address,
    Definition,
    Selection,
    VehicleLocalPosition,
    definition_text,
    encode_with,
    get_topic,
    ros2_type,
)
from nedbus_msgs.frames import (
    CommonOrigin,
    GlobalPosition,
    ned_to_enu,
    quaternion_ned_to_enu,
    to_global,
    yaw_ned_to_enu,
)

from . import FOXGLOVE_PORT

_ATTITUDE: Final = "vehicle_attitude"
_PAIRED: Final = 500_000  # us between a position and an attitude that belong together
_NO_ROTATION: Final = messages.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)


class FoxgloveServer:
    """Serve the streams of a bus over Foxglove's WebSocket protocol; a context manager that stops the server on exit.

    Fields are encoded for channels with a subscriber. A slow client misses the oldest messages.

    Raises ListenError if the address is not available.
    """

    def __init__(self, bus: Bus, *, host: str = "127.0.0.1", port: int = FOXGLOVE_PORT) -> None:
        self._bus = bus
        self._newest = Monitor()
        self._context = foxglove.Context()
        self._fields: dict[tuple[Address, Definition[Any]], foxglove.Channel] = {}
        # streams without a rate, whose last message no client has received
        self._unseen: set[Address] = set()
        self._channels: dict[str, tuple[PoseInFrameChannel, LocationFixChannel]] = {}  # by vehicle
        self._map = CommonOrigin()
        # last known translation of each local frame
        self._local_in_map: dict[str, messages.Vector3] = {}
        try:
            self._server = foxglove.start_server(
                name="nedbus", host=host, port=port, context=self._context
            )
        except RuntimeError as exc:  # "...: Address already in use (os error 98)"
            _, _, text = str(exc).rpartition(": ")
            reason, _, _ = text.partition(" (os error")
            hint = "choose another address with --http"
            raise ListenError([f"ws://{host}:{port}"], reason.lower(), hint=hint) from exc
        self._transforms = FrameTransformsChannel("/tf", context=self._context)
        self.url = f"ws://{host}:{self._server.port}"

    def run(self, stop: threading.Event, *, selection: Selection | None = None) -> None:
        """Serve the selected addresses, by default all, until `stop` is set; raise ClosedError if the bus is closed."""
        of = selection or Selection()
        with self._bus.newest(
            *of.topics, vehicle=of.vehicles, instance=of.instance
        ) as self._newest:
            next_poll = time.monotonic() + TIMINGS.bridge_poll
            while not stop.is_set():
                if time.monotonic() >= next_poll:
                    self._close_unpublished()
                    for address in self._unseen & self._newest.keys():
                        self._log_fields(self._newest[address].sample)
                    next_poll = time.monotonic() + TIMINGS.bridge_poll
                for stream in self._newest.update(0.1):
                    self.log(stream.sample)

    def log(self, sample: Sample[Any]) -> None:
        """Log a sample to the channels of its address and of its vehicle."""
        self._log_fields(sample)
        if sample.topic == DEFAULT_TOPIC:
            self._log_position(sample)

    def __enter__(self) -> FoxgloveServer:
        return self

    def __exit__(self, *exc: object) -> None:
        self._server.stop()

    def _log_fields(self, sample: Sample[Any]) -> None:
        address = sample.address
        message = sample.message
        definition: Definition[Any] = message.DEFINITION
        channel = self._fields.get((address, definition))
        if channel is None:
            text = definition_text(definition, definition.current).encode()
            schema = foxglove.Schema(name=ros2_type(definition), encoding="ros2msg", data=text)
            channel = foxglove.Channel(
                f"/{address}", schema=schema, message_encoding="cdr", context=self._context
            )
            self._fields[address, definition] = channel
        if channel.has_sinks():
            self._unseen.discard(address)
            payload = encode_with(definition, message.__dict__, definition.current)
            channel.log(payload, log_time=_time_of(sample))
        elif not get_topic(address.topic).rate:
            self._unseen.add(address)  # it may never have another message

    def _log_position(self, sample: Sample[VehicleLocalPosition]) -> None:
        """Log pose, frames and location of a position, as far as it has them."""
        vehicle = sample.vehicle
        message = sample.message
        time_ns = _time_of(sample)
        if vehicle not in self._channels:
            pose = PoseInFrameChannel(f"/{vehicle}/pose", context=self._context)
            location = LocationFixChannel(f"/{vehicle}/location", context=self._context)
            self._channels[vehicle] = (pose, location)
        poses, locations = self._channels[vehicle]
        stamp = messages.Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9)
        if math.isfinite(message.x + message.y + message.z):
            position, orientation = self._pose_of(vehicle, message)
            pose_in_local = messages.Pose(position=position, orientation=orientation)
            frame = f"{vehicle}/local"
            pose_message = messages.PoseInFrame(timestamp=stamp, frame_id=frame, pose=pose_in_local)
            poses.log(pose_message, log_time=time_ns)
            if message.xy_global:
                self._local_in_map[vehicle] = self._locate(vehicle, message)
            transforms = self._transforms_of(vehicle, position, orientation, stamp)
            self._transforms.log(transforms, log_time=time_ns)
        fix = to_global(message)
        if fix and message.xy_valid:
            locations.log(_location_of(vehicle, message, fix, stamp), log_time=time_ns)

    def _pose_of(
        self, vehicle: str, message: VehicleLocalPosition
    ) -> tuple[messages.Vector3, messages.Quaternion]:
        """Return position and orientation in the local frame: FLU in ENU."""
        east, north, up = ned_to_enu((message.x, message.y, message.z))
        newest = self._newest.get(Address(vehicle, _ATTITUDE))
        attitude = None
        if newest:
            attitude = newest.message
        x, y, z, w = orientation_of(message, attitude)
        position = messages.Vector3(x=east, y=north, z=up)
        return position, messages.Quaternion(x=x, y=y, z=z, w=w)

    def _transforms_of(
        self,
        vehicle: str,
        position: messages.Vector3,
        orientation: messages.Quaternion,
        stamp: messages.Timestamp,
    ) -> messages.FrameTransforms:
        """Return the frames map -> <vehicle>/local -> <vehicle>."""
        local = f"{vehicle}/local"
        origin = self._local_in_map.get(vehicle, messages.Vector3(x=0.0, y=0.0, z=0.0))
        local_in_map = messages.FrameTransform(
            timestamp=stamp,
            parent_frame_id="map",
            child_frame_id=local,
            translation=origin,
            rotation=_NO_ROTATION,
        )
        vehicle_in_local = messages.FrameTransform(
            timestamp=stamp,
            parent_frame_id=local,
            child_frame_id=vehicle,
            translation=position,
            rotation=orientation,
        )
        return messages.FrameTransforms(transforms=[local_in_map, vehicle_in_local])

    def _locate(self, vehicle: str, message: VehicleLocalPosition) -> messages.Vector3:
        """Return the translation from `map` to the local frame of a message with a global origin, in ENU [m]."""
        north, east = self._map.update(vehicle, message).project(message.ref_lat, message.ref_lon)
        up = message.ref_alt - self._map.altitude
        if not math.isfinite(up):
            up = 0.0
        return messages.Vector3(x=east, y=north, z=up)

    def _close_unpublished(self) -> None:
        published = self._bus.publishers()
        if not self._bus.connected:
            return  # without a link the list of vehicles is incomplete
        for address, definition in list(self._fields):
            if address in published:
                continue
            self._fields.pop((address, definition)).close()
            self._unseen.discard(address)
            self._newest.forget(address)
        vehicles = {address.vehicle for address in published if address.topic == DEFAULT_TOPIC}
        for name in self._channels.keys() - vehicles:
            for channel in self._channels.pop(name):
                channel.close()
            self._local_in_map.pop(name, None)


def _location_of(
    vehicle: str, message: VehicleLocalPosition, fix: GlobalPosition, stamp: messages.Timestamp
) -> messages.LocationFix:
    """Return the location of a position, with its variance [m^2] if that is known."""
    variance = message.eph**2 / 2
    types = messages.LocationFixPositionCovarianceType
    covariance = list[float]()
    covariance_type = types.Unknown
    if math.isfinite(variance + message.epv):
        covariance = [variance, 0, 0, 0, variance, 0, 0, 0, message.epv**2]
        covariance_type = types.Approximated
    return messages.LocationFix(
        timestamp=stamp,
        frame_id=vehicle,
        latitude=fix.latitude,
        longitude=fix.longitude,
        altitude=fix.altitude,
        position_covariance=covariance,
        position_covariance_type=covariance_type,
    )


def _time_of(sample: Sample[Any]) -> int:
    return sample.sent or sample.received


def orientation_of(
    message: VehicleLocalPosition, attitude: Any = None
) -> tuple[float, float, float, float]:
    """Return the rotation from FLU to ENU as (x, y, z, w).

    It comes from a VehicleAttitude within 0.5 s of the position, else from the heading; without either, FLU faces east.
    """
    if attitude is not None and abs(attitude.timestamp - message.timestamp) <= _PAIRED:
        w, x, y, z = quaternion_ned_to_enu(attitude.q)
        if math.isfinite(w + x + y + z):
            return x, y, z, w
    yaw = yaw_ned_to_enu(message.heading)
    half = 0.0
    if math.isfinite(yaw):
        half = yaw / 2
    return 0.0, 0.0, math.sin(half), math.cos(half)
