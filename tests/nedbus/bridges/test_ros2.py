"""ROS 2 over rmw_zenoh, in both directions, against an independent client: zenoh-ros2-sdk."""

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
from tests.flights.local_position import LAYOUTS, ROS2_TYPE, decode_cdr, downgrade, encode, type_hash, upgrade
from tests.flights.messages import VLP, message
from tests.flights.replays import open_replay
from tests.flights.ulogs import LOGS
from tests.peers.live_source import Listener
from tests.peers.ports import free_endpoint
from tests.peers.processes import Process, Start
from tests.waits import DEADLINE, repeating, wait_for, wait_for_matching

PEER = str(Path(__file__).with_name("ros2_peer.py"))
KEY = f"0/fmu/out/{VLP}/{dds_type(ROS2_TYPE)}/{type_hash('1.16')}"

TWELVE = LOGS.parent / "px4" / "twelve_messages.ulg"

Peer = Callable[..., Process]
RunBridge = Callable[..., None]


def flight() -> list[VehicleLocalPosition]:
    """Return estimates of a flight: numbers of all kinds, NaN, infinities, a reset."""
    messages = (each for each in open_replay("sim:?seed=3&duration=20").messages if each.address.topic == VLP)
    return [upgrade(each.fields) for each in islice(messages, 0, None, 20)]


def definition(layout: str) -> str:
    """Return the message definition as a .msg file of px4_msgs has it."""
    return "".join(f"{LAYOUTS[layout].types[name]!s} {name}\n" for name in LAYOUTS[layout].fields)


@pytest.fixture
def run_bridge(endpoint: str, timings: Timings, caplog: pytest.LogCaptureFixture) -> Iterator[RunBridge]:
    """Run a bridge in a thread, which looks for changes twenty times a second, and on a bus of its own."""
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
    """Return the liveliness tokens of ROS 2 of this kind in domain 0: NN of nodes, MP of publishers."""
    return [
        str(reply.ok.key_expr) for reply in zenoh_session.liveliness().get(f"@ros2_lv/0/*/*/*/{kind}/**") if reply.ok
    ]


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


def test_ros_2_node_is_received(run_nedbus: Start, peer: Peer, endpoint: str, bus: nedbus.Bus) -> None:
    """A message of a ROS 2 node arrives field for field, with the layout found by its hash."""
    rows = [downgrade(each, "1.14") for each in flight()]
    with bus.subscribe(mode="every") as subscription:
        run_nedbus("serve", "--connect", endpoint, "-s", "px4-zenoh:")
        peer("talk", "1.14", topic=f"/drone/{VLP}", rows=rows, domain_id=4)
        for row in rows:
            sample = subscription.receive(DEADLINE)
            assert sample.message == upgrade(row)
            assert (sample.vehicle, sample.topic, sample.source) == ("domain4-drone", VLP, "px4-zenoh")
        assert subscription.counts.lost == 0


@pytest.mark.parametrize("layout", ["1.14", "1.16"])
def test_ros_2_node_receives_and_lists(
    run_bridge: RunBridge, peer: Peer, zenoh_session: Session, bus: nedbus.Bus, layout: str
) -> None:
    """A message of the bridge arrives at a ROS 2 node field for field, and its topics are listed."""
    messages = flight()
    expected = [downgrade(each, layout) for each in messages]
    publisher = bus.publisher(VLP, vehicle="7")
    bus.publisher("estimator_local_position", vehicle="7", instance=1)
    topic = f"/px4_7/fmu/out/{VLP}"
    node = peer("listen", layout, topic=topic, rows=expected, domain_id=3)
    wait_for_matching(zenoh_session, f"3{topic}/{dds_type(ROS2_TYPE)}/{type_hash(layout)}")
    run_bridge(layout=layout, domain=3)
    wait_for(lambda: len(list(zenoh_session.liveliness().get("@ros2_lv/3/*/*/*/MP/**"))) == 2, what="the bridge")
    wait_for_matching(zenoh_session, f"nedbus/7/{VLP}")
    for each in messages:
        publisher.publish(each)
    assert node.wait() == 0, node.err
    *received, listed = [json.loads(line) for line in node.out.splitlines()]
    assert [as_json(row) for row in received] == [as_json(json.loads(json.dumps(row))) for row in expected]
    assert [topic, [ROS2_TYPE]] in listed
    assert ["/px4_7/fmu/out/estimator_local_position_1", [ROS2_TYPE]] in listed


