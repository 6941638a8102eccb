"""ROS 2 over rmw_zenoh, in both directions, against an independent client: zenoh-ros2-sdk."""

from __future__ import annotations

import datetime as dt
import json
import signal
import threading
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import cast

import pytest
import zenoh

import nedbus
from nedbus.transport import Attachment, Session, TopicKey, gid_of_token, open_router, publisher_token
from nedbus_msgs import (
    DEFAULT_TOPIC,
    LAYOUTS,
    ROS2_TYPE,
    VehicleLocalPosition,
    dds_type,
    decode_cdr,
    downgrade,
    type_hash,
    upgrade,
)
from tests.conftest import DEADLINE, Process, Start, free_endpoint, message, wait_for, wait_for_reader
from tests.replays import open_replay

VLP = DEFAULT_TOPIC
PEER = str(Path(__file__).with_name("ros2_peer.py"))
COUNT = 200

Peer = Callable[..., Process]


def flight() -> list[VehicleLocalPosition]:
    """Return estimates of a flight: numbers of all kinds, NaN, infinities, resets."""
    messages = (each for each in open_replay("sim:?seed=3").messages if each.address.topic == VLP)
    return [upgrade(each.fields) for each in islice(messages, 0, 40 * COUNT, 40)]


def definition(layout: str) -> str:
    """Return the message definition as a .msg file of px4_msgs has it."""
    return "".join(f"{LAYOUTS[layout].type_of(name)} {name}\n" for name in LAYOUTS[layout].fields)


class WrongClock:
    """A session on a host whose clock is wrong by so many seconds."""

    def __init__(self, session: Session, ahead: float) -> None:
        self._session = session
        self._ahead = dt.timedelta(seconds=ahead)

    def new_timestamp(self) -> zenoh.Timestamp:
        stamp = self._session.new_timestamp()
        return zenoh.Timestamp(stamp.get_time() + self._ahead, bytes(stamp.get_id()))

    def __getattr__(self, name: str) -> object:
        return getattr(self._session, name)


