"""Foxglove server, tested by a WebSocket client that implements the Foxglove protocol."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

import nedbus
from nedbus import Sample
from nedbus.bridges import FoxgloveServer
from nedbus.bridges.foxglove import orientation_of
from nedbus_msgs import Address
from nedbus_msgs.frames import MapProjection, to_global
from nedbus_msgs.messages.vehicle_attitude import VehicleAttitude
from tests.flights.local_position import CURRENT, ROS2_TYPE, decode_cdr, message_definition, upgrade
from tests.flights.messages import VLP, message
from tests.peers.command_line import run_command
from tests.peers.ports import free_port
from tests.peers.processes import Start
from tests.waits import DEADLINE, wait_for

# protobuf tags of the double fields 1, 2 and 3
X, Y, Z = LATITUDE, LONGITUDE, _ = b"\x09", b"\x11", b"\x19"
HALF = math.sqrt(0.5)
ORIGIN = {"xy_global": True, "z_global": True, "ref_lat": 47.0, "ref_lon": 8.0, "ref_alt": 400.0}


class Client:
    """A minimal Foxglove client: it receives the list of channels, subscribes, and receives binary frames."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.channels: dict[int, dict[str, Any]] = {}
        self.data: dict[str, tuple[int, bytes]] = {}  # newest time and payload of each topic
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
            elif content["op"] == "status" and "Unknown channel" in content["message"]:
                self._subscribe(
                    [int(content["message"].split()[-1])]
                )  # the SDK advertises a channel before it accepts subscriptions to it
            return content
        if frame[0] == 1:
            number, when = struct.unpack_from("<IQ", frame, 1)
            self.data[self.channels[number]["topic"]] = when, frame[13:]
        return {}

    def receive_soon(self) -> None:
        """Receive the next frame if it arrives within 0.1 s."""
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
        self._subscribe([self.topics[topic] for topic in topics])

    def _subscribe(self, numbers: Sequence[int]) -> None:
        subscriptions = [{"id": number, "channelId": number} for number in numbers]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))


@contextmanager
def connected(url: str) -> Iterator[Client]:
    protocols = [Subprotocol("foxglove.sdk.v1")]
    with connect(
        url, subprotocols=protocols, max_size=None, compression=None, proxy=None
    ) as socket:
        yield Client(socket)


@pytest.mark.slow
def test_channels_follow_vehicles_and_carry_every_field(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus
) -> None:
    """Channels appear and disappear with their vehicles; their data is the message in CDR, with its definition."""
    url = f"ws://127.0.0.1:{free_port()}"
    process = run_nedbus(
        "foxglove", "-c", endpoint, "--http", url.removeprefix("ws://"), coverage=False
    )
    wait_for(
        lambda: f"enter {url}" in process.err or process.popen.poll() is not None, what="the server"
    )
    topic = "/7/estimator_local_position/1"
    sent = message(5, x=0.25, vxy_max=float("inf"))
    with (
        connected(url) as client,
        bus.publisher("estimator_local_position", vehicle="7", instance=1) as publisher,
    ):
        assert client.info["op"] == "serverInfo"
        publisher.publish(sent)
        client.until(lambda: topic in client.topics)
        channel = client.channels[client.topics[topic]]
        assert (channel["encoding"], channel["schemaEncoding"], channel["schemaName"]) == (
            "cdr",
            "ros2msg",
            ROS2_TYPE,
        )
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


@pytest.mark.slow
def test_message_without_nominal_rate_reaches_the_first_subscriber(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus
) -> None:
    """A home position is sent only once, before its channel can have subscribers, so it is kept for the first one."""
    url = f"ws://127.0.0.1:{free_port()}"
    process = run_nedbus(
        "foxglove", "-c", endpoint, "--http", url.removeprefix("ws://"), coverage=False
    )
    wait_for(
        lambda: f"enter {url}" in process.err or process.popen.poll() is not None, what="the server"
    )
    topic = "/7/home_position"
    with connected(url) as client, bus.publisher("home_position", vehicle="7") as publisher:
        publisher.publish({"timestamp": 2_000_000, "alt": 488.0})
        client.until(lambda: topic in client.topics)
        client.subscribe(topic)
        client.until(lambda: topic in client.data)