def test_bridge_writes_what_px4_writes(run_bridge: RunBridge, bus: nedbus.Bus, zenoh_session: Session) -> None:
    """Key, payload and attachment are those of PX4's own module: its subscribers see no difference."""
    publisher = bus.publisher(VLP, vehicle="1")
    run_bridge()
    subscriber = zenoh_session.declare_subscriber(KEY, zenoh.handlers.FifoChannel(100))
    wait_for(lambda: tokens(zenoh_session, "MP"), what="the publisher's token")
    wait_for_matching(zenoh_session, f"nedbus/1/{VLP}")
    for timestamp in (1, 2):
        publisher.publish(message(timestamp))
    one, two = (subscriber.handler.recv() for _ in range(2))
    assert len(one.payload) == 220
    first, second = (Attachment.parse(sample.attachment.to_bytes()) for sample in (one, two) if sample.attachment)
    assert (first.sequence, second.sequence, first.gid == second.gid) == (1, 2, True)
    assert second.time > first.time > 1_700_000_000_000_000_000
    (token,) = tokens(zenoh_session, "MP")
    assert first.gid == gid_of_token(token), "what `ros2 topic info -v` shows"
    assert len(tokens(zenoh_session, "NN")) == 1


@pytest.mark.logs
@pytest.mark.skipif(not TWELVE.exists(), reason=f"no log of a PX4: {TWELVE} is not there")
@pytest.mark.parametrize("release", ["1.13", "1.15", "main"])
def test_every_message_has_its_layout_of_the_release(
    run_bridge: RunBridge, bus: nedbus.Bus, zenoh_session: Session, caplog: pytest.LogCaptureFixture, release: str
) -> None:
    """Of all that a real PX4 logged: the key has the hash of that release, and the CDR the fields; names are PX4's.

    What the release does not have is said once. Of what has no rate the last one is published, however old it is.
    """
    last = {each.address: each.fields for each in open_replay(f"ulog:{TWELVE}").messages}
    messages = {each: upgrade_with(BY_TOPIC[each.topic], fields) for each, fields in last.items()}
    publishers = [bus.publisher(each.topic, vehicle=each.vehicle, instance=each.instance) for each in messages]
    for publisher, each in zip(publishers, messages.values(), strict=True):
        publisher.publish(each)
    wait_for(lambda: len(bus.latest(ANY)) == len(messages), what="the last values")
    subscriber = zenoh_session.declare_subscriber("0/fmu/out/**", zenoh.handlers.FifoChannel(1000))
    run_bridge(layout=release)
    missing = {each for each in messages if BY_TOPIC[each.topic].layout_of_release(release) is None}
    wait_for(lambda: len(tokens(zenoh_session, "MP")) == len(messages) - len(missing), what="the bridge")
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
    assert {"battery_status", "sensor_gps", "estimator_status_flags", "estimator_status_flags_1"} <= received
    assert len(received) == len(messages) - len(missing)
    for address in missing:
        assert caplog.text.count(f"{address} is not published to ROS 2: PX4 {release} has no such message") == 1


def test_home_of_a_vehicle_that_appears_reaches_ros_2(
    run_bridge: RunBridge, bus: nedbus.Bus, zenoh_session: Session, caplog: pytest.LogCaptureFixture
) -> None:
    """It is said once, before the bridge can know of it; of what nobody selected nothing is said."""
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


