"""PX4's Zenoh module, rebuilt from what it sends, and everything else that may be published on such keys."""

from __future__ import annotations

import json
import random
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest
import zenoh
from zenoh_ros2_sdk.discovery import _parse_liveliness_keyexpr

import nedbus
from nedbus.sources.options import Px4ZenohOptions
from nedbus.sources.px4_streams import NotAcceptedError, StreamRegistry, track_sequence
from nedbus.sources.px4_zenoh import _Inbox
from nedbus.transport import BRIDGED_ENCODING, NO_HASH, Attachment, Session, TopicKey
from nedbus_msgs import (
    ANY,
    LAYOUTS,
    ROS2_TYPE,
    ROS2_TYPES,
    DecodeError,
    dds_type,
    downgrade,
    encode_cdr,
    type_hash,
    upgrade,
)
from tests.conftest import DEADLINE, Process, Start, free_endpoint, message, wait_for, wait_for_reader

from .test_ros2 import Peer, flight, peer

__all__ = ["peer"]  # a fixture

VLP = "vehicle_local_position"
GID = bytes(range(16))

Serve = Callable[..., Process]


class Px4:
    """The Zenoh module of one PX4: it publishes as zenoh-pico does, one sequence for each topic, trailing garbage."""

    def __init__(
        self,
        session: Session,
        *,
        domain: int = 0,
        namespace: str = "",
        layout: str = "1.16",
    ) -> None:
        self._session = session
        self._start = f"{domain}/{namespace and namespace + '/'}fmu/out"
        self._layout = layout
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._sequences: dict[str, int] = {}
        self.type_hash = type_hash(layout)

    def key(self, topic: str = VLP) -> str:
        return f"{self._start}/{topic}/{dds_type(ROS2_TYPE)}/{self.type_hash}"

    def put(
        self, timestamp: int, *, topic: str = VLP, attachment: bytes | None = None, skip: int = 0, **given: Any
    ) -> None:
        """Send a message as PX4 does: its sequence starts at 1, its time is us since boot, its gid is the board's."""
        fields = downgrade(message(timestamp, **given), self._layout)
        self._sequences[topic] = self._sequences.get(topic, 0) + 1 + skip
        default = bytes(Attachment(self._sequences[topic], timestamp, GID))
        extra = {"1.13": 12, "1.14": 8, "1.15": 8, "V0": 4, "1.16": 0}[self._layout] * b"\xa5"
        self.raw(encode_cdr(fields, layout=self._layout) + extra, topic=topic, attachment=attachment or default)

    def raw(self, payload: bytes, *, topic: str = VLP, attachment: bytes | None = None) -> None:
        """Send any payload."""
        if topic not in self._publishers:
            # PX4 lets Zenoh drop what cannot be sent at once; this test sends faster than any PX4, and counts.
            publisher = self._session.declare_publisher(
                self.key(topic), congestion_control=zenoh.CongestionControl.BLOCK, express=True
            )
            self._publishers[topic] = publisher
            wait_for(
                lambda: cast("zenoh.MatchingStatus", publisher.matching_status).matching,
                what="the service to subscribe",
            )
        self._publishers[topic].put(payload, attachment=attachment)

    def reboot(self) -> None:
        self._sequences.clear()


@pytest.fixture
def every(bus: nedbus.Bus) -> Iterator[nedbus.Subscription]:
    """Receive every message of all topics that the service publishes."""
    with bus.subscribe(ANY, mode="every") as subscription:
        yield subscription


def status(bus: nedbus.Bus) -> dict[str, Any]:
    """Return the status of the service's only source."""
    services = cast("list[dict[str, Any]]", bus.services())
    return services[0]["sources"][0] if services else {}


def receive(subscription: nedbus.Subscription, count: int) -> list[nedbus.Sample]:
    return [subscription.receive(DEADLINE) for _ in range(count)]


