"""ROS 2 over rmw_zenoh in both directions, against an independent client, zenoh-ros2-sdk."""

from __future__ import annotations

import datetime as dt
import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, closing
from itertools import count, islice
from pathlib import Path
from typing import Any

import pytest
import zenoh

import nedbus
from nedbus import limits
from nedbus.bridges import Ros2Bridge
from nedbus.errors import NedbusError
from nedbus.timings import Timings
from nedbus.transport import Attachment, Session, TopicKey, gid_of_token, open_client, open_router
from nedbus_msgs import (
    ANY,
    BY_TOPIC,
    Address,
    Selection,
    VehicleLocalPosition,
    dds_type,
    define,
    field_type,
    split_ros2_topic,
    upgrade_with,
)
from tests.flights.local_position import (
    LAYOUTS,
    ROS2_TYPE,
    decode_cdr,
    downgrade,
    encode,
    type_hash,
    upgrade,
)
from tests.flights.messages import VLP, message
from tests.flights.replays import open_replay
from tests.flights.ulogs import LOGS
from tests.peers.live_source import Listener
from tests.peers.ports import free_endpoint
from tests.peers.processes import Process, Start
from tests.waits import DEADLINE, repeating, wait_for, wait_for_matching

PEER = str(Path(__file__).with_name("ros2_peer.py"))
KEY = f"0/fmu/out/{VLP}/{dds_type(ROS2_TYPE)}/{type_hash('1.16')}"

TWELVE_MESSAGES = LOGS.parent / "px4" / "twelve_messages.ulg"

Peer = Callable[..., Process]
RunBridge = Callable[..., None]


def flight() -> list[VehicleLocalPosition]:
    """Return estimates of a simulated flight, with NaN, infinities and a reset."""
    messages = (
        each
        for each in open_replay("sim:?seed=3&duration=20").messages
        if each.address.topic == VLP
    )
    return [upgrade(each.fields) for each in islice(messages, 0, None, 20)]


def definition(layout: str) -> str:
    """Return the .msg definition of px4_msgs for a layout."""
    return "".join(f"{LAYOUTS[layout].types[name]!s} {name}\n" for name in LAYOUTS[layout].fields)


@pytest.fixture
def run_bridge(
    endpoint: str, timings: Timings, caplog: pytest.LogCaptureFixture
) -> Iterator[RunBridge]:
    """Run bridges that poll 20 times per second, each in a thread with its own bus."""
    caplog.set_level("INFO")
    timings.bridge_poll = 0.05
    stop = threading.Event()
    with ExitStack() as closing, ThreadPoolExecutor() as threads:

        def run_bridge(**options: Any) -> None:
            bus = closing.enter_context(nedbus.connect(endpoint))
            session = closing.enter_context(plain_session(endpoint))
            bridges.append(threads.submit(Ros2Bridge(bus, session, **options).run, stop))

        bridges: list[Future[None]] = []
        yield run_bridge
        stop.set()
        for each in bridges:
            each.result(DEADLINE)


def plain_session(endpoint: str) -> AbstractContextManager[Session]:
    return closing(open_client((endpoint,), timeout=DEADLINE))


def tokens(zenoh_session: Session, kind: str) -> list[str]:
    """Return the ROS 2 liveliness tokens of a kind in domain 0: NN of nodes, MP of publishers."""
    return [
        str(reply.ok.key_expr)
        for reply in zenoh_session.liveliness().get(f"@ros2_lv/0/*/*/*/{kind}/**")
        if reply.ok
    ]