def test_last_value_does_not_reach_ros_2(
    run_bridge: RunBridge, bus: nedbus.Bus, zenoh_session: Session, caplog: pytest.LogCaptureFixture
) -> None:
    """Messages from before the bridge began are held back, and from then on a vehicle is published whole."""
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    wait_for(bus.latest, what="the last value")
    subscriber = zenoh_session.declare_subscriber(KEY, zenoh.handlers.FifoChannel(1000))
    run_bridge()
    wait_for(lambda: "->" in caplog.text and "1 old message held back" in caplog.text, what="both")
    wait_for_matching(zenoh_session, f"nedbus/1/{VLP}")
    for timestamp in range(2, 402):
        publisher.publish(message(timestamp))
    received = [subscriber.handler.recv() for _ in range(400)]
    times = [decode_cdr(each.payload.to_bytes(), layout="1.16")["timestamp"] for each in received]
    assert times == list(range(2, 402))


def test_vehicle_that_is_back_brings_nothing_late(
    run_bridge: RunBridge, zenoh_session: Session, timings: Timings, caplog: pytest.LogCaptureFixture
) -> None:
    """After a router's restart a vehicle may be gone for a moment: what is recovered then is no current estimate."""
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
    wait_for(lambda: zenoh_session.new_timestamp().get_time() - late > dt.timedelta(seconds=0.2), what="it to be late")
    put(2, late)
    wait_for(lambda: "1 old message held back, up to" in caplog.text, what="the report")
    current = count(3)
    with repeating(
        lambda: put(next(current), zenoh_session.new_timestamp().get_time())
    ):  # on a busy machine some are late
        assert decode_cdr(subscriber.handler.recv().payload.to_bytes(), layout="1.16")["timestamp"] != 2
    token.undeclare()


@pytest.mark.slow  # an outage of some seconds; what is too late is decided in test_late_filter.py
def test_recovered_messages_do_not_reach_ros_2(run_nedbus: Start, tmp_path: Path) -> None:
    """After an outage the bridge recovers what it missed, and says how much it held back of it: it is no estimate."""
    endpoint = free_endpoint()
    router = open_router(listen=(endpoint,))
    published: list[float] = []  # when each timestamp was, from 0 on
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
                received.append(int(str(decode_cdr(sample.payload.to_bytes(), layout="1.16")["timestamp"])))
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
                lambda: " s late: ROS 2 would take them for the current estimate" in bridge.err, what="the recovery"
            )
            last = len(published)
            wait_for(lambda: has_received(last), what="what is current")
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
def test_gid_is_that_of_rmw_zenoh(type_hash: str, gid: str) -> None:
    """These were computed by rmw_zenoh's own code (simplified_xxhash3.cpp), for both of its paths."""
    key = TopicKey(0, f"fmu/out/{VLP}", "px4_msgs::msg::dds_::VehicleLocalPosition_", type_hash)
    token = key.token("MP", "0123456789abcdef" * 2, "nedbus_4711", 1)
    assert gid_of_token(token).hex() == gid