@pytest.fixture
def serve(run_nedbus: Start, endpoint: str) -> Serve:
    """Start a service that receives from PX4s at the test's router."""
    return lambda options="": run_nedbus("serve", "--connect", endpoint, "-s", f"px4-zenoh:{options}")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_read_by_its_hash(serve: Serve, raw: Session, every: nedbus.Subscription, layout: str) -> None:
    """Messages of any release are received, with the fields that this release does not have as missing."""
    serve()
    px4 = Px4(raw, layout=layout)
    for timestamp in range(1, 11):
        px4.put(timestamp, x=0.1 * timestamp, xy_valid=True, y=-1.0, hagl_max_z=5.0)
    for timestamp, sample in enumerate(receive(every, 10), 1):
        sent = message(timestamp, x=0.1 * timestamp, xy_valid=True, y=-1.0, hagl_max_z=5.0)
        expected = upgrade(downgrade(sent, layout))
        assert sample.message == expected
        assert (sample.vehicle, sample.topic, sample.source) == ("1", VLP, "px4-zenoh")
        assert sample.missing == frozenset(LAYOUTS["1.16"].fields) - expected.model_fields_set
    assert every.counts.lost == 0


def test_topics_and_instances(serve: Serve, raw: Session, every: nedbus.Subscription) -> None:
    """All four topics, instances as users name them, and the names of versioned topics."""
    serve()
    px4 = Px4(raw)
    names = {
        "vehicle_local_position_v1": "1/vehicle_local_position",
        "vehicle_local_position_groundtruth": "1/vehicle_local_position_groundtruth",
        "external_ins_local_position": "1/external_ins_local_position",
        "estimator_local_position": "1/estimator_local_position/0",
        "estimator_local_position_1": "1/estimator_local_position/1",
        "estimator_local_position2": "1/estimator_local_position/2",
    }
    for timestamp, name in enumerate(names, 1):
        px4.put(timestamp, topic=name)
    assert {str(sample.address): sample.message.timestamp for sample in receive(every, len(names))} == {
        address: timestamp for timestamp, address in enumerate(names.values(), 1)
    }


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("", {"1", "domain1", "px4_2", "domain3-swarm-px4_3"}),
        ("?vehicle=leader&vehicles=1:wing,px4_2:tail,swarm/px4_3:last", {"leader", "wing", "tail", "last"}),
    ],
)
def test_vehicles_are_distinguished(
    serve: Serve, raw: Session, every: nedbus.Subscription, options: str, expected: set[str]
) -> None:
    """In SITL all vehicles have one gid: domain and namespace distinguish them, and options name them."""
    serve(options)
    fleet = [
        Px4(raw),
        Px4(raw, domain=1),
        Px4(raw, namespace="px4_2"),
        Px4(raw, domain=3, namespace="swarm/px4_3"),
    ]
    for timestamp in range(1, 21):
        for px4 in fleet:
            px4.put(timestamp)
    samples = receive(every, 80)
    assert {sample.vehicle for sample in samples} == expected
    for vehicle in expected:
        assert [s.message.timestamp for s in samples if s.vehicle == vehicle] == list(range(1, 21))


def test_only_the_configured_domain_is_received(serve: Serve, raw: Session, every: nedbus.Subscription) -> None:
    """With a domain, others are ignored, and the vehicle has the service's default name."""
    serve("?domain=5")
    five = Px4(raw, domain=5)
    five.put(1)
    raw.put(Px4(raw, domain=6).key(), encode_cdr(downgrade(message(2), "1.16"), layout="1.16"))
    five.put(3)
    assert [(sample.vehicle, sample.message.timestamp) for sample in receive(every, 2)] == [("1", 1), ("1", 3)]