@pytest.fixture
def peer(start: Start, endpoint: str, tmp_path: Path) -> Peer:
    """Start the other side: a role, a layout, and what the role needs."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")

    def start_peer(role: str, layout: str, **options: object) -> Process:
        given = {"definition": definition(layout), "router_ip": host, "router_port": int(port), **options}
        path = tmp_path / "peer.json"
        path.write_text(json.dumps(given))
        return start(PEER, role, str(path))

    return start_peer


def as_json(fields: dict[str, object]) -> str:
    """Return fields so that NaN equals NaN, and pairs are lists."""
    return json.dumps(fields, sort_keys=True)


@pytest.mark.parametrize("layout", ["1.14", "1.16"])
def test_ros_2_node_is_received(run_nedbus: Start, peer: Peer, endpoint: str, bus: nedbus.Bus, layout: str) -> None:
    """What a ROS 2 node publishes arrives field for field, with the layout found by its hash."""
    messages = flight()
    rows = [downgrade(each, layout) for each in messages]
    with bus.subscribe(mode="every") as subscription:
        run_nedbus("serve", "--connect", endpoint, "-s", "px4-zenoh:")
        peer("talk", layout, topic=f"/drone/{VLP}", rows=rows, domain_id=4)
        for row in rows:
            sample = subscription.receive(DEADLINE)
            assert sample.message == upgrade(row)
            assert (sample.vehicle, sample.topic, sample.source) == ("domain4-drone", VLP, "px4-zenoh")
        assert subscription.counts.lost == 0


@pytest.mark.parametrize("layout", ["1.14", "1.16"])
def test_ros_2_node_receives_and_lists(
    run_nedbus: Start, peer: Peer, endpoint: str, bus: nedbus.Bus, layout: str
) -> None:
    """What the bridge publishes arrives at a ROS 2 node field for field, and its topics are listed."""
    messages = flight()
    expected = [downgrade(each, layout) for each in messages]
    publisher = bus.publisher(VLP, vehicle="7")
    bus.publisher("estimator_local_position", vehicle="7", instance=1)
    bridge = run_nedbus("ros2", "-c", endpoint, "--layout", layout, "--domain", "3")
    topic = f"/px4_7/fmu/out/{VLP}"
    node = peer("listen", layout, topic=topic, rows=expected, domain_id=3)
    wait_for_reader(bus._session, f"3{topic}/{dds_type(ROS2_TYPE)}/{type_hash(layout)}")
    wait_for(lambda: f"-> {topic}" in bridge.err, what="the bridge")
    wait_for_reader(bus._session, f"nedbus/7/{VLP}")
    for each in messages:
        publisher.publish(each)
    assert node.wait() == 0, node.err
    *received, listed = [json.loads(line) for line in node.out.splitlines()]
    assert [as_json(row) for row in received] == [as_json(json.loads(json.dumps(row))) for row in expected]
    assert [topic, [ROS2_TYPE]] in listed
    assert ["/px4_7/fmu/out/estimator_local_position_1", [ROS2_TYPE]] in listed


def test_bridge_writes_what_px4_writes(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, raw: Session) -> None:
    """Key, payload and attachment are those of PX4's own module: its subscribers see no difference."""
    publisher = bus.publisher(VLP, vehicle="1")
    run_nedbus("ros2", "-c", endpoint)
    key = f"0/fmu/out/{VLP}/{dds_type(ROS2_TYPE)}/{type_hash('1.16')}"
    subscriber = raw.declare_subscriber(key, zenoh.handlers.FifoChannel(100))
    wait_for(lambda: list(raw.liveliness().get("@ros2_lv/0/*/*/*/MP/**")), what="the publisher's token")
    wait_for_reader(bus._session, f"nedbus/1/{VLP}")
    for timestamp in (1, 2):
        publisher.publish(message(timestamp))
    one, two = (subscriber.handler.recv() for _ in range(2))
    assert len(one.payload) == 220
    first, second = (Attachment.parse(sample.attachment.to_bytes()) for sample in (one, two) if sample.attachment)
    assert (first.sequence, second.sequence, first.gid == second.gid) == (1, 2, True)
    assert second.time > first.time > 1_700_000_000_000_000_000
    (token,) = [str(reply.ok.key_expr) for reply in raw.liveliness().get("@ros2_lv/0/*/*/*/MP/**") if reply.ok]
    assert first.gid == gid_of_token(token), "what `ros2 topic info -v` shows"
    nodes = [str(reply.ok.key_expr) for reply in raw.liveliness().get("@ros2_lv/0/*/*/*/NN/**") if reply.ok]
    assert len(nodes) == 1


@pytest.mark.parametrize("ahead", [-3600.0, -1.5, 3600.0])
def test_clocks_of_two_hosts_do_not_matter(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus, raw: Session, ahead: float
) -> None:
    """A vehicle whose clock is wrong reaches ROS 2 whole, and without a last value of another time.

    A real rclpy got 0 of 400 messages of a vehicle whose clock was 1.5 s behind.
    """
    with nedbus.connect(endpoint) as vehicle:
        publisher = vehicle.publisher(VLP, vehicle="1")
        publisher._session = cast("Session", WrongClock(publisher._session, ahead))
        publisher.publish(message(1))
        wait_for(bus.latest, what="the last value")
        key = f"0/fmu/out/{VLP}/{dds_type(ROS2_TYPE)}/{type_hash('1.16')}"
        subscriber = raw.declare_subscriber(key, zenoh.handlers.FifoChannel(1000))
        bridge = run_nedbus("ros2", "-c", endpoint)
        wait_for(lambda: "->" in bridge.err and "that were held back: 1" in bridge.err, what="both")
        wait_for_reader(vehicle._session, f"nedbus/1/{VLP}")
        for timestamp in range(2, 402):
            publisher.publish(message(timestamp))
        received = [subscriber.handler.recv() for _ in range(400)]
        times = [decode_cdr(each.payload.to_bytes(), layout="1.16")["timestamp"] for each in received]
        assert times == list(range(2, 402))