@pytest.fixture
def peer(start: Start, endpoint: str, tmp_path: Path) -> Peer:
    """Start the ROS 2 node of ros2_peer.py in a role, with a layout and the options of the role."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")

    def start_peer(role: str, layout: str, **options: object) -> Process:
        given = {
            "definition": definition(layout),
            "router_ip": host,
            "router_port": int(port),
            **options,
        }
        path = tmp_path / "peer.json"
        path.write_text(json.dumps(given))
        return start(PEER, role, str(path))

    return start_peer


def as_json(fields: dict[str, object]) -> str:
    """Return fields as JSON, so that NaN equals NaN."""
    return json.dumps(fields, sort_keys=True)


@pytest.mark.slow
def test_message_of_a_ros2_node_is_received(
    run_nedbus: Start, peer: Peer, endpoint: str, bus: nedbus.Bus
) -> None:
    """All fields of the messages of a ROS 2 node are received; the layout is found by its type hash."""
    rows = [downgrade(each, "1.14") for each in flight()]
    with bus.subscribe(mode="every") as subscription:
        run_nedbus("serve", "--connect", endpoint, "-s", "px4-zenoh:")
        peer("talk", "1.14", topic=f"/drone/{VLP}", rows=rows, domain_id=4)
        for row in rows:
            sample = subscription.receive(DEADLINE)
            assert sample.message == upgrade(row)
            assert (sample.vehicle, sample.topic, sample.source) == (
                "domain4-drone",
                VLP,
                "px4-zenoh",
            )
        assert subscription.counts.lost == 0


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["1.14", "1.16"])
def test_ros2_node_receives_messages_and_lists_topics(
    run_bridge: RunBridge, peer: Peer, zenoh_session: Session, bus: nedbus.Bus, layout: str
) -> None:
    """A ROS 2 node receives all fields of the messages that the bridge publishes, and lists their topics."""
    messages = flight()
    expected = [downgrade(each, layout) for each in messages]
    publisher = bus.publisher(VLP, vehicle="7")
    bus.publisher("estimator_local_position", vehicle="7", instance=1)
    topic = f"/px4_7/fmu/out/{VLP}"
    node = peer("listen", layout, topic=topic, rows=expected, domain_id=3)
    wait_for_matching(zenoh_session, f"3{topic}/{dds_type(ROS2_TYPE)}/{type_hash(layout)}")
    run_bridge(layout=layout, domain=3)
    wait_for(
        lambda: len(list(zenoh_session.liveliness().get("@ros2_lv/3/*/*/*/MP/**"))) == 2,
        what="the bridge",
    )
    wait_for_matching(zenoh_session, f"nedbus/7/{VLP}")
    for each in messages:
        publisher.publish(each)
    assert node.wait() == 0, node.err
    *received, listed = [json.loads(line) for line in node.out.splitlines()]
    assert [as_json(row) for row in received] == [
        as_json(json.loads(json.dumps(row))) for row in expected
    ]
    assert [topic, [ROS2_TYPE]] in listed
    assert ["/px4_7/fmu/out/estimator_local_position_1", [ROS2_TYPE]] in listed


def test_bridge_publishes_like_px4(
    run_bridge: RunBridge, bus: nedbus.Bus, zenoh_session: Session
) -> None:
    """Key, payload, attachment and liveliness tokens have the format of PX4's Zenoh module."""
    publisher = bus.publisher(VLP, vehicle="1")
    run_bridge()
    subscriber = zenoh_session.declare_subscriber(KEY, zenoh.handlers.FifoChannel(100))
    wait_for(lambda: tokens(zenoh_session, "MP"), what="the publisher's token")
    wait_for_matching(zenoh_session, f"nedbus/1/{VLP}")
    for timestamp in (1, 2):
        publisher.publish(message(timestamp))
    one, two = (subscriber.handler.recv() for _ in range(2))
    assert len(one.payload) == 220
    first, second = (
        Attachment.parse(sample.attachment.to_bytes()) for sample in (one, two) if sample.attachment
    )
    assert (first.sequence, second.sequence, first.gid == second.gid) == (1, 2, True)
    assert second.time > first.time > 1_700_000_000_000_000_000
    (token,) = tokens(zenoh_session, "MP")
    assert first.gid == gid_of_token(token), "the gid that `ros2 topic info -v` shows"
    assert len(tokens(zenoh_session, "NN")) == 1