def test_loss_and_reboot_are_counted(serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription) -> None:
    """Losses before the service are counted by PX4's sequence; a sequence that goes back is a reboot."""
    service = serve()
    px4 = Px4(raw)
    px4.put(1)
    px4.put(2, skip=3)
    px4.reboot()
    px4.put(3)
    px4.put(4, skip=1)
    assert [sample.message.timestamp for sample in receive(every, 4)] == [1, 2, 3, 4]
    wait_for(lambda: status(bus)["published"] == 4, what="the last one to be counted")
    now = status(bus)
    assert (now["lost"], now["reboots"], now["rejected"]) == (4, 1, 0)
    assert "the vehicle rebooted" in service.err


def test_plain_publisher_needs_no_attachment(serve: Serve, raw: Session, every: nedbus.Subscription) -> None:
    """Any Zenoh client may send CDR on such a key."""
    serve()
    px4 = Px4(raw)
    px4.raw(encode_cdr(downgrade(message(9), "1.16"), layout="1.16"))
    assert every.receive(DEADLINE).message.timestamp == 9


def test_type_hash_not_supported(serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription) -> None:
    """A build without hashes is rejected with a hint, and received once the layout is configured."""
    service = serve()
    px4 = Px4(raw, layout="1.14")
    px4.type_hash = NO_HASH
    px4.put(1)
    wait_for(lambda: "name the layout, as in px4-zenoh:?layout=1.14" in service.err, what="the rejection")
    assert status(bus)["rejected"] == 1
    service.kill()
    second = serve("?layout=1.14")
    wait_for(lambda: "listening" in second.err, what="the second service")
    px4 = Px4(raw, layout="1.14", domain=2)
    px4.type_hash = NO_HASH
    px4.put(2)
    assert every.receive(DEADLINE).message.timestamp == 2


def test_hostile_input_is_counted_and_logged(
    serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription
) -> None:
    """Wrong hashes, lengths, attachments and 10,000 random payloads: counted, logged once, nothing published."""
    service = serve()
    good = Px4(raw)
    good.put(1)
    unknown = Px4(raw, domain=1)
    unknown.type_hash = "RIHS01_" + 64 * "0"
    for timestamp in range(10):
        unknown.put(timestamp)
    short = Px4(raw, domain=2)
    short.raw(b"\x00\x01\x00\x00" + bytes(100))
    short.raw(b"")
    short.raw(bytes(100_000))
    wrong = Px4(raw, domain=3)
    for attachment in (b"x", bytes(33), bytes(34), bytes(Attachment(2**62, 0, GID))[:-1], 16 * b"\xff" + b"\x10" + GID):
        wrong.put(1, attachment=attachment)
    noise, rng = Px4(raw, domain=4), random.Random(0)
    for each in range(10_000):
        noise.raw(rng.randbytes(220) if each % 2 else b"\x00\x01\x00\x00" + rng.randbytes(rng.randrange(240)))
    other = Px4(raw, domain=5)
    other.raw(encode_cdr(downgrade(message(1), "1.16"), layout="1.16"), topic="somebody/pose")
    raw.put(f"0/{'x' * 200}/fmu/out/{VLP}/{dds_type(ROS2_TYPE)}/{type_hash('1.16')}", b"")
    raw.put(f"ä/fmu/out/{VLP}/{dds_type(ROS2_TYPE)}/{type_hash('1.16')}", b"")
    wait_for(lambda: status(bus)["rejected"] == 18 + 10_000 + 3, what="all rejections to be counted")
    good.put(2)
    samples = receive(every, 2)
    assert [(sample.vehicle, sample.message.timestamp) for sample in samples] == [("1", 1), ("1", 2)]
    assert every.counts.received == 2
    wait_for(lambda: status(bus)["published"] == 2, what="the last one to be counted")
    assert "not a VehicleLocalPosition" not in service.err
    rejections = [line for line in service.err.splitlines() if ": rejected: " in line]
    assert sum(64 * "0" in line for line in rejections) == 1
    assert len(rejections) <= 8, rejections
    assert any("update nedbus" in warning for warning in status(bus)["warnings"])


