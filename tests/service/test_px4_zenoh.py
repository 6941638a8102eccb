"""A PX4 that speaks Zenoh: built from what its module sends; and everything else that may stand on such keys."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest
import zenoh

import nedbus
from nedbus.rmw_zenoh import NO_HASH, Attachment, TopicKey, make_gid
from nedbus.session import Session
from nedbus_msgs import LAYOUTS, ROS2_TYPE, DecodeError, dds_type, downgrade, encode_cdr, type_hash, upgrade
from tests.conftest import DEADLINE, Process, Start, free_endpoint, message, wait_for

VLP = "vehicle_local_position"
GID = bytes(range(16))

Serve = Callable[..., Process]


class Px4:
    """The Zenoh module of one PX4: zenoh-pico's way of publishing, one sequence for each topic, trailing garbage."""

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
        own = bytes(Attachment(self._sequences[topic], timestamp, GID))
        extra = {"1.13": 12, "1.14": 8, "1.15": 8, "V0": 4, "1.16": 0}[self._layout] * b"\xa5"
        self.raw(encode_cdr(fields, layout=self._layout) + extra, topic=topic, attachment=attachment or own)

    def raw(self, payload: bytes, *, topic: str = VLP, attachment: bytes | None = None) -> None:
        """Send any payload."""
        if topic not in self._publishers:
            # PX4 lets Zenoh drop what it cannot send at once; a test that counts sends faster than any PX4.
            publisher = self._session.declare_publisher(
                self.key(topic), congestion_control=zenoh.CongestionControl.BLOCK, express=True
            )
            self._publishers[topic] = publisher
            wait_for(
                lambda: cast("zenoh.MatchingStatus", publisher.matching_status).matching, what="the service to listen"
            )
        self._publishers[topic].put(payload, attachment=attachment)

    def reboot(self) -> None:
        self._sequences.clear()


@pytest.fixture
def every(bus: nedbus.Bus) -> Iterator[nedbus.Subscription]:
    """Read everything that the service publishes."""
    with bus.subscribe(mode="every") as subscription:
        yield subscription


def status(bus: nedbus.Bus) -> dict[str, Any]:
    """Return what the service says of its one source."""
    services = cast("list[dict[str, Any]]", bus.services())
    return services[0]["sources"][0] if services else {}


def take(subscription: nedbus.Subscription, count: int) -> list[nedbus.Sample]:
    return [subscription.receive(DEADLINE) for _ in range(count)]


@pytest.fixture
def serve(run_nedbus: Start, endpoint: str) -> Serve:
    """Start a service that listens to PX4s on its own router."""
    return lambda options="": run_nedbus("serve", "--connect", endpoint, "-s", f"px4-zenoh:{options}")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_read_by_its_hash(serve: Serve, raw: Session, every: nedbus.Subscription, layout: str) -> None:
    """A vehicle of any release is read as it sends, and says which fields that release does not have."""
    serve()
    px4 = Px4(raw, layout=layout)
    for timestamp in range(1, 11):
        px4.put(timestamp, x=0.1 * timestamp, xy_valid=True, y=-1.0, hagl_max_z=5.0)
    for timestamp, sample in enumerate(take(every, 10), 1):
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
    assert {str(sample.address): sample.message.timestamp for sample in take(every, len(names))} == {
        address: timestamp for timestamp, address in enumerate(names.values(), 1)
    }


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("", {"1", "domain1", "px4_2", "domain3-swarm-px4_3"}),
        ("?vehicle=leader&vehicles=1:wing,px4_2:tail,swarm/px4_3:last", {"leader", "wing", "tail", "last"}),
    ],
)
def test_vehicles_are_told_apart(
    serve: Serve, raw: Session, every: nedbus.Subscription, options: str, expected: set[str]
) -> None:
    """In SITL all vehicles have one gid: domain and namespace tell them apart, named as the options say."""
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
    samples = take(every, 80)
    assert {sample.vehicle for sample in samples} == expected
    for vehicle in expected:
        assert [s.message.timestamp for s in samples if s.vehicle == vehicle] == list(range(1, 21))


def test_only_the_domain_that_is_asked_for(serve: Serve, raw: Session, every: nedbus.Subscription) -> None:
    """With a domain, others are not listened to, and the vehicle has the service's name."""
    serve("?domain=5")
    five = Px4(raw, domain=5)
    five.put(1)
    raw.put(Px4(raw, domain=6).key(), encode_cdr(downgrade(message(2), "1.16"), layout="1.16"))
    five.put(3)
    assert [(sample.vehicle, sample.message.timestamp) for sample in take(every, 2)] == [("1", 1), ("1", 3)]


def test_loss_and_reboot_are_seen(serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription) -> None:
    """What was lost before the service is counted by PX4's sequence; a sequence that goes back is a reboot."""
    service = serve()
    px4 = Px4(raw)
    px4.put(1)
    px4.put(2, skip=3)
    px4.reboot()
    px4.put(3)
    px4.put(4, skip=1)
    assert [sample.message.timestamp for sample in take(every, 4)] == [1, 2, 3, 4]
    now = status(bus)
    assert (now["lost"], now["reboots"], now["published"], now["rejected"]) == (4, 1, 4, 0)
    assert "started again" in service.err


