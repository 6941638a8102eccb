"""Foxglove: a real WebSocket client that speaks its protocol shows live vehicles."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from typing import Any

import pytest
from websockets.sync.client import connect
from websockets.typing import Subprotocol

import nedbus
from nedbus.bridges import FoxgloveServer
from nedbus_msgs import (
    CURRENT,
    DEFAULT_TOPIC,
    ROS2_TYPE,
    MapProjection,
    decode_cdr,
    message_definition,
    to_global,
    upgrade,
)
from tests.conftest import DEADLINE, Process, Start, free_port, message, wait_for

VLP = DEFAULT_TOPIC
ORIGIN = {"xy_global": True, "z_global": True, "ref_lat": 47.0, "ref_lon": 8.0, "ref_alt": 400.0}


class Client:
    """Do what the Foxglove app does: get the list of channels, subscribe, receive binary frames."""

    def __init__(self, url: str) -> None:
        self._opened = ExitStack()
        self._socket = self._opened.enter_context(
            connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None, compression=None, proxy=None)
        )
        self.channels: dict[int, dict[str, Any]] = {}
        self.data: list[tuple[str, int, bytes]] = []
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
            self.data.append((self.channels[number]["topic"], when, frame[13:]))
        return {}

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

    def close(self) -> None:
        self._opened.close()


@pytest.fixture
def server(run_nedbus: Start, endpoint: str, start: Start) -> Iterator[tuple[Process, Client]]:
    """Run `nedbus foxglove`, and connect a client."""
    port = free_port()
    process = run_nedbus("foxglove", "-c", endpoint, "--port", str(port), measured=False)
    wait_for(lambda: "open ws://" in process.err or process.popen.poll() is not None, what=f"the server {process.err}")
    client = Client(f"ws://127.0.0.1:{port}")
    yield process, client
    client.close()


def test_vehicles_appear_and_every_field_can_be_plotted(server: tuple[Process, Client], bus: nedbus.Bus) -> None:
    """Channels come with vehicles and go with them; a plot's data is the message, with its definition."""
    _, client = server
    assert client.info["op"] == "serverInfo"
    publisher = bus.publisher("estimator_local_position", vehicle="7", instance=1)
    topic = "/7/estimator_local_position/1"
    sent = message(5, x=0.25, vxy_max=float("inf"))
    publisher.publish(sent)
    client.until(lambda: topic in client.topics)
    channel = client.channels[client.topics[topic]]
    assert (channel["encoding"], channel["schemaEncoding"], channel["schemaName"]) == ("cdr", "ros2msg", ROS2_TYPE)
    assert channel["schema"] == message_definition(CURRENT.name)
    client.subscribe(topic)

    while not client.data:
        publisher.publish(sent)
        with suppress(TimeoutError):  # a subscription takes effect some time after it was sent
            client.receive(0.2)
    _, when, payload = client.data[0]
    assert upgrade(decode_cdr(payload, layout="1.16")) == sent
    assert when > 1_700_000_000_000_000_000
    publisher.close()
    client.until(lambda: topic not in client.topics)


def test_poses_and_locations(endpoint: str, bus: nedbus.Bus) -> None:
    """ENU poses with their frames, and positions on the map, as protobuf of Foxglove's own schemas."""
    with FoxgloveServer(bus, port=0) as server:
        client = Client(server.url)
        with bus.subscribe(VLP, mode="every") as subscription:
            here = message(1, x=3.0, y=4.0, z=-5.0, heading=0.0, xy_valid=True, eph=1.0, epv=1.0, **ORIGIN)
            there = here.model_copy(update={"ref_lat": 47.001, "ref_alt": 410.0})
            bus.publisher(VLP, vehicle="1").publish(here)
            server.show(subscription.receive(DEADLINE))
            bus.publisher(VLP, vehicle="2").publish(there)
            sample = subscription.receive(DEADLINE)
            server.show(sample)
            names = {"/1/pose", "/1/location", "/2/pose", "/2/location", "/tf", f"/1/{VLP}"}
            client.until(lambda: names <= client.topics.keys())
            assert client.channels[client.topics["/tf"]]["schemaName"] == "foxglove.FrameTransforms"
            client.subscribe("/2/pose", "/2/location", "/tf")
            received: dict[str, bytes] = {}
            while received.keys() < {"/2/pose", "/2/location", "/tf"}:
                server.show(sample)
                with suppress(TimeoutError):
                    client.receive(0.2)
                received = {topic: payload for topic, _, payload in client.data}
        position = to_global(there)
        assert position
        for value in (position.latitude, position.longitude):
            assert struct.pack("<d", value) in received["/2/location"]
        for value in (4.0, 3.0, 5.0):
            assert struct.pack("<d", value) in received["/2/pose"]
        north, _ = MapProjection(47.0, 8.0).project(47.001, 8.0)
        assert struct.pack("<d", north) in received["/tf"]
        assert struct.pack("<d", 10.0) in received["/tf"]
        assert b"2/local" in received["/tf"]
        client.close()


def test_port_in_use_is_reported(server: tuple[Process, Client], run_nedbus: Start, endpoint: str) -> None:
    """Two servers cannot have one port."""
    process, _ = server
    port = process.err.split("127.0.0.1:")[1].split()[0]
    other = run_nedbus("foxglove", "-c", endpoint, "--port", port)
    assert other.wait() == 1
    assert "address already in use): choose another port with --port" in other.err