def test_invalid_messages_are_reported(serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription) -> None:
    """A payload that is CDR but violates the rules is reported with its reason, as from any source."""
    serve()
    reports = raw.declare_subscriber("nedbus/@rejected/**", zenoh.handlers.FifoChannel(10))
    px4 = Px4(raw)
    px4.raw(encode_cdr({**downgrade(message(1), "1.16"), "xy_valid": True}, layout="1.16"))
    px4.raw(encode_cdr({**downgrade(message(1), "1.16"), "eph": -1.0}, layout="1.16") + b"too long")
    assert "must be finite while xy_valid is true" in reports.handler.recv().payload.to_string()
    assert "228 bytes, where layout 1.16 has 220" in reports.handler.recv().payload.to_string()
    px4.put(2)
    assert every.receive(DEADLINE).message.timestamp == 2


def test_messages_of_nedbus_ros2_are_ignored(
    serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription
) -> None:
    """Messages that nedbus published to ROS 2 are not received again, whoever forwards them."""
    service = serve()
    px4 = Px4(raw)
    wait_for_reader(raw, px4.key())
    raw.put(px4.key(), b"", attachment=bytes(Attachment(1, 1, GID)), encoding=BRIDGED_ENCODING)
    px4.put(2)
    assert every.receive(DEADLINE).message.timestamp == 2
    assert status(bus)["rejected"] == 0
    assert service.err.count("would loop") == 1


def test_two_vehicles_with_one_gid_on_one_key_are_not_mixed(
    serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription
) -> None:
    """Of two simulated PX4s in one domain without namespaces one is received, the other rejected."""
    service = serve()
    one, other = Px4(raw), Px4(raw)
    for timestamp in range(1, 101):
        one.put(1000 + timestamp, skip=1000 if timestamp == 1 else 0)
        other.put(timestamp)
    times = [sample.message.timestamp for sample in receive(every, 100)]
    assert sum(time < 1000 for time in times) <= 2
    wait_for(lambda: status(bus)["rejected"] >= 98, what="the rejections")
    assert status(bus)["reboots"] <= 2
    assert "give each a namespace or a domain" in service.err
    assert len(service.err.splitlines()) < 10


def test_two_publishers_of_one_key_are_not_mixed(
    serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription
) -> None:
    """Two ROS 2 nodes on one topic have different gids: the first one is received."""
    serve()
    px4 = Px4(raw)
    for sequence in range(1, 11):
        px4.put(sequence, attachment=bytes(Attachment(sequence, 0, GID)))
        px4.put(100 + sequence, attachment=bytes(Attachment(sequence, 0, GID[::-1])))
    assert [sample.message.timestamp for sample in receive(every, 10)] == list(range(1, 11))
    wait_for(lambda: status(bus)["rejected"] == 10, what="the rejections")


def test_hostile_keys_leave_the_status_readable(serve: Serve, raw: Session, bus: nedbus.Bus) -> None:
    """Long keys and long reasons do not make the status too long to be received."""
    serve()
    px4 = Px4(raw)
    px4.put(1)
    for number in range(100):
        raw.put(f"0/{'a' * 4000}{number}/{dds_type(ROS2_TYPE)}/{type_hash('1.16')}", b"")
        raw.put(f"0/{'a' * 300}{number}/{dds_type(ROS2_TYPE)}/{type_hash('1.16')}", b"")
    wait_for(lambda: status(bus).get("rejected") == 200, what="the status")


def test_what_waits_to_be_decoded_is_small(raw: Session) -> None:
    """What is too long for ROS 2, and large payloads, do not wait; they are counted."""
    inbox = _Inbox("px4-zenoh:")
    name = dds_type(ROS2_TYPES[0])
    inbox.subscribe(raw, name, domain=None)
    for topic, payload in (("a", bytes(300)), ("b", bytes(5000)), ("x" * 2000, bytes(300)), ("last", bytes(300))):
        raw.put(f"0/{topic}/{name}/hash", payload)
    waiting = [inbox.pending.get(timeout=DEADLINE) for _ in range(2)]
    assert [str(sample.key_expr).split("/")[1] for sample in waiting] == ["a", "last"]
    assert [(each.where, each.count) for each in inbox.overflow()] == [("size", 2)]
    assert not list(inbox.overflow())
    inbox.close()


