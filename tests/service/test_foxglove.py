"""Foxglove: a real WebSocket client that speaks its protocol shows live vehicles."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

import nedbus
from nedbus import Sample
from nedbus.bridges import FoxgloveServer
from nedbus_msgs import CURRENT, ROS2_TYPE, Address, MapProjection, decode_cdr, message_definition, to_global, upgrade
from tests.command_line import run_command
from tests.messages import VLP, message
from tests.ports import free_port
from tests.processes import Start
from tests.waits import DEADLINE, wait_for

X, Y, Z = LATITUDE, LONGITUDE, _ = b"\x09", b"\x11", b"\x19"  # before the doubles 1, 2 and 3 of a message of protobuf
ORIGIN = {"xy_global": True, "z_global": True, "ref_lat": 47.0, "ref_lon": 8.0, "ref_alt": 400.0}


class Client:
    """Do what the Foxglove app does: get the list of channels, subscribe, receive binary frames."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.channels: dict[int, dict[str, Any]] = {}
        self.data: dict[str, tuple[int, bytes]] = {}  # the newest time and payload of each topic
        self.info = self.receive()

    def receive(self, seconds: float = DEADLINE) -> dict[str, Any]:
        """Receive the next frame; return its JSON if it is not data."""
        frame = self._socket.recv(timeout=seconds)
        if isinstance(frame, str):
            content: dict[str, Any] = json.loads(frame)
            if content["op"] == "advertise":
                self.channels |= {channel["id"]: channel for channel in content["channels"]}
            elif content["op"] == "unadvertise":
                for number in content["channelIds"]:
                    del self.channels[number]
            return content
        if frame[0] == 1:
            number, when = struct.unpack_from("<IQ", frame, 1)
            self.data[self.channels[number]["topic"]] = when, frame[13:]
        return {}

    def receive_soon(self) -> None:
        """Receive the next frame if there is one."""
        with suppress(TimeoutError):
            self.receive(0.1)

    @property
    def topics(self) -> dict[str, int]:
        return {channel["topic"]: number for number, channel in self.channels.items()}

    def until(self, condition: Callable[[], object]) -> None:
        """Receive frames until a condition holds, each within the deadline."""
        while not condition():
            self.receive()

    def subscribe(self, *topics: str) -> None:
        numbers = [self.topics[topic] for topic in topics]
        subscriptions = [{"id": number, "channelId": number} for number in numbers]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))


@contextmanager
def connected(url: str) -> Iterator[Client]:
    protocols = [Subprotocol("foxglove.sdk.v1")]
    with connect(url, subprotocols=protocols, max_size=None, compression=None, proxy=None) as socket:
        yield Client(socket)


def test_vehicles_appear_and_every_field_can_be_plotted(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """Channels come with vehicles and go with them; a plot's data is the message, with its definition."""
    url = f"ws://127.0.0.1:{free_port()}"
    process = run_nedbus("foxglove", "-c", endpoint, "--port", url.rpartition(":")[2], measured=False)
    wait_for(lambda: f"open {url}" in process.err or process.popen.poll() is not None, what="the server")
    topic = "/7/estimator_local_position/1"
    sent = message(5, x=0.25, vxy_max=float("inf"))
    with connected(url) as client, bus.publisher("estimator_local_position", vehicle="7", instance=1) as publisher:
        assert client.info["op"] == "serverInfo"
        publisher.publish(sent)
        client.until(lambda: topic in client.topics)
        channel = client.channels[client.topics[topic]]
        assert (channel["encoding"], channel["schemaEncoding"], channel["schemaName"]) == ("cdr", "ros2msg", ROS2_TYPE)
        assert channel["schema"] == message_definition(CURRENT.name)
        client.subscribe(topic)
        while topic not in client.data:  # a subscription takes effect some time after it was sent
            publisher.publish(sent)
            client.receive_soon()
        when, payload = client.data[topic]
        assert upgrade(decode_cdr(payload, layout="1.16")) == sent
        assert when > 1_700_000_000_000_000_000
        publisher.close()
        client.until(lambda: topic not in client.topics)


def test_poses_and_locations(bus: nedbus.Bus) -> None:
    """ENU poses with their frames, and positions on the map, as protobuf of Foxglove's own schemas."""
    here = message(1, x=3.0, y=4.0, z=-5.0, heading=0.0, xy_valid=True, eph=1.0, epv=1.0, **ORIGIN)
    there = here.model_copy(update={"ref_lat": 47.001, "ref_alt": 410.0})
    with FoxgloveServer(bus, port=0) as server, connected(server.url) as client:
        for vehicle, each in (("1", here), ("2", there)):
            server.show(sample := Sample(each, Address(vehicle, VLP), received=1))
        names = {"/1/pose", "/1/location", "/2/pose", "/2/location", "/tf", f"/1/{VLP}"}
        client.until(lambda: names <= client.topics.keys())
        assert client.channels[client.topics["/tf"]]["schemaName"] == "foxglove.FrameTransforms"
        client.subscribe("/2/pose", "/2/location", "/tf")
        while client.data.keys() < {"/2/pose", "/2/location", "/tf"}:
            server.show(sample)
            client.receive_soon()
    position = to_global(there)
    assert position
    north, _ = MapProjection(47.0, 8.0).project(47.001, 8.0)
    for topic, coordinates in {
        "/2/location": {LATITUDE: position.latitude, LONGITUDE: position.longitude},
        "/2/pose": {X: 4.0, Y: 3.0, Z: 5.0},
        "/tf": {Y: north, Z: 10.0},
    }.items():
        for tag, value in coordinates.items():
            assert tag + struct.pack("<d", value) in client.data[topic][1]
    assert b"2/local" in client.data["/tf"][1]


def test_port_in_use_is_reported(bus: nedbus.Bus, endpoint: str) -> None:
    """Two servers cannot have one port."""
    with FoxgloveServer(bus, port=0) as server:
        ended = run_command("foxglove", "-c", endpoint, "--port", server.url.rpartition(":")[2])
    assert ended.exit_code == 1
    assert "address already in use): choose another port with --port" in ended.err