@pytest.mark.parametrize("wild", [None, {"ref_lat": -33.0, "ref_lon": 151.0, "ref_alt": 9000.0}])
def test_poses_and_locations_are_published(bus: nedbus.Bus, wild: dict[str, float] | None) -> None:
    """Poses in ENU, frames and locations use Foxglove's protobuf schemas; one wild first origin does not count."""
    here = message(1, x=3.0, y=4.0, z=-5.0, heading=0.0, xy_valid=True, eph=1.0, epv=1.0, **ORIGIN)
    there = here.model_copy(update={"ref_lat": 47.001, "ref_alt": 410.0})
    with FoxgloveServer(bus, port=0) as server, connected(server.url) as client:
        wild_first = [("1", here.model_copy(update=wild))] if wild else []
        for vehicle, each in (*wild_first, ("1", here), ("2", there)):
            server.log(sample := Sample(each, Address(vehicle, VLP), received=1))
        names = {"/1/pose", "/1/location", "/2/pose", "/2/location", "/tf", f"/1/{VLP}"}
        client.until(lambda: names <= client.topics.keys())
        assert client.channels[client.topics["/tf"]]["schemaName"] == "foxglove.FrameTransforms"
        client.subscribe("/2/pose", "/2/location", "/tf")
        while client.data.keys() < {"/2/pose", "/2/location", "/tf"}:
            server.log(sample)
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


@pytest.mark.parametrize(
    ("q", "age", "heading", "forward", "left"),
    [
        ((1.0, 0.0, 0.0, 0.0), 0, math.nan, (0, 1, 0), (-1, 0, 0)),  # north, level
        ((HALF, 0.0, 0.0, HALF), 500_000, 0.0, (1, 0, 0), (0, 1, 0)),  # east
        ((-HALF, 0.0, 0.0, -HALF), -500_000, 0.0, (1, 0, 0), (0, 1, 0)),  # the same rotation
        ((HALF, 0.0, HALF, 0.0), 0, 0.0, (0, 0, 1), (-1, 0, 0)),  # north, and the nose up
        ((HALF, HALF, 0.0, 0.0), 0, 0.0, (0, 1, 0), (0, 0, 1)),  # north, and the right wing down
        # too old, so the heading is used
        ((HALF, HALF, 0.0, 0.0), 500_001, math.pi / 2, (1, 0, 0), (0, 1, 0)),
        ((math.nan,) * 4, 0, math.pi / 2, (1, 0, 0), (0, 1, 0)),
    ],
)
def test_orientation_falls_back_to_heading_without_recent_attitude(
    q: tuple[float, ...], age: int, heading: float, forward: tuple[int, ...], left: tuple[int, ...]
) -> None:
    """The orientation is the attitude q (FRD to NED) if it is within 0.5 s of the position, otherwise the heading."""
    attitude = VehicleAttitude.model_validate({"timestamp": 10_000_000 - age, "q": q})
    x, y, z, w = orientation_of(message(10_000_000, heading=heading), attitude)
    assert (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)) == pytest.approx(
        forward, abs=1e-6
    )
    assert (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)) == pytest.approx(
        left, abs=1e-6
    )


def test_pose_uses_attitude_of_its_own_vehicle(bus: nedbus.Bus) -> None:
    """A pose uses the newest vehicle_attitude of its own vehicle, not of another vehicle or the ground truth."""
    level, rolled = (
        VehicleAttitude(timestamp=1, q=q) for q in ((1.0, 0.0, 0.0, 0.0), (HALF, HALF, 0.0, 0.0))
    )
    with FoxgloveServer(bus, port=0) as server, connected(server.url) as client:
        for q in (level, rolled):
            server._newest.add(Sample(q, Address("1", "vehicle_attitude"), received=1))
        for other in (
            Address("2", "vehicle_attitude"),
            Address("1", "vehicle_attitude_groundtruth"),
        ):
            server._newest.add(Sample(level, other, received=1))
        sample = Sample(message(1, x=1.0, y=2.0, z=3.0), Address("1", VLP), received=1)
        server.log(sample)
        client.until(lambda: "/1/pose" in client.topics)
        client.subscribe("/1/pose")
        while "/1/pose" not in client.data:
            server.log(sample)
            client.receive_soon()
    x, y, z, _ = orientation_of(sample.message, rolled)
    assert (x, y, z) == pytest.approx((0.5, 0.5, 0.5))
    assert all(
        tag + struct.pack("<d", each) in client.data["/1/pose"][1]
        for tag, each in ((X, x), (Y, y), (Z, z))
    )


def test_port_in_use_is_reported(bus: nedbus.Bus, endpoint: str) -> None:
    """A port in use is an error with exit code 1 and a remedy."""
    with FoxgloveServer(bus, port=0) as server:
        ended = run_command("foxglove", "-c", endpoint, "--http", server.url.removeprefix("ws://"))
    assert ended.exit_code == 1
    assert "address already in use): choose another address with --http" in ended.err