def test_plain_publisher_needs_no_attachment(serve: Serve, raw: Session, every: nedbus.Subscription) -> None:
    """Any Zenoh client may send CDR on such a key."""
    serve()
    px4 = Px4(raw)
    px4.raw(encode_cdr(downgrade(message(9), "1.16"), layout="1.16"))
    assert every.receive(DEADLINE).message.timestamp == 9


def test_type_hash_not_supported(serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription) -> None:
    """A build without hashes is refused with words that say what to do, and read once the layout is named."""
    service = serve()
    px4 = Px4(raw, layout="1.14")
    px4.type_hash = NO_HASH
    px4.put(1)
    wait_for(lambda: "name the layout, as in px4-zenoh:?layout=1.14" in service.err, what="the refusal")
    assert status(bus)["rejected"] == 1
    service.kill()
    second = serve("?layout=1.14")
    wait_for(lambda: "listening" in second.err, what="the second service")
    px4 = Px4(raw, layout="1.14", domain=2)
    px4.type_hash = NO_HASH
    px4.put(2)
    assert every.receive(DEADLINE).message.timestamp == 2


def test_hostile_input_is_counted_and_named(
    serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription
) -> None:
    """Wrong hashes, lengths, attachments and 10,000 random payloads: counted, named once, nothing published."""
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
    wait_for(lambda: status(bus)["rejected"] == 18 + 10_000 + 3, what="all refusals to be counted")
    good.put(2)
    samples = take(every, 2)
    assert [(sample.vehicle, sample.message.timestamp) for sample in samples] == [("1", 1), ("1", 2)]
    assert every.counts.received == 2
    assert status(bus)["published"] == 2
    refusals = [line for line in service.err.splitlines() if "refused" in line]
    assert sum(64 * "0" in line for line in refusals) == 1
    assert len(refusals) <= 8, refusals
    assert any("update nedbus" in warning for warning in status(bus)["warnings"])


def test_what_the_model_refuses_is_rejected(
    serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription
) -> None:
    """A payload that is CDR but no valid estimate is reported with its reason, as from any source."""
    serve()
    reports = raw.declare_subscriber("nedbus/@rejected/**", zenoh.handlers.FifoChannel(10))
    px4 = Px4(raw)
    px4.raw(encode_cdr({**downgrade(message(1), "1.16"), "xy_valid": True}, layout="1.16"))
    px4.raw(encode_cdr({**downgrade(message(1), "1.16"), "eph": -1.0}, layout="1.16") + b"too long")
    assert "must be finite while xy_valid is true" in reports.handler.recv().payload.to_string()
    assert "228 bytes, where layout 1.16 has 220" in reports.handler.recv().payload.to_string()
    px4.put(2)
    assert every.receive(DEADLINE).message.timestamp == 2


def test_our_own_bridge_is_refused(serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription) -> None:
    """What a nedbus gave to ROS 2 does not come back, whoever hands it on."""
    service = serve()
    px4 = Px4(raw)
    px4.put(1, attachment=bytes(Attachment(1, 1, make_gid())))
    px4.put(2)
    assert every.receive(DEADLINE).message.timestamp == 2
    assert status(bus)["rejected"] == 0
    assert service.err.count("would loop") == 1


def test_two_vehicles_with_one_id_on_one_key_are_not_mixed(
    serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription
) -> None:
    """Two simulated PX4s in one domain without namespaces: one of them is heard, the other refused, in two words."""
    service = serve()
    one, other = Px4(raw), Px4(raw)
    for timestamp in range(1, 101):
        one.put(1000 + timestamp, skip=1000 if timestamp == 1 else 0)
        other.put(timestamp)
    times = [sample.message.timestamp for sample in take(every, 100)]
    assert sum(time < 1000 for time in times) <= 2
    wait_for(lambda: status(bus)["rejected"] >= 98, what="the refusals")
    assert status(bus)["reboots"] <= 2
    assert "give each a namespace or a domain" in service.err
    assert len(service.err.splitlines()) < 10


def test_two_publishers_of_one_key_are_not_mixed(
    serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription
) -> None:
    """Two ROS 2 nodes on one topic have different ids: the first one is heard."""
    serve()
    px4 = Px4(raw)
    for sequence in range(1, 11):
        px4.put(sequence, attachment=bytes(Attachment(sequence, 0, GID)))
        px4.put(100 + sequence, attachment=bytes(Attachment(sequence, 0, GID[::-1])))
    assert [sample.message.timestamp for sample in take(every, 10)] == list(range(1, 11))
    wait_for(lambda: status(bus)["rejected"] == 10, what="the refusals")


def test_hostile_keys_leave_the_status_readable(serve: Serve, raw: Session, bus: nedbus.Bus) -> None:
    """Long keys and long reasons do not make a status that nobody can receive."""
    serve()
    px4 = Px4(raw)
    px4.put(1)
    for number in range(100):
        raw.put(f"0/{'a' * 4000}{number}/{dds_type(ROS2_TYPE)}/{type_hash('1.16')}", b"")
        raw.put(f"0/{'a' * 300}{number}/{dds_type(ROS2_TYPE)}/{type_hash('1.16')}", b"")
    wait_for(lambda: status(bus).get("rejected") == 200, what="the status")