@pytest.mark.slow
@pytest.mark.logs
@pytest.mark.skipif(not TWELVE_MESSAGES.exists(), reason=f"no PX4 log at {TWELVE_MESSAGES}")
@pytest.mark.parametrize("release", ["1.13", "1.15", "main"])
def test_messages_have_the_layout_of_the_release(
    run_bridge: RunBridge,
    bus: nedbus.Bus,
    zenoh_session: Session,
    caplog: pytest.LogCaptureFixture,
    release: str,
) -> None:
    """Key, type hash and CDR fields of every topic in a real log match the selected release.

    Messages that the release lacks are logged once. The last message of streams without a nominal rate is published.
    """
    last = {each.address: each.fields for each in open_replay(f"ulog:{TWELVE_MESSAGES}").messages}
    messages = {each: upgrade_with(BY_TOPIC[each.topic], fields) for each, fields in last.items()}
    publishers = [
        bus.publisher(each.topic, vehicle=each.vehicle, instance=each.instance) for each in messages
    ]
    for publisher, each in zip(publishers, messages.values(), strict=True):
        publisher.publish(each)
    wait_for(lambda: len(bus.latest(ANY)) == len(messages), what="the last values")
    subscriber = zenoh_session.declare_subscriber("0/fmu/out/**", zenoh.handlers.FifoChannel(1000))
    run_bridge(layout=release)
    missing = {each for each in messages if BY_TOPIC[each.topic].layout_of_release(release) is None}
    wait_for(
        lambda: len(tokens(zenoh_session, "MP")) == len(messages) - len(missing), what="the bridge"
    )
    received = {str(subscriber.handler.recv().key_expr).split("/")[3] for _ in range(2)}
    assert received == {"home_position", "log_message"}
    for publisher, each in zip(publishers, messages.values(), strict=True):
        wait_for_matching(zenoh_session, publisher.key)
        publisher.publish(each)
    for _ in range(len(messages) - len(missing)):
        sample = subscriber.handler.recv()
        key = TopicKey.parse(str(sample.key_expr))
        _, topic, instance = split_ros2_topic(key.topic)
        sent = messages[Address("1", topic, instance)]
        assert key.dds_type == dds_type(f"px4_msgs/msg/{type(sent).__name__}")
        fields = decode_cdr(sample.payload.to_bytes(), layout=key.type_hash)
        layout = BY_TOPIC[topic].layout_of_release(release)
        assert layout is not None
        assert repr(fields) == repr(BY_TOPIC[topic].downgrade(sent.__dict__, layout))
        received.add(key.topic.rpartition("/")[2])
    assert {
        "battery_status",
        "sensor_gps",
        "estimator_status_flags",
        "estimator_status_flags_1",
    } <= received
    assert len(received) == len(messages) - len(missing)
    for address in missing:
        assert (
            caplog.text.count(
                f"{address} is not published to ROS 2: PX4 {release} has no such message"
            )
            == 1
        )


def test_first_home_position_of_a_new_vehicle_is_bridged(
    run_bridge: RunBridge, bus: nedbus.Bus, zenoh_session: Session, caplog: pytest.LogCaptureFixture
) -> None:
    """A home position sent before the bridge knows its address is published; unselected addresses are not logged."""
    subscriber = zenoh_session.declare_subscriber("0/**", zenoh.handlers.FifoChannel(1000))
    run_bridge(selection=Selection(ANY, "1"))
    wait_for_matching(zenoh_session, "nedbus/1/home_position")
    wheel = define("Wheel", [("timestamp", field_type("uint64"))])
    other = bus._publishers.publisher(Address("2", "wheel_encoders"), wheel)
    other.publish({"timestamp": 1})
    bus.publisher("home_position", vehicle="1").publish({"timestamp": 2_000_000, "alt": 488.0})
    key = TopicKey.parse(str(subscriber.handler.recv().key_expr))
    assert key.topic == "fmu/out/home_position"
    assert "wheel_encoders" not in caplog.text


