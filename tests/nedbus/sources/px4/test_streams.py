"""Ownership of addresses and loss counting for messages of rmw_zenoh, with a fake clock; keys and attachments."""

from __future__ import annotations

import pytest

from nedbus.sources.options import Px4ZenohOptions
from nedbus.sources.px4.streams import NotAcceptedError, StreamRegistry, TypeHashes
from nedbus.transport import NO_HASH, Attachment, TopicKey
from nedbus_msgs import (
    MESSAGES,
    DecodeError,
    dds_type,
    define_msg,
    hash_of,
    hash_of_msg,
    ros2_type,
)
from tests.flights.local_position import ROS2_TYPE, type_hash
from tests.flights.messages import VLP

GID = bytes(range(16))


@pytest.mark.parametrize(
    "key",
    [
        "",
        "0",
        "0/a/b",
        "x/fmu/out/a/b/c",
        "0//a/b/c",
        "0/*/a/b",
        f"{10**12}/a/b/c",
        "-1/a/b/c",
        "0/a/b/",
    ],
)
def test_invalid_key_raises(key: str) -> None:
    """A key that rmw_zenoh would not use raises DecodeError."""
    with pytest.raises(DecodeError):
        TopicKey.parse(key)


def test_key_and_attachment_round_trip() -> None:
    """Parsing a serialised key or attachment returns the original."""
    key = TopicKey(3, "px4_1/fmu/out/vehicle_local_position", dds_type(ROS2_TYPE), type_hash("V0"))
    assert TopicKey.parse(str(key)) == key
    for attachment in (Attachment(7, 123456789, GID), Attachment(0, 0, GID)):
        assert len(bytes(attachment)) == 33
        assert Attachment.parse(bytes(attachment)) == attachment


def key(
    *, domain: int = 0, namespace: str = "", layout: str = "1.16", direction: str = "out"
) -> str:
    """Return PX4's key of vehicle_local_position."""
    topic = f"{namespace and namespace + '/'}fmu/{direction}/{VLP}"
    return str(TopicKey(domain, topic, dds_type(ROS2_TYPE), type_hash(layout)))


@pytest.fixture
def streams() -> StreamRegistry:
    """Return a registry with default options, for a service whose vehicle is 1."""
    return StreamRegistry(Px4ZenohOptions.model_validate({}), vehicle="1")


@pytest.mark.parametrize("is_literal", [False, True])
def test_hash_with_literal_char_is_recognized(streams: StreamRegistry, is_literal: bool) -> None:
    """The format of a stream says whether the publisher's type hash takes char literally, unlike ROS 2."""
    definition = MESSAGES["LogMessage"]
    name = ros2_type(definition)
    digest = hash_of(definition.current, name, literal_char=is_literal)
    topic = TopicKey(0, "fmu/out/log_message", dds_type(name), digest)
    form = streams.wire_format_of(streams.on_message(str(topic), 100.0))
    assert (form.definition, form.layout.types, form.is_literal) == (
        definition, definition.current.types, is_literal,
    )  # fmt: skip


def test_key_without_type_hash_needs_a_single_definition() -> None:
    """A key without a type hash is decoded with the only definition of its message; with two it is ambiguous."""
    topic = TopicKey(0, "fmu/out/thing", "px4_msgs::msg::dds_::Thing_", NO_HASH)
    definitions = {}
    for field in ("a", "b"):
        text = f"uint64 timestamp\nfloat32 {field}\n"
        digest = hash_of_msg("Thing", text)
        definitions[TypeHashes(digest, digest)] = define_msg("Thing", text)
        streams = StreamRegistry(
            Px4ZenohOptions(), vehicle="1", supplied={topic.dds_type: definitions}
        )
        stream = streams.on_message(str(topic), 100.0)
        if field == "a":
            assert "a" in streams.wire_format_of(stream).layout.types
    with pytest.raises(
        NotAcceptedError, match=r"Thing\.msg has the type hash .* or .*; use the file"
    ):
        streams.wire_format_of(stream)


def test_address_is_released_after_3_s(streams: StreamRegistry) -> None:
    """The first key owns an address until it is silent for 3 s; then another key may use it."""
    first, second = streams.on_message(key(), 100.0), streams.on_message(key(layout="V0"), 100.0)
    assert (streams.on_message(key(), 100.0), str(second.address)) == (first, f"1/{VLP}")
    streams.accept(first, None, 100.0)
    with pytest.raises(NotAcceptedError, match="rename one of them with vehicles="):
        streams.accept(second, None, 102.9)
    streams.accept(second, None, 103.0)
    with pytest.raises(NotAcceptedError, match="already"):
        streams.accept(first, None, 104.0)


def test_key_is_released_after_3_s(streams: StreamRegistry) -> None:
    """The first publisher owns a key until it is silent for 3 s; the sequence of the next one may start anywhere."""
    stream = streams.on_message(key(), 100.0)
    streams.accept(stream, Attachment(7, 0, GID), 100.0)
    other = Attachment(500, 0, GID[::-1])
    with pytest.raises(NotAcceptedError, match="two publishers share this key"):
        streams.accept(stream, other, 102.9)
    assert streams.accept(stream, other, 103.0) == (0, False)


@pytest.mark.parametrize(
    ("sequence", "lost", "rebooted"),
    [(11, 0, False), (15, 4, False), (10 + 1_000_001, 0, False), (1, 0, True)],
)
def test_sequence_gap_counts_as_lost(
    streams: StreamRegistry, sequence: int, lost: int, rebooted: bool
) -> None:
    """A gap counts as that many lost messages, unless it is implausibly large; a step back is a reboot."""
    stream = streams.on_message(key(), 100.0)
    for each, expected in (
        (10, (0, False)),
        (sequence, (lost, rebooted)),
        (sequence + 1, (0, False)),
    ):
        assert streams.accept(stream, Attachment(each, 0, GID), 100.0) == expected


def test_sequence_that_goes_back_repeatedly_is_rejected(streams: StreamRegistry) -> None:
    """One step back is a reboot; another one within 3 s means a second vehicle with the same gid."""
    stream = streams.on_message(key(), 100.0)
    for sequence, now in ((10, 100.0), (1, 100.1), (20, 100.2)):
        streams.accept(stream, Attachment(sequence, 0, GID), now)
    with pytest.raises(NotAcceptedError, match="sequence numbers go back and forth"):
        streams.accept(stream, Attachment(2, 0, GID), 103.0)
    assert streams.accept(stream, Attachment(1, 0, GID), 106.1) == (0, True)
    with pytest.raises(NotAcceptedError, match="sequence number 1 is a duplicate"):
        streams.accept(stream, Attachment(1, 0, GID), 106.2)


@pytest.mark.parametrize("namespace", ["", "px4_1"])
def test_input_topic_has_the_vehicle_of_its_namespace(
    streams: StreamRegistry, namespace: str
) -> None:
    """/fmu/in/... belongs to the vehicle of /fmu/out/...; a restart of its publisher is not a reboot of the vehicle."""
    stream = streams.on_message(key(namespace=namespace, direction="in"), 100.0)
    assert (str(stream.address), stream.is_input) == (f"{namespace or 1}/{VLP}", True)
    for sequence in (10, 1):
        assert streams.accept(stream, Attachment(sequence, 0, GID), 100.0) == (0, False)
