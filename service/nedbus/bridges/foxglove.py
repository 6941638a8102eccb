"""Foxglove server for live vehicles: all fields for plots, poses and frames for 3D, positions for the map panel.

    /<vehicle>/<topic>     px4_msgs/msg/..., every field
    /<vehicle>/pose        foxglove.PoseInFrame in ENU and FLU, from vehicle_local_position and vehicle_attitude
    /<vehicle>/location    foxglove.LocationFix, while the position is valid and has a global origin
    /tf                    foxglove.FrameTransforms: map -> <vehicle>/local -> <vehicle>

Vehicles with different origins share the frame `map`; its origin is the first global origin of any vehicle.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import Any, Final

import foxglove
from foxglove.channels import FrameTransformsChannel, LocationFixChannel, PoseInFrameChannel
from foxglove.messages import Quaternion, Vector3

from nedbus.client import Bus, Sample
from nedbus.errors import ListenError, NoDataError
from nedbus.timings import TIMINGS
from nedbus_msgs import (
    DEFAULT_TOPIC,
    Address,
    Definition,
    Message,
    Selection,
    VehicleLocalPosition,
    definition_text,
    encode_with,
    get_topic,
    ros2_type,
)

from . import FOXGLOVE_PORT
from .foxglove_messages import MapFrame, has_position, orientation_of, to_location, to_pose, to_transforms

_ATTITUDE: Final = "vehicle_attitude"


class FoxgloveServer:
    """Serve the streams of a bus over Foxglove's WebSocket protocol; a context manager that stops the server on exit.

    Fields are encoded only for channels with a subscriber. A slow client misses the oldest messages.

    Raises ListenError when it cannot listen on the address.
    """

    def __init__(self, bus: Bus, *, host: str = "127.0.0.1", port: int = FOXGLOVE_PORT) -> None:
        self._bus = bus
        self._context = foxglove.Context()
        self._fields: dict[tuple[Address, Definition[Any]], foxglove.Channel] = {}
        # The last message of each stream without a rate, until a client subscribes.
        self._unseen: dict[Address, tuple[Message, int]] = {}
        self._vehicles: dict[str, _Vehicle] = {}
        self._attitudes: dict[str, Any] = {}  # last message of each vehicle
        self._map = MapFrame()
        try:
            self._server = foxglove.start_server(name="nedbus", host=host, port=port, context=self._context)
        except RuntimeError as exc:  # "...: Address already in use (os error 98)"
            reason = str(exc).rpartition(": ")[2].partition(" (os error")[0].lower()
            raise ListenError([f"ws://{host}:{port}"], reason, hint="choose another address with --http") from exc
        self._transforms = FrameTransformsChannel("/tf", context=self._context)
        self.url = f"ws://{host}:{self._server.port}"

    def run(self, stop: threading.Event, *, selection: Selection | None = None) -> None:
        """Serve the selected addresses, by default all, until `stop` is set.

        Raises ClosedError when the bus is closed meanwhile.
        """
        with self._bus.subscribe_to(selection or Selection()) as subscription:
            next_poll = time.monotonic() + TIMINGS.bridge_poll
            while not stop.is_set():
                if time.monotonic() >= next_poll:
                    self._close_unpublished()
                    for address, (message, time_ns) in list(self._unseen.items()):
                        self._show_fields(address, message, time_ns)
                    next_poll = time.monotonic() + TIMINGS.bridge_poll
                try:
                    self.show(subscription.receive(0.1))
                except NoDataError:
                    continue

    def show(self, sample: Sample[Any]) -> None:
        """Log one sample to the channels of its address and its vehicle."""
        time_ns = sample.sent or sample.received
        self._show_fields(sample.address, sample.message, time_ns)
        if sample.topic == _ATTITUDE:
            self._attitudes[sample.vehicle] = sample.message
        if sample.topic == DEFAULT_TOPIC:
            self._show_position(sample.vehicle, sample.message, time_ns)

    def close(self) -> None:
        """Stop the server and disconnect its clients."""
        self._server.stop()

    def __enter__(self) -> FoxgloveServer:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _show_fields(self, address: Address, message: Message, time_ns: int) -> None:
        definition = message.DEFINITION
        channel = self._fields.get((address, definition))
        if channel is None:
            text = definition_text(definition, definition.current).encode()
            schema = foxglove.Schema(name=ros2_type(definition), encoding="ros2msg", data=text)
            channel = foxglove.Channel(f"/{address}", schema=schema, message_encoding="cdr", context=self._context)
            self._fields[address, definition] = channel
        if channel.has_sinks():
            self._unseen.pop(address, None)
            channel.log(encode_with(definition, message.__dict__, definition.current), log_time=time_ns)
        elif not get_topic(address.topic).rate:
            self._unseen[address] = message, time_ns  # there may be no further message

    def _show_position(self, vehicle: str, message: VehicleLocalPosition, time_ns: int) -> None:
        shown = self._vehicles.get(vehicle)
        if shown is None:
            pose = PoseInFrameChannel(f"/{vehicle}/pose", context=self._context)
            location = LocationFixChannel(f"/{vehicle}/location", context=self._context)
            shown = self._vehicles[vehicle] = _Vehicle(pose, location)
        if has_position(message):
            x, y, z, w = orientation_of(message, self._attitudes.get(vehicle))
            orientation = Quaternion(x=x, y=y, z=z, w=w)
            shown.pose.log(to_pose(vehicle, message, orientation, time_ns=time_ns), log_time=time_ns)
            local = shown.local_in_map = self._map.locate(message) or shown.local_in_map
            transforms = to_transforms(vehicle, message, orientation, local_in_map=local, time_ns=time_ns)
            self._transforms.log(transforms, log_time=time_ns)
        fix = to_location(vehicle, message, time_ns=time_ns)
        if fix is not None:
            shown.location.log(fix, log_time=time_ns)

    def _close_unpublished(self) -> None:
        """Close the channels of addresses that are no longer published."""
        published = {address for addresses in self._bus.vehicles().values() for address in addresses}
        if not self._bus.connected:
            return  # without a link the reply is incomplete
        for address, definition in [stream for stream in self._fields if stream[0] not in published]:
            self._fields.pop((address, definition)).close()
            self._unseen.pop(address, None)
            if address.topic == _ATTITUDE:
                self._attitudes.pop(address.vehicle, None)
        vehicles = {address.vehicle for address in published if address.topic == DEFAULT_TOPIC}
        for name in self._vehicles.keys() - vehicles:
            vehicle = self._vehicles.pop(name)
            vehicle.pose.close()
            vehicle.location.close()


@dataclass(slots=True)
class _Vehicle:
    """Channels of a vehicle, and the last known translation of its local frame in the map."""

    pose: PoseInFrameChannel
    location: LocationFixChannel
    local_in_map: Vector3 = field(default_factory=lambda: Vector3(x=0.0, y=0.0, z=0.0))