def test_service_listens_at_its_own_router(run_nedbus: Start, tmp_path: Path) -> None:
    """A router by file, or one that joins another which is away, is where its own vehicles are heard."""
    where, away = free_endpoint(), free_endpoint()
    file = tmp_path / "router.json5"
    listen = f'listen: {{endpoints: ["{where}"]}}'
    file.write_text(f'{{mode: "router", {listen}, scouting: {{multicast: {{enabled: false}}}}}}')
    for arguments in (["--router-config", str(file)], ["--listen", where, "--connect", away]):
        service = run_nedbus("serve", *arguments, "-s", "px4-zenoh:")
        with nedbus.connect(where, timeout=DEADLINE) as bus, bus.subscribe() as subscription:
            Px4(bus._session).put(1)
            assert subscription.receive(DEADLINE).message.timestamp == 1
        service.kill()


def test_domain_and_namespace_make_a_name(serve: Serve, raw: Session, every: nedbus.Subscription) -> None:
    """A domain's vehicle is the first part of the name of those that have a namespace too."""
    serve("?vehicles=5:tail,/px4_2:wing")
    for namespace in ("", "px4_1", "px4_2"):
        Px4(raw, domain=5, namespace=namespace).put(1)
    assert {sample.vehicle for sample in take(every, 3)} == {"tail", "tail-px4_1", "wing"}


def test_second_speaker_is_refused(serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription) -> None:
    """Two keys that would be one vehicle's topic are not mixed: the first one stays, the other is named."""
    service = serve()
    one, other = Px4(raw), Px4(raw, layout="V0")
    one.put(1)
    other.put(2)
    one.put(3)
    assert [sample.message.timestamp for sample in take(every, 2)] == [1, 3]
    assert status(bus)["rejected"] == 1
    assert "already: name one of them with vehicles=" in service.err


def test_silent_vehicle_is_no_longer_listed(
    serve: Serve, raw: Session, bus: nedbus.Bus, every: nedbus.Subscription
) -> None:
    """A vehicle that says nothing for 3 s is silent in the status and not listed; one that goes on is untouched."""
    serve()
    px4, other = Px4(raw), Px4(raw, domain=1)
    px4.put(1)
    every.receive(DEADLINE)

    def is_silent() -> bool:
        other.put(time.monotonic_ns())
        return bool(status(bus)["silent"] == [f"1/{VLP}"])

    assert status(bus)["state"] == "running"
    wait_for(is_silent, what="the silence to be seen")
    assert list(bus.vehicles()) == ["domain1"]
    px4.put(2)
    wait_for(lambda: status(bus)["silent"] == [], what="the vehicle to be back")
    assert {"1", "domain1"} >= set(bus.vehicles()) >= {"1"}


def test_two_services_are_not_needed(run_nedbus: Start) -> None:
    """A vehicle can connect to the service itself: it is the router."""
    endpoint = free_endpoint()
    run_nedbus("serve", "--listen", endpoint, "-s", "px4-zenoh:")
    with nedbus.connect(endpoint, timeout=DEADLINE) as bus, bus.subscribe() as subscription:
        px4 = Px4(bus._session)
        px4.put(1)
        assert subscription.receive(DEADLINE).message.timestamp == 1


def test_router_that_is_away_is_waited_for(run_nedbus: Start) -> None:
    """A router of the vehicle's that is not there is an error in the status, tried again, and nobody else's."""
    endpoint, far = free_endpoint(), free_endpoint()
    service = run_nedbus("serve", "--listen", endpoint, "-s", f"px4-zenoh:{far}", "-s", "sim:")
    with nedbus.connect(endpoint, timeout=DEADLINE) as bus, bus.subscribe(vehicle="7") as subscription:
        wait_for(lambda: "no Zenoh router answers there" in service.err, what="the first try")
        run_nedbus("router", "--listen", far)
        with nedbus.connect(far, timeout=DEADLINE) as other:
            px4 = Px4(other._session, namespace="7")
            px4.put(1)
            assert subscription.receive(DEADLINE).message.timestamp == 1


@pytest.mark.parametrize(
    "key",
    ["", "0", "0/a/b", "x/fmu/out/a/b/c", "0//a/b/c", "0/*/a/b", f"{10**12}/a/b/c", "-1/a/b/c", "0/a/b/"],
)
def test_other_keys_are_refused(key: str) -> None:
    """A key that rmw_zenoh would not write is no topic."""
    with pytest.raises(DecodeError):
        TopicKey.parse(key)


def test_key_and_attachment_come_back() -> None:
    """What is parsed is what was written."""
    key = TopicKey(3, "px4_1/fmu/out/vehicle_local_position", dds_type(ROS2_TYPE), type_hash("V0"))
    assert TopicKey.parse(str(key)) == key
    attachment = Attachment(7, 123456789, GID)
    assert len(bytes(attachment)) == 33
    assert Attachment.parse(bytes(attachment)) == attachment
