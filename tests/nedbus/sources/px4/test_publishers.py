"""Publishers of rmw_zenoh: duplicates and restarts, detected by liveliness tokens of a real PX4 and of ROS 2 nodes."""

from __future__ import annotations

import pytest

from nedbus import limits
from nedbus.sources.options import Px4ZenohOptions
from nedbus.sources.px4.streams import NotAcceptedError, Px4Stream, StreamRegistry
from nedbus.transport import Attachment, PublisherToken, TopicKey
from nedbus_msgs import DecodeError, dds_type
from tests.flights.local_position import ROS2_TYPE, type_hash
from tests.flights.messages import VLP

GID = bytes.fromhex("aabbcc00000000000000000000000000")  # gid of every PX4 in SITL
# From ../shared/data/px4/gps_loss_zenoh.jsonl.gz.
REAL = (
    "@ros2_lv/0/7f683599e27664034d4ab1bf80ed5a2f/0/11/MP/%/%/px4_aabbcc00000000000000000000000000/"
    f"%fmu%out%vehicle_local_position/px4_msgs::msg::dds_::VehicleLocalPosition_/{type_hash('1.16')}/::,7:,:,:,,"
)


def key(topic: str = VLP, *, domain: int = 0) -> TopicKey:
    """Return the key of a topic as PX4 writes it."""
    return TopicKey(domain, f"fmu/out/{topic}", dds_type(ROS2_TYPE), type_hash("1.16"))


def px4(session: str, topic: str = VLP) -> PublisherToken:
    """Return the token of a PX4 in simulation."""
    return PublisherToken.parse(
        REAL.replace("7f683599e27664034d4ab1bf80ed5a2f", session).replace(VLP, topic)
    )


def node(session: str, name: str = "talker") -> PublisherToken:
    """Return the token of a ROS 2 node, which does not contain its gid."""
    return PublisherToken.parse(key().token("MP", session, name, 1))


def send(
    streams: StreamRegistry, stream: Px4Stream, sequence: int, now: float, gid: bytes = GID
) -> tuple[int, bool]:
    """Feed one message; return the messages lost before it, and True if its vehicle rebooted."""
    return streams.accept(stream, Attachment(sequence, 0, gid), now)


@pytest.fixture
def streams() -> StreamRegistry:
    """Return a registry with default options for a service of vehicle 1."""
    return StreamRegistry(Px4ZenohOptions.model_validate({}), vehicle="1")


def test_token_of_real_px4_is_parsed() -> None:
    """A token contains the key of the messages and, for PX4 but not for ROS 2, the gid of the node."""
    token = PublisherToken.parse(REAL)
    assert (
        str(token.key)
        == f"0/fmu/out/{VLP}/px4_msgs::msg::dds_::VehicleLocalPosition_/{type_hash('1.16')}"
    )
    assert (token.session, token.gid) == ("7f683599e27664034d4ab1bf80ed5a2f", GID)
    assert node("a").gid is None


@pytest.mark.parametrize(
    "text",
    ["", "a", REAL.replace("MP", "MS"), REAL + "/x", REAL.replace("/0/7", "/x/7"), 99 * REAL],
)
def test_invalid_token_raises(text: str) -> None:
    """A token that rmw_zenoh would not declare for a publisher raises DecodeError."""
    with pytest.raises(DecodeError):
        PublisherToken.parse(text)


def test_vehicles_with_same_gid_are_rejected_until_one_is_gone(streams: StreamRegistry) -> None:
    """Both publishers of a key are rejected while they have the same gid.

    The remaining publisher's sequence may then start anywhere, which counts as neither a loss nor a reboot.
    """
    stream = streams.on_message(str(key()), 0.0)
    streams.add_publisher(px4("a"), 100.0)
    assert send(streams, stream, 7, 100.1) == (0, False)
    streams.add_publisher(px4("b"), 100.2)
    for number in range(100):
        with pytest.raises(
            NotAcceptedError, match="two publishers on this key have the same gid; give each"
        ):
            send(streams, stream, number, 100.2 + number)
    streams.remove_publisher(px4("a"), 201.0)
    with pytest.raises(NotAcceptedError, match="the same gid"):
        send(streams, stream, 900, 201.9)  # its last messages may arrive after its token is gone
    assert send(streams, stream, 30, 202.1) == (0, False)
    assert send(streams, stream, 31, 202.2) == (0, False)


def test_queued_messages_of_vanished_vehicles_are_rejected(streams: StreamRegistry) -> None:
    """After two vehicles with the same gid lose their link, queued messages are rejected for a second.

    The key has no publishers as soon as both tokens are gone.
    """
    stream = streams.on_message(str(key()), 0.0)
    for session in ("a", "b"):
        streams.add_publisher(px4(session), 0.0)
    assert not streams.remove_publisher(px4("a"), 10.0)
    assert streams.remove_publisher(px4("b"), 10.0)
    with pytest.raises(NotAcceptedError, match="the same gid"):
        send(streams, stream, 1, 10.9)
    streams.report(11.0)
    assert send(streams, stream, 2, 11.0) == (0, False)