def test_service_connects_to_its_own_router(run_nedbus: Start, tmp_path: Path) -> None:
    """Vehicles are received at the service's router: one by file, or one that connects to another that is down."""
    own, down = free_endpoint(), free_endpoint()
    file = tmp_path / "router.json5"
    listen = f'listen: {{endpoints: ["{own}"]}}'
    file.write_text(f'{{mode: "router", {listen}, scouting: {{multicast: {{enabled: false}}}}}}')
    for arguments in (["--router-config", str(file)], ["--listen", own, "--connect", down]):
        service = run_nedbus("serve", *arguments, "-s", "px4-zenoh:")
        with nedbus.connect(own, timeout=DEADLINE) as bus, bus.subscribe() as subscription:
            Px4(bus._session).put(1)
            assert subscription.receive(DEADLINE).message.timestamp == 1
        service.kill()


def test_domain_and_namespace_make_a_name(serve: Serve, raw: Session, every: nedbus.Subscription) -> None:
    """The vehicle of a domain is the first part of the names of its namespaces."""
    serve("?vehicles=5:tail,/px4_2:wing")
    for namespace in ("", "px4_1", "px4_2"):
        Px4(raw, domain=5, namespace=namespace).put(1)
    assert {sample.vehicle for sample in receive(every, 3)} == {"tail", "tail-px4_1", "wing"}


def test_second_key_of_an_address_is_rejected(
    serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription
) -> None:
    """Two keys that stand for one address are not mixed: the first one stays, the other is rejected."""
    service = serve()
    one, other = Px4(raw), Px4(raw, layout="V0")
    one.put(1)
    other.put(2)
    one.put(3)
    assert [sample.message.timestamp for sample in receive(every, 2)] == [1, 3]
    assert status(bus)["rejected"] == 1
    assert "already: name one of them with vehicles=" in service.err


def test_ros_2_publisher_that_restarts_is_received_at_once(
    serve: Serve, peer: Peer, bus: nedbus.Bus, every: nedbus.Subscription
) -> None:
    """A ROS 2 node that is killed and started again has a new gid: nothing of it is rejected, and it is one reboot.

    The node is zenoh-ros2-sdk's.
    """
    serve()
    messages = flight()
    rows = [downgrade(each, "1.16") for each in messages]
    for _ in range(2):
        node = peer("talk", "1.16", topic=f"/fmu/out/{VLP}", rows=rows)
        assert [sample.message for sample in receive(every, len(rows))] == messages
        node.kill()
    wait_for(lambda: status(bus)["published"] == 2 * len(rows), what="the last one to be counted")
    now = status(bus)
    assert (now["rejected"], now["lost"], now["reboots"]) == (0, 0, 1)


def test_ros_2_lists_the_source_as_a_subscriber(serve: Serve, peer: Peer, raw: Session) -> None:
    """`ros2 topic info -v` shows it for as long as somebody publishes: a publisher that is lazy sees whom to serve.

    The publisher is zenoh-ros2-sdk's, and so is the parser of the tokens.
    """

    def subscriptions() -> list[dict[str, object]]:
        tokens = raw.liveliness().get("@ros2_lv/4/*/*/*/MS/**")
        return [_parse_liveliness_keyexpr(str(reply.ok.key_expr)) or {} for reply in tokens if reply.ok]

    serve()
    node = peer("talk", "1.14", topic=f"/drone/{VLP}", rows=[], domain_id=4)
    wait_for(subscriptions, what="the subscription")
    [found] = subscriptions()
    assert str(found["node_name"]).startswith("nedbus_px4_zenoh_")
    topic = (found["qualified_name"], found["dds_type"], found["type_hash"])
    assert topic == (f"/drone/{VLP}", dds_type(ROS2_TYPE), type_hash("1.14"))
    nodes = [str(reply.ok.key_expr) for reply in raw.liveliness().get("@ros2_lv/4/*/*/*/NN/**") if reply.ok]
    assert any(name.endswith(f"/{found['node_name']}") for name in nodes)
    node.kill()
    wait_for(lambda: not subscriptions(), what="the subscription to be withdrawn")