def test_number_of_held_messages_is_bounded(
    bus: nedbus.Bus, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beyond the limit the oldest held message is dropped; a newer one of the same stream replaces it."""
    monkeypatch.setattr(limits, "BRIDGED_STREAMS", 2)
    bridge = Ros2Bridge(bus, zenoh_session)
    for timestamp, vehicle in enumerate("1223"):
        home = nedbus.HomePosition(timestamp=timestamp)
        bridge._hold(nedbus.Sample(home, Address(vehicle, "home_position"), received=0))
    held = {address.vehicle: each.message.timestamp for address, each in bridge._held.items()}
    assert held == {"2": 2, "3": 3}


def test_retained_message_is_not_bridged(
    run_bridge: RunBridge, bus: nedbus.Bus, zenoh_session: Session, caplog: pytest.LogCaptureFixture
) -> None:
    """A message from before the bridge started is held back; every later one is published."""
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    wait_for(bus.latest, what="the last value")
    subscriber = zenoh_session.declare_subscriber(KEY, zenoh.handlers.FifoChannel(1000))
    run_bridge()
    wait_for(
        lambda: "->" in caplog.text and "held back 1 old message" in caplog.text,
        what="the topic and the report",
    )
    wait_for_matching(zenoh_session, f"nedbus/1/{VLP}")
    for timestamp in range(2, 402):
        publisher.publish(message(timestamp))
    received = [subscriber.handler.recv() for _ in range(400)]
    times = [decode_cdr(each.payload.to_bytes(), layout="1.16")["timestamp"] for each in received]
    assert times == list(range(2, 402))


def test_late_messages_of_a_returning_vehicle_are_held_back(
    run_bridge: RunBridge,
    zenoh_session: Session,
    timings: Timings,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Messages recovered after a vehicle was briefly gone, as in a router restart, are held back."""
    timings.lateness = 0.2
    address = Address("1", VLP)
    subscriber = zenoh_session.declare_subscriber(KEY, zenoh.handlers.FifoChannel(10))

    def put(timestamp: int, sent: dt.datetime) -> None:
        stamp = zenoh.Timestamp(sent, bytes(zenoh_session.new_timestamp().get_id()))
        zenoh_session.put(address.key(), encode(message(timestamp)), timestamp=stamp)

    token = zenoh_session.liveliness().declare_token(address.alive_key("1a"))
    run_bridge()
    wait_for(lambda: caplog.text.count("-> /fmu/out/") == 1, what="the bridge")
    first = zenoh_session.new_timestamp().get_time()
    put(1, first)
    assert subscriber.handler.recv().payload
    token.undeclare()
    wait_for(lambda: "is no longer on the bus" in caplog.text, what="the vehicle to go")
    token = zenoh_session.liveliness().declare_token(address.alive_key("1a"))
    wait_for(lambda: caplog.text.count("-> /fmu/out/") == 2, what="the vehicle to be back")
    late = first + dt.timedelta(milliseconds=1)
    wait_for(
        lambda: zenoh_session.new_timestamp().get_time() - late > dt.timedelta(seconds=0.2),
        what="the timestamp to be late",
    )
    put(2, late)
    wait_for(lambda: f"held back 1 old message of 1/{VLP}, up to" in caplog.text, what="the report")
    current = count(3)
    with repeating(
        lambda: put(next(current), zenoh_session.new_timestamp().get_time())
    ):  # on a busy host some are late
        assert (
            decode_cdr(subscriber.handler.recv().payload.to_bytes(), layout="1.16")["timestamp"]
            != 2
        )
    token.undeclare()


@pytest.mark.slow  # an outage of some seconds; test_late_filter.py tests the decisions
def test_recovered_messages_are_not_bridged(run_nedbus: Start, tmp_path: Path) -> None:
    """After an outage the bridge holds back the late messages that it recovers, and logs their number."""
    endpoint = free_endpoint()
    router = open_router(listen=(endpoint,))
    published: list[float] = []  # publish time of each timestamp, from 0 on
    stop = threading.Event()
    with nedbus.connect(endpoint) as vehicle, plain_session(endpoint) as node:
        publisher = vehicle.publisher(VLP, vehicle="1")
        subscriber = node.declare_subscriber(KEY, zenoh.handlers.FifoChannel(100_000))
        bridge = run_nedbus("ros2", "-c", endpoint)
        received: list[int] = []

        def fly() -> None:
            while not stop.wait(0.01):
                publisher.publish(message(len(published)))
                published.append(time.monotonic())

        def has_received(timestamp: int) -> bool:
            while (sample := subscriber.handler.try_recv()) is not None:
                received.append(
                    int(str(decode_cdr(sample.payload.to_bytes(), layout="1.16")["timestamp"]))
                )
            return bool(received) and received[-1] >= timestamp

        with ThreadPoolExecutor() as threads, ExitStack() as landing:
            flight = threads.submit(fly)
            landing.callback(stop.set)
            wait_for(lambda: has_received(100), what="ROS 2 to receive")
            router.close()
            first = len(published)
            wait_for(lambda: len(published) > first + 300, what="the outage")
            router, back = open_router(listen=(endpoint,)), time.monotonic()
            wait_for(
                lambda: " s late; ROS 2 nodes would treat old messages as" in bridge.err,
                what="the recovery",
            )
            last = len(published)
            wait_for(lambda: has_received(last), what="a current message")
        flight.result()
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
def test_gid_matches_rmw_zenoh(type_hash: str, gid: str) -> None:
    """The gid equals the one computed by rmw_zenoh (simplified_xxhash3.cpp), for short and long inputs."""
    key = TopicKey(0, f"fmu/out/{VLP}", "px4_msgs::msg::dds_::VehicleLocalPosition_", type_hash)
    token = key.token("MP", "0123456789abcdef" * 2, "nedbus_4711", 1)
    assert gid_of_token(token).hex() == gid


def test_topic_of_another_node_is_not_published_twice(
    run_bridge: RunBridge,
    bus: nedbus.Bus,
    zenoh_session: Session,
    timings: Timings,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """If PX4 already publishes a topic to ROS 2, the bridge publishes it only in another layout, until PX4 stops."""
    timings.take_over = 0.1
    key = TopicKey(0, f"fmu/out/{VLP}", dds_type(ROS2_TYPE), type_hash("1.14"))
    token = zenoh_session.liveliness().declare_token(key.token("MP", "cafe", "px4_0001", 7))
    bus.publisher(VLP, vehicle="1")
    refused, published = (
        f"because node px4_0001 already publishes /fmu/out/{VLP}",
        f"-> /fmu/out/{VLP}, ",
    )
    run_bridge(layout="1.14")
    wait_for(lambda: refused in caplog.text, what="the warning")
    assert published not in caplog.text
    run_bridge(layout="1.16")
    wait_for(lambda: published in caplog.text, what="the translation")
    token.undeclare()
    wait_for(lambda: caplog.text.count(published) == 2, what="the topic to be taken over")
    back = zenoh_session.liveliness().declare_token(key.token("MP", "cafe", "px4_0001", 7))
    wait_for(lambda: caplog.text.count(refused) == 2, what="the topic to be released")
    back.undeclare()


def test_ros2_topic_is_listed_only_while_its_publisher_exists(
    run_bridge: RunBridge, bus: nedbus.Bus, zenoh_session: Session
) -> None:
    """ROS 2 lists a topic only while the vehicle's publisher exists."""

    def topics() -> set[str]:
        return {token.split("/")[9] for token in tokens(zenoh_session, "MP")}

    run_bridge(selection=Selection(ANY, vehicle="alpha-1"), namespaces={"alpha-1": "fleet/a"})
    publisher = bus.publisher(VLP, vehicle="alpha-1")
    bus.publisher(VLP, vehicle="beta")
    wait_for(lambda: topics() == {f"%fleet%a%fmu%out%{VLP}"}, what="the topic")
    publisher.close()
    wait_for(lambda: not topics(), what="the topic to go")


def test_bridge_loop_is_ignored(
    run_bridge: RunBridge, endpoint: str, bus: nedbus.Bus, caplog: pytest.LogCaptureFixture
) -> None:
    """A source that receives from ROS 2 ignores messages that a bridge of the same bus published."""
    publisher = bus.publisher(VLP, vehicle="1", source="sim")
    run_bridge()
    with Listener("px4-zenoh:?vehicle=copy", routers=(endpoint,)) as listener:
        timestamps = count(1)

        def is_rejected() -> bool:
            publisher.publish(message(next(timestamps)))
            return "ignored to avoid a loop" in caplog.text

        listener.step_until(is_rejected, what="the rejection")
        assert (listener.messages, listener.rejections) == ([], [])


@pytest.mark.slow
def test_command_bridges_one_instance_for_humble(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus, zenoh_session: Session
) -> None:
    """`nedbus ros2` bridges one instance to another domain with the keys of Humble, and reports a topic conflict."""
    publishers = [
        bus.publisher("estimator_local_position", vehicle="a-b", instance=number)
        for number in (0, 1)
    ]
    bus.publisher("estimator_local_position", vehicle="a_b", instance=0)
    key = f"3/a_b/fmu/out/estimator_local_position_0/{dds_type(ROS2_TYPE)}/TypeHashNotSupported"
    subscriber = zenoh_session.declare_subscriber(key, zenoh.handlers.FifoChannel(10))
    options = (
        "--humble",
        "--layout",
        "1.14",
        "--domain",
        "3",
        "-t",
        "estimator_local_position",
        "-i",
        "0",
    )
    bridge = run_nedbus("ros2", "-c", endpoint, *options)
    wait_for(lambda: "set --namespace" in bridge.err, what="the conflict")
    wait_for_matching(zenoh_session, "nedbus/a_b/estimator_local_position/0")
    for publisher in publishers:
        publisher.publish(message(7))
    assert len(subscriber.handler.recv().payload) == 188
    assert "estimator_local_position_1" not in bridge.err
    bridge.signal(signal.SIGTERM)
    assert bridge.wait() == 0


def test_access_control_that_hides_ros2_raises(timings: Timings, tmp_path: Path) -> None:
    """The bridge detects that a router's access control silently denies ROS 2 keys, and stops."""
    timings.token_visible = 0.2
    endpoint, file = free_endpoint(), tmp_path / "router.json5"
    rules = [
        {
            "id": "no",
            "permission": "deny",
            "messages": ["liveliness_token"],
            "key_exprs": ["@ros2_lv/**"],
        }
    ]
    policies = [{"rules": ["no"], "subjects": ["all"]}]
    access = {"enabled": True, "default_permission": "allow", "rules": rules, "policies": policies}
    file.write_text(
        json.dumps({"mode": "router", "access_control": {**access, "subjects": [{"id": "all"}]}})
    )
    with (
        closing(open_router(listen=(endpoint,), config_file=file)),
        nedbus.connect(endpoint) as bus,
        plain_session(endpoint) as session,
        plain_session(endpoint) as observer,
        pytest.raises(NedbusError, match="access control denies ROS 2's keys"),
    ):
        Ros2Bridge(bus, session, observer=observer).run(threading.Event())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "exit_code", "text"),
    [
        (
            ["--to", "tcp/127.0.0.1:1"],
            1,
            "no router answers at tcp/127.0.0.1:1: start ROS 2's router there",
        ),
        (
            ["--layout", "1.12"],
            2,
            "unknown layout '1.12': choose from 1.13, 1.14, 1.15, 1.16, 1.17, 1.18, main, V0",
        ),
        (["--namespace", "1:7up"], 2, "namespace '7up' is not valid"),
        (["--namespace", "7up"], 2, "VEHICLE:NAMESPACE"),
    ],
)
def test_invalid_option_is_a_one_line_error(
    run_nedbus: Start, endpoint: str, arguments: list[str], exit_code: int, text: str
) -> None:
    """The exit code is 2 for an invalid option, and 1 if no router answers; both print one line."""
    bridge = run_nedbus("ros2", "-c", endpoint, *arguments)
    assert bridge.wait() == exit_code
    assert text in bridge.err
    assert len(bridge.err.splitlines()) == 1