def test_topic_of_another_node_is_left_to_it(
    run_bridge: RunBridge,
    bus: nedbus.Bus,
    zenoh_session: Session,
    timings: Timings,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A topic that a PX4 publishes itself is not published twice; the same one in another layout is a translation."""
    timings.take_over = 0.1
    key = TopicKey(0, f"fmu/out/{VLP}", dds_type(ROS2_TYPE), type_hash("1.14"))
    token = zenoh_session.liveliness().declare_token(key.token("MP", "cafe", "px4_0001", 7))
    bus.publisher(VLP, vehicle="1")
    left, published = f"left to node px4_0001, which already publishes /fmu/out/{VLP}", f"-> /fmu/out/{VLP}, "
    run_bridge(layout="1.14")
    wait_for(lambda: left in caplog.text, what="the warning")
    assert published not in caplog.text
    run_bridge(layout="1.16")
    wait_for(lambda: published in caplog.text, what="the translation")
    token.undeclare()
    wait_for(lambda: caplog.text.count(published) == 2, what="the topic to be taken over")
    back = zenoh_session.liveliness().declare_token(key.token("MP", "cafe", "px4_0001", 7))
    wait_for(lambda: caplog.text.count(left) == 2, what="the topic to be released")
    back.undeclare()


def test_topics_come_and_go_with_their_vehicles(run_bridge: RunBridge, bus: nedbus.Bus, zenoh_session: Session) -> None:
    """ROS 2 lists what is there now."""

    def topics() -> set[str]:
        return {token.split("/")[9] for token in tokens(zenoh_session, "MP")}

    run_bridge(selection=Selection(ANY, vehicle="alpha-1"), namespaces={"alpha-1": "fleet/a"})
    publisher = bus.publisher(VLP, vehicle="alpha-1")
    bus.publisher(VLP, vehicle="beta")
    wait_for(lambda: topics() == {f"%fleet%a%fmu%out%{VLP}"}, what="the topic")
    publisher.close()
    wait_for(lambda: not topics(), what="the topic to go")


def test_loop_is_rejected(
    run_bridge: RunBridge, endpoint: str, bus: nedbus.Bus, caplog: pytest.LogCaptureFixture
) -> None:
    """A source that listens to ROS 2 ignores what a bridge of its own network published to ROS 2."""
    publisher = bus.publisher(VLP, vehicle="1", source="sim")
    run_bridge()
    with Listener("px4-zenoh:?vehicle=copy", routers=(endpoint,)) as listener:
        timestamps = count(1)

        def is_rejected() -> bool:
            publisher.publish(message(next(timestamps)))
            return "ignored to avoid a loop" in caplog.text

        listener.step_until(is_rejected, what="the rejection")
        assert (listener.messages, listener.rejections) == ([], [])


def test_one_instance_for_humble(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, zenoh_session: Session) -> None:
    """The command: one instance alone, another domain, two vehicles of one topic, and the keys of ROS 2 Humble."""
    publishers = [bus.publisher("estimator_local_position", vehicle="a-b", instance=number) for number in (0, 1)]
    bus.publisher("estimator_local_position", vehicle="a_b", instance=0)
    key = f"3/a_b/fmu/out/estimator_local_position_0/{dds_type(ROS2_TYPE)}/TypeHashNotSupported"
    subscriber = zenoh_session.declare_subscriber(key, zenoh.handlers.FifoChannel(10))
    options = ("--humble", "--layout", "1.14", "--domain", "3", "-t", "estimator_local_position", "-i", "0")
    bridge = run_nedbus("ros2", "-c", endpoint, *options)
    wait_for(lambda: "set --namespace" in bridge.err, what="both")
    wait_for_matching(zenoh_session, "nedbus/a_b/estimator_local_position/0")
    for publisher in publishers:
        publisher.publish(message(7))
    assert len(subscriber.handler.recv().payload) == 188
    assert "estimator_local_position_1" not in bridge.err
    bridge.signal(signal.SIGTERM)
    assert bridge.wait() == 0


def test_router_that_hides_ros_2_is_named(timings: Timings, tmp_path: Path) -> None:
    """A router whose access control has no rule for ROS 2 denies in silence: the bridge finds out, and ends."""
    timings.token_visible = 0.2
    endpoint, file = free_endpoint(), tmp_path / "router.json5"
    rules = [{"id": "no", "permission": "deny", "messages": ["liveliness_token"], "key_exprs": ["@ros2_lv/**"]}]
    policies = [{"rules": ["no"], "subjects": ["all"]}]
    access = {"enabled": True, "default_permission": "allow", "rules": rules, "policies": policies}
    file.write_text(json.dumps({"mode": "router", "access_control": {**access, "subjects": [{"id": "all"}]}}))
    with (
        closing(open_router(listen=(endpoint,), config_file=file)),
        nedbus.connect(endpoint) as bus,
        plain_session(endpoint) as session,
        plain_session(endpoint) as observer,
        pytest.raises(NedbusError, match="access control denies the keys of ROS 2"),
    ):
        Ros2Bridge(bus, session, observer=observer).run(threading.Event())


@pytest.mark.parametrize(
    ("arguments", "exit_code", "text"),
    [
        (["--to", "tcp/127.0.0.1:1"], 1, "no router answers at tcp/127.0.0.1:1: start the router of ROS 2 there"),
        (["--layout", "1.12"], 2, "unknown layout '1.12': choose from 1.13, 1.14, 1.15, 1.16, 1.17, 1.18, main, V0"),
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