def test_stale_vehicle_is_not_listed(serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription) -> None:
    """A vehicle that sends nothing for 3 s is stale in the status and not listed; others are not affected."""
    serve()
    px4, other = Px4(raw), Px4(raw, domain=1)
    px4.put(1)
    every.receive(DEADLINE)

    def is_stale() -> bool:
        other.put(time.monotonic_ns())
        return bool(status(bus)["stale"] == [f"1/{VLP}"])

    assert status(bus)["state"] == "running"
    wait_for(is_stale, what="the status to be stale")
    assert list(bus.vehicles()) == ["domain1"]
    px4.put(2)
    wait_for(lambda: status(bus)["stale"] == [], what="the vehicle to be back")
    assert {"1", "domain1"} >= set(bus.vehicles()) >= {"1"}


def test_vehicle_connects_to_the_service(run_nedbus: Start) -> None:
    """A vehicle can connect to the service itself, which is a router."""
    endpoint = free_endpoint()
    run_nedbus("serve", "--listen", endpoint, "-s", "px4-zenoh:")
    with nedbus.connect(endpoint, timeout=DEADLINE) as bus, bus.subscribe() as subscription:
        px4 = Px4(bus._session)
        px4.put(1)
        assert subscription.receive(DEADLINE).message.timestamp == 1


def test_source_is_no_client_of_its_own_router(run_nedbus: Start) -> None:
    """It listens on the router's own session, as a link to itself would drop messages: named or not."""
    endpoint = free_endpoint()
    service = run_nedbus("serve", "--listen", endpoint, "-s", "px4-zenoh:", "-s", f"px4-zenoh:{endpoint}?domain=3")
    wait_for(lambda: service.err.count("listening") == 2, what="both sources")
    with nedbus.connect(endpoint, timeout=DEADLINE) as bus:
        [reply] = bus._session.get("@/*/router")
        assert reply.ok is not None
        assert len(json.loads(reply.ok.payload.to_bytes())["sessions"]) == 1


def test_router_that_is_down_is_retried(run_nedbus: Start) -> None:
    """A vehicle's router that does not answer is an error in the status, and retried; other sources go on."""
    endpoint, other_router = free_endpoint(), free_endpoint()
    service = run_nedbus("serve", "--listen", endpoint, "-s", f"px4-zenoh:{other_router}", "-s", "sim:")
    with nedbus.connect(endpoint, timeout=DEADLINE) as bus, bus.subscribe(vehicle="7") as subscription:
        wait_for(lambda: "no Zenoh router answers there" in service.err, what="the first try")
        run_nedbus("router", "--listen", other_router)
        with nedbus.connect(other_router, timeout=DEADLINE) as other:
            px4 = Px4(other._session, namespace="7")
            px4.put(1)
            assert subscription.receive(DEADLINE).message.timestamp == 1


@pytest.mark.parametrize(
    "key",
    ["", "0", "0/a/b", "x/fmu/out/a/b/c", "0//a/b/c", "0/*/a/b", f"{10**12}/a/b/c", "-1/a/b/c", "0/a/b/"],
)
def test_other_keys_are_rejected(key: str) -> None:
    """A key that rmw_zenoh would not write raises DecodeError."""
    with pytest.raises(DecodeError):
        TopicKey.parse(key)