def test_recovered_messages_do_not_reach_ros_2(run_nedbus: Start, tmp_path: Path) -> None:
    """After an outage the bridge recovers what it missed, and says how much it held back of it: it is no estimate."""
    endpoint = free_endpoint()
    router = open_router(listen=(endpoint,))
    published: list[float] = []  # when each timestamp was, from 0 on
    stop = threading.Event()
    with nedbus.connect(endpoint) as vehicle, nedbus.connect(endpoint) as node:
        publisher = vehicle.publisher(VLP, vehicle="1")
        key = f"0/fmu/out/{VLP}/{dds_type(ROS2_TYPE)}/{type_hash('1.16')}"
        subscriber = node._session.declare_subscriber(key, zenoh.handlers.FifoChannel(100_000))
        bridge = run_nedbus("ros2", "-c", endpoint)
        received: list[int] = []

        def fly() -> None:
            while not stop.wait(0.01):
                publisher.publish(message(len(published)))
                published.append(time.monotonic())

        def has_received(timestamp: int) -> bool:
            while (sample := subscriber.handler.try_recv()) is not None:
                received.append(int(str(decode_cdr(sample.payload.to_bytes(), layout="1.16")["timestamp"])))
            return bool(received) and received[-1] >= timestamp

        flight = threading.Thread(target=fly)
        flight.start()
        wait_for(lambda: has_received(100), what="ROS 2 to receive")
        router.close()
        first = len(published)
        wait_for(lambda: len(published) > first + 300, what="the outage")
        router, back = open_router(listen=(endpoint,)), time.monotonic()
        wait_for(lambda: " s late: ROS 2 would use them as the current estimate" in bridge.err, what="the recovery")
        last = len(published)
        wait_for(lambda: has_received(last), what="what is current")
        stop.set()
        flight.join()
    router.close()
    missed = [timestamp for timestamp in range(first, last) if published[timestamp] < back - 1.1]
    assert len(missed) > 100
    assert not set(missed) & set(received)
    assert received == sorted(set(received))


@pytest.mark.parametrize(
    ("type_hash", "gid"),
    [
        (f"RIHS01_{'0123456789abcdef' * 4}", "6111f41e7e37c001654a5d5744a79f5d"),
        ("TypeHashNotSupported", "dc9fe97ae21781b5bf9db22103fda477"),
        (f"RIHS01_{'0123456789abcdef' * 4}/long/and/longer", "5f06fa6078c5c222f899e17f78d4257a"),
    ],
)
def test_gid_is_that_of_rmw_zenoh(type_hash: str, gid: str) -> None:
    """These were computed by rmw_zenoh's own code (simplified_xxhash3.cpp), for both of its paths."""
    key = TopicKey(0, f"fmu/out/{VLP}", "px4_msgs::msg::dds_::VehicleLocalPosition_", type_hash)
    token = publisher_token(key, "0123456789abcdef" * 2, "nedbus_4711", 1)
    assert gid_of_token(token).hex() == gid


def test_topic_of_another_node_is_left_to_it(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, raw: Session) -> None:
    """What a PX4 publishes itself is not published twice; the same topic in another layout is a translation."""
    key = TopicKey(0, f"fmu/out/{VLP}", dds_type(ROS2_TYPE), type_hash("1.14"))
    token = raw.liveliness().declare_token(publisher_token(key, "cafe", "px4_0001", 7))
    bus.publisher(VLP, vehicle="1")
    same = run_nedbus("ros2", "-c", endpoint, "--layout", "1.14")
    left = f"node px4_0001 publishes /fmu/out/{VLP} already: left to that node"
    wait_for(lambda: left in same.err, what="the warning")
    assert "->" not in same.err
    other = run_nedbus("ros2", "-c", endpoint, "--layout", "1.16")
    wait_for(lambda: f"-> /fmu/out/{VLP}" in other.err, what="the translation")
    token.undeclare()
    wait_for(lambda: f"-> /fmu/out/{VLP}" in same.err, what="the topic to be taken over")
    back = raw.liveliness().declare_token(publisher_token(key, "cafe", "px4_0001", 7))
    wait_for(lambda: same.err.count(left) == 2, what="the topic to be released")
    back.undeclare()


def test_topics_come_and_go_with_their_vehicles(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus, raw: Session
) -> None:
    """ROS 2 lists what is there now."""

    def topics() -> set[str]:
        tokens = [str(reply.ok.key_expr) for reply in raw.liveliness().get("@ros2_lv/0/*/*/*/MP/**") if reply.ok]
        return {token.split("/")[9] for token in tokens}

    run_nedbus("ros2", "-c", endpoint, "-v", "alpha-1", "--namespace", "alpha-1:fleet/a")
    publisher = bus.publisher(VLP, vehicle="alpha-1")
    bus.publisher(VLP, vehicle="beta")
    wait_for(lambda: topics() == {f"%fleet%a%fmu%out%{VLP}"}, what="the topic")
    publisher.close()
    wait_for(lambda: not topics(), what="the topic to go")