def test_topics_of_one_vehicle_may_share_a_gid(streams: StreamRegistry) -> None:
    """Publishers with one gid in one session, or in two sessions with different topics, are one vehicle."""
    stream = streams.on_message(str(key()), 0.0)
    for token in (
        px4("a"),
        px4("a", "external_ins_local_position"),
        px4("b", "estimator_local_position_0"),
    ):
        streams.add_publisher(token, 100.0)
    assert send(streams, stream, 1, 100.1) == (0, False)


def test_reconnected_vehicle_is_accepted_at_once(streams: StreamRegistry) -> None:
    """A publisher silent for 3 s does not block its successor, because a router detects a dead link only after 10 s."""
    stream = streams.on_message(str(key()), 0.0)
    streams.add_publisher(px4("a"), 100.0)
    send(streams, stream, 500, 100.0)
    streams.add_publisher(px4("b"), 103.0)
    assert send(streams, stream, 1, 103.1) == (0, True)
    streams.remove_publisher(px4("a"), 109.0)
    assert send(streams, stream, 2, 109.1) == (0, False)


def test_ros_2_nodes_of_same_name_are_distinguished_by_gid(streams: StreamRegistry) -> None:
    """Messages of the first node are published; the second node's are rejected while both exist."""
    stream = streams.on_message(str(key()), 0.0)
    streams.add_publisher(node("a"), 100.0)
    assert send(streams, stream, 1, 100.0, b"a" * 16) == (0, False)
    streams.add_publisher(node("b"), 100.0)
    with pytest.raises(NotAcceptedError, match="two publishers share this key"):
        send(streams, stream, 1, 100.1, b"b" * 16)
    assert send(streams, stream, 2, 100.2, b"a" * 16) == (0, False)


def test_restarted_ros_2_publisher_is_accepted_at_once(streams: StreamRegistry) -> None:
    """A publisher that restarts with a new token is accepted at once; the restart counts as a reboot without losses."""
    stream = streams.on_message(str(key()), 0.0)
    streams.add_publisher(node("a"), 100.0)
    send(streams, stream, 41, 100.0, b"a" * 16)
    streams.remove_publisher(node("a"), 100.1)
    streams.add_publisher(node("b"), 100.2)
    assert send(streams, stream, 1, 100.3, b"b" * 16) == (0, True)
    assert send(streams, stream, 2, 100.4, b"b" * 16) == (0, False)


def test_reboot_is_counted_once_per_vehicle(streams: StreamRegistry) -> None:
    """Each reboot counts once, whichever topic reveals it first."""
    topics = (
        VLP,
        "vehicle_local_position_groundtruth",
        "estimator_local_position_0",
        "estimator_local_position_1",
    )
    vehicle = [streams.on_message(str(key(topic)), 0.0) for topic in topics]
    other = streams.on_message(str(key(domain=1)), 0.0)
    for now in (100.0, 110.0, 120.0):
        sequence = round(50 - now / 10)
        reboots = [send(streams, stream, sequence, now)[1] for stream in [*vehicle, other]]
        assert sum(reboots[:4]) == (now > 100.0)
        assert reboots[4] is (now > 100.0)
        vehicle.reverse()


def test_number_of_publishers_of_a_key_is_limited(streams: StreamRegistry) -> None:
    """At most 64 tokens are stored for one key, and withdrawn tokens are removed."""
    tokens = [node(str(number)) for number in range(100)]
    for token in tokens:
        streams.add_publisher(token, 0.0)
    assert len(streams.on_message(str(key()), 0.0).tokens) == 64
    for token in tokens:
        streams.remove_publisher(token, 0.0)
    streams.report(1.0)
    assert not streams._streams


def test_number_of_keys_is_limited(
    monkeypatch: pytest.MonkeyPatch, streams: StreamRegistry
) -> None:
    """The number of keys is limited; keys of withdrawn publishers without an accepted message do not count."""
    monkeypatch.setattr(limits, "PX4_KEYS", 3)
    streams.add_publisher(px4("a"), 0.0)
    for domain in (1, 2):
        streams.on_message(str(key(domain=domain)), 0.0)
    with pytest.raises(NotAcceptedError, match="more than 3 keys; choose a domain"):
        streams.on_message(str(key(domain=3)), 0.0)
    streams.report(0.0)
    streams.on_message(str(key(domain=3)), 0.0)


@pytest.mark.slow
def test_silent_keys_without_publisher_are_removed(streams: StreamRegistry) -> None:
    """A key without a publisher is removed after a minute of silence, so vehicles that left use no memory."""
    token = px4("a")
    streams.add_publisher(token, 0.0)
    for number in range(3000):
        now = float(number)
        stream = streams.on_message(
            str(TopicKey(0, f"v{number}/fmu/out/{VLP}", dds_type(ROS2_TYPE), type_hash("1.16"))),
            now,
        )
        streams.wire_format_of(stream)
        send(streams, stream, 1, now)
        streams.report(now)
    sizes = len(streams._streams), len(streams._owners), len(streams._reboots)
    assert sizes == (61, 60, 0)
    assert str(token.key) in streams._streams