def test_key_and_attachment_round_trip() -> None:
    """Parsing returns what was written."""
    key = TopicKey(3, "px4_1/fmu/out/vehicle_local_position", dds_type(ROS2_TYPE), type_hash("V0"))
    assert TopicKey.parse(str(key)) == key
    attachment = Attachment(7, 123456789, GID)
    assert len(bytes(attachment)) == 33
    assert Attachment.parse(bytes(attachment)) == attachment


def key(*, domain: int = 0, namespace: str = "", layout: str = "1.16") -> str:
    """Return the key of vehicle_local_position, as PX4 writes it."""
    topic = f"{namespace and namespace + '/'}fmu/out/{VLP}"
    return str(TopicKey(domain, topic, dds_type(ROS2_TYPE), type_hash(layout)))


@pytest.fixture
def streams() -> StreamRegistry:
    """Return a registry with default options, for a service whose vehicle is 1."""
    return StreamRegistry(Px4ZenohOptions.model_validate({}), vehicle="1")


def test_address_is_free_after_3_seconds(streams: StreamRegistry) -> None:
    """The first key owns an address until it is silent for 3 s; then another key may have it."""
    first, second = streams.register(key()), streams.register(key(layout="V0"))
    assert (streams.find(key()), str(second.address)) == (first, f"1/{VLP}")
    streams.claim(first, None, 100.0)
    track_sequence(first, None, 100.0)
    with pytest.raises(NotAcceptedError, match="already: name one of them with vehicles="):
        streams.claim(second, None, 102.9)
    streams.claim(second, None, 103.0)
    track_sequence(second, None, 103.0)
    with pytest.raises(NotAcceptedError, match="already"):
        streams.claim(first, None, 104.0)


def test_key_is_free_after_3_seconds(streams: StreamRegistry) -> None:
    """The first publisher owns a key until it is silent for 3 s; the sequence of the next one starts anywhere."""
    stream = streams.register(key())
    streams.claim(stream, Attachment(7, 0, GID), 100.0)
    track_sequence(stream, Attachment(7, 0, GID), 100.0)
    other = Attachment(500, 0, GID[::-1])
    with pytest.raises(NotAcceptedError, match="two publishers share this key"):
        streams.claim(stream, other, 102.9)
    streams.claim(stream, other, 103.0)
    assert track_sequence(stream, other, 103.0) == (0, False)


@pytest.mark.parametrize(
    ("sequence", "lost", "rebooted"), [(11, 0, False), (15, 4, False), (10 + 1_000_001, 0, False), (1, 0, True)]
)
def test_gap_in_the_sequence_is_loss(streams: StreamRegistry, sequence: int, lost: int, rebooted: bool) -> None:
    """A gap is that many lost messages, unless it is absurdly large; a step back is a reboot."""
    stream = streams.register(key())
    for each, expected in ((10, (0, False)), (sequence, (lost, rebooted)), (sequence + 1, (0, False))):
        assert track_sequence(stream, Attachment(each, 0, GID), 100.0) == expected


def test_sequence_that_goes_back_repeatedly_is_rejected(streams: StreamRegistry) -> None:
    """One step back is a reboot; another one within 3 s is a second vehicle with the same gid."""
    stream = streams.register(key())
    for sequence, now in ((10, 100.0), (1, 100.1), (20, 100.2)):
        track_sequence(stream, Attachment(sequence, 0, GID), now)
    with pytest.raises(NotAcceptedError, match="goes back and forth"):
        track_sequence(stream, Attachment(2, 0, GID), 103.0)
    assert track_sequence(stream, Attachment(1, 0, GID), 106.1) == (0, True)
    with pytest.raises(NotAcceptedError, match="sequence number 1 is a duplicate"):
        track_sequence(stream, Attachment(1, 0, GID), 106.2)


def test_number_of_keys_is_limited(streams: StreamRegistry) -> None:
    """A thousand keys are registered, and no more."""
    for domain in range(1000):
        streams.register(key(domain=domain))
    with pytest.raises(NotAcceptedError, match="more than 1000 keys"):
        streams.register(key(domain=1000))
    assert streams.find(key(domain=1000)) is None