def test_loop_is_rejected(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """A service that listens to ROS 2 rejects what a bridge of its own network published to ROS 2."""
    publisher = bus.publisher(VLP, vehicle="1", source="sim")
    with bus.subscribe(mode="every") as subscription:
        service = run_nedbus("serve", "--connect", endpoint, "-s", "px4-zenoh:?vehicle=copy")
        bridge = run_nedbus("ros2", "-c", endpoint)
        wait_for(lambda: "->" in bridge.err and "listening" in service.err, what="both")
        timestamp = 0

        def is_rejected() -> bool:
            nonlocal timestamp
            timestamp += 1
            publisher.publish(message(timestamp))
            return "would loop" in service.err

        wait_for(is_rejected, what="the rejection")
        received = [subscription.receive(DEADLINE) for _ in range(timestamp)]
        assert {sample.vehicle for sample in received} == {"1"}
        assert list(bus.vehicles()) == ["1"]


def test_one_instance_for_humble(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, raw: Session) -> None:
    """One instance alone, on the keys of ROS 2 Humble, and two vehicles that would have one topic."""
    publishers = [bus.publisher("estimator_local_position", vehicle="a-b", instance=number) for number in (0, 1)]
    bus.publisher("estimator_local_position", vehicle="a_b", instance=0)
    key = f"0/a_b/fmu/out/estimator_local_position_0/{dds_type(ROS2_TYPE)}/TypeHashNotSupported"
    subscriber = raw.declare_subscriber(key, zenoh.handlers.FifoChannel(10))
    bridge = run_nedbus("ros2", "-c", endpoint, "--humble", "-t", "estimator_local_position", "-i", "0")
    wait_for(lambda: "set --namespace" in bridge.err, what="both")
    wait_for_reader(bus._session, "nedbus/a_b/estimator_local_position/0")
    for publisher in publishers:
        publisher.publish(message(7))
    assert len(subscriber.handler.recv().payload) == 220
    assert "estimator_local_position_1" not in bridge.err
    bridge.signal(signal.SIGTERM)
    assert bridge.wait() == 0


def test_router_that_hides_ros_2_is_named(run_nedbus: Start, tmp_path: Path) -> None:
    """A router whose access control has no rule for ROS 2 denies in silence: the bridge finds out, and ends."""
    endpoint, file = free_endpoint(), tmp_path / "router.json5"
    rules = [{"id": "no", "permission": "deny", "messages": ["liveliness_token"], "key_exprs": ["@ros2_lv/**"]}]
    policies = [{"rules": ["no"], "subjects": ["all"]}]
    access = {"enabled": True, "default_permission": "allow", "rules": rules, "policies": policies}
    file.write_text(json.dumps({"mode": "router", "access_control": {**access, "subjects": [{"id": "all"}]}}))
    session = open_router(listen=(endpoint,), config_file=file)
    bridge = run_nedbus("ros2", "-c", endpoint)
    assert bridge.wait() == 1
    assert "this router hides what nedbus announces to ROS 2" in bridge.err
    assert len(bridge.err.splitlines()) == 1
    session.close()


@pytest.mark.parametrize(
    ("arguments", "exit_code", "text"),
    [
        (["--to", "tcp/127.0.0.1:1"], 1, "nothing answers at tcp/127.0.0.1:1: start the router of ROS 2 there"),
        (["--layout", "1.12"], 2, "no layout '1.12': choose from 1.13, 1.14, 1.15, V0, 1.16"),
        (["--namespace", "1:7up"], 2, "namespace '7up' is not valid"),
        (["--namespace", "7up"], 2, "VEHICLE:NAMESPACE"),
    ],
)
def test_invalid_option_is_one_line(
    run_nedbus: Start, endpoint: str, arguments: list[str], exit_code: int, text: str
) -> None:
    """Exit 2 for an option that is invalid, 1 for a router of ROS 2 that does not answer; one line with the reason."""
    bridge = run_nedbus("ros2", "-c", endpoint, *arguments)
    assert bridge.wait() == exit_code
    assert text in bridge.err
    assert len(bridge.err.splitlines()) == 1
