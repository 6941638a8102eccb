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
    ned_to_enu,
    quaternion_ned_to_enu,
    to_global,
    yaw_ned_to_enu,
)

from . import FOXGLOVE_PORT

_ATTITUDE: Final = "vehicle_attitude"
_MAX_APART: Final = 500_000  # us between a position and the attitude paired with it
_NO_ROTATION: Final = messages.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)


class FoxgloveServer:
    """Serve the streams of a bus over Foxglove's WebSocket protocol; a context manager that stops the server on exit.

    Fields are encoded for channels with a subscriber. A slow client misses the oldest messages.

    Raises ListenError if the address is not available.
    """

    def __init__(self, bus: Bus, *, host: str = "127.0.0.1", port: int = FOXGLOVE_PORT) -> None:
        self._bus, self._newest = bus, Monitor()
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
            reason = str(exc).rpartition(": ")[2].partition(" (os error")[0].lower()
            raise ListenError(
                [f"ws://{host}:{port}"], reason, hint="choose another address with --http"
            ) from exc
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
        address, message = sample.address, sample.message
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
            channel.log(
                encode_with(definition, message.__dict__, definition.current),
                log_time=_time_of(sample),
            )
        elif not get_topic(address.topic).rate:
            self._unseen.add(address)  # it may never have another message

    def _log_position(self, sample: Sample[VehicleLocalPosition]) -> None:
        vehicle = sample.vehicle
        message = sample.message
        time_ns = _time_of(sample)
        if vehicle not in self._channels:
            pose = PoseInFrameChannel(f"/{vehicle}/pose", context=self._context)
            self._channels[vehicle] = (
                pose,
                LocationFixChannel(f"/{vehicle}/location", context=self._context),
            )
        poses, locations = self._channels[vehicle]
        stamp = messages.Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9)
        if math.isfinite(message.x + message.y + message.z):
            east, north, up = ned_to_enu((message.x, message.y, message.z))
            attitude = self._newest.get(Address(vehicle, _ATTITUDE))
            x, y, z, w = orientation_of(message, attitude.message if attitude else None)
            position = messages.Vector3(x=east, y=north, z=up)
            orientation = messages.Quaternion(x=x, y=y, z=z, w=w)
            local = f"{vehicle}/local"
            pose_in_local = messages.Pose(position=position, orientation=orientation)
            poses.log(
                messages.PoseInFrame(timestamp=stamp, frame_id=local, pose=pose_in_local),
                log_time=time_ns,
            )
            if message.xy_global:
                self._local_in_map[vehicle] = self._locate(vehicle, message)
            origin = self._local_in_map.get(vehicle, messages.Vector3(x=0.0, y=0.0, z=0.0))
            frames = (("map", local, origin, _NO_ROTATION), (local, vehicle, position, orientation))
            transforms = [
                messages.FrameTransform(
                    timestamp=stamp,
                    parent_frame_id=parent,
                    child_frame_id=child,
                    translation=moved,
                    rotation=turned,
                )
                for parent, child, moved, turned in frames
            ]
            self._transforms.log(messages.FrameTransforms(transforms=transforms), log_time=time_ns)
        fix = to_global(message)
        if fix and message.xy_valid:
            variance = message.eph**2 / 2
            is_known = math.isfinite(variance + message.epv)
            types = messages.LocationFixPositionCovarianceType
            location = messages.LocationFix(
                timestamp=stamp,
                frame_id=vehicle,
                latitude=fix.latitude,
                longitude=fix.longitude,
                altitude=fix.altitude,
                position_covariance=[variance, 0, 0, 0, variance, 0, 0, 0, message.epv**2]
                if is_known
                else [],
                position_covariance_type=types.Approximated if is_known else types.Unknown,
            )
            locations.log(location, log_time=time_ns)

    def _locate(self, vehicle: str, message: VehicleLocalPosition) -> messages.Vector3:
        """Return the translation from `map` to the local frame of a message with a global origin, in ENU [m]."""
        north, east = self._map.update(vehicle, message).project(message.ref_lat, message.ref_lon)
        up = message.ref_alt - self._map.altitude
        return messages.Vector3(x=east, y=north, z=up if math.isfinite(up) else 0.0)

    def _close_unpublished(self) -> None:
        published = self._bus.publishers()
        if not self._bus.connected:
            return  # without a link the list of vehicles is incomplete
        for address, definition in [
            stream for stream in self._fields if stream[0] not in published
        ]:
            self._fields.pop((address, definition)).close()
            self._unseen.discard(address)
            self._newest.forget(address)
        vehicles = {address.vehicle for address in published if address.topic == DEFAULT_TOPIC}
        for name in self._channels.keys() - vehicles:
            for channel in self._channels.pop(name):
                channel.close()
            self._local_in_map.pop(name, None)


def _time_of(sample: Sample[Any]) -> int:
    return sample.sent or sample.received


def orientation_of(
    message: VehicleLocalPosition, attitude: Any = None
) -> tuple[float, float, float, float]:
    """Return the rotation from FLU to ENU as (x, y, z, w).

    It comes from a VehicleAttitude within 0.5 s of the position, else from the heading; without either, FLU faces east.
    """
    if attitude is not None and abs(attitude.timestamp - message.timestamp) <= _MAX_APART:
        w, x, y, z = quaternion_ned_to_enu(attitude.q)
        if math.isfinite(w + x + y + z):
            return x, y, z, w
    yaw = yaw_ned_to_enu(message.heading)
    half = yaw / 2 if math.isfinite(yaw) else 0.0
    return 0.0, 0.0, math.sin(half), math.cos(half)
