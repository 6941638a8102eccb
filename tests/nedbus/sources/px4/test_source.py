"""The source `px4-zenoh:`, with a simulated Zenoh module of PX4 and other publishers on the same keys."""

from __future__ import annotations

import json
import random
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

import pytest
import zenoh
from zenoh_ros2_sdk.discovery import _parse_liveliness_keyexpr

import nedbus
from nedbus import limits
from nedbus.errors import ConfigError
from nedbus.sources import SourceMessage, parse_source
from nedbus.transport import NO_HASH, Attachment, Session, TopicKey
from nedbus_msgs import (
    ANY,
    VehicleLocalPosition,
    dds_type,
    define_msg,
    encode_with,
    hash_of,
    hash_of_msg,
    ros2_type,
)
from tests.flights.local_position import (
    LAYOUTS,
    ROS2_TYPE,
    downgrade,
    encode_cdr,
    message_definition,
    type_hash,
    upgrade,
)
from tests.flights.messages import VLP, message
from tests.nedbus.bridges.test_ros2 import Peer, flight, peer, plain_session
from tests.peers.command_line import run_command, run_until_shown
from tests.peers.live_source import Listener, source_status
from tests.peers.ports import free_endpoint
from tests.peers.processes import Process, Start
from tests.waits import DEADLINE, repeating, wait_for, wait_for_matching

__all__ = ["peer"]  # a fixture

GID = bytes(range(16))

Listen = Callable[..., Listener]


def is_read(publisher: zenoh.Publisher) -> bool:
    return cast("zenoh.MatchingStatus", publisher.matching_status).matching


class Px4:
    """Zenoh module of a PX4 that publishes like zenoh-pico, with a sequence per topic and trailing garbage."""

    def __init__(
        self, session: Session, *, domain: int = 0, namespace: str = "", layout: str = "1.16"
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
        self,
        each: VehicleLocalPosition | int,
        *,
        topic: str = VLP,
        attachment: bytes | None = None,
        skip: int = 0,
    ) -> None:
        """Send a message, or one with this timestamp; the default attachment equals PX4's."""
        sent = message(each) if isinstance(each, int) else each
        fields = downgrade(sent, self._layout)
        self._sequences[topic] = self._sequences.get(topic, 0) + 1 + skip
        default = bytes(Attachment(self._sequences[topic], sent.timestamp, GID))
        extra = {"1.13": 12, "1.14": 8, "1.15": 8, "V0": 4, "1.16": 0}[self._layout] * b"\xa5"
        self.raw(
            encode_cdr(fields, layout=self._layout) + extra,
            topic=topic,
            attachment=attachment or default,
        )

    def raw(self, payload: bytes, *, topic: str = VLP, attachment: bytes | None = None) -> None:
        """Send any payload."""
        if topic not in self._publishers:
            # PX4's messages may be dropped, but tests send faster than any PX4, and count them.
            publisher = self._session.declare_publisher(
                self.key(topic), congestion_control=zenoh.CongestionControl.BLOCK, express=True
            )
            self._publishers[topic] = publisher
            wait_for(lambda: is_read(publisher), what="the service to subscribe")
        self._publishers[topic].put(payload, attachment=attachment)

    def reboot(self) -> None:
        self._sequences.clear()


@pytest.fixture
def every(bus: nedbus.Bus) -> Iterator[nedbus.Subscription[Any]]:
    """Receive every message of all topics that the service publishes."""
    with bus.subscribe(ANY, mode="every") as subscription:
        yield subscription


@pytest.fixture
def serve(run_nedbus: Start, endpoint: str) -> Callable[[], Process]:
    """Start a service that receives from PX4s at the test's router."""
    return lambda: run_nedbus("serve", "--connect", endpoint, "-s", "px4-zenoh:")


@pytest.fixture
def listen(endpoint: str) -> Iterator[Listen]:
    """Receive from PX4s at the test's router, without a service."""
    with ExitStack() as closing:
        yield lambda options="": closing.enter_context(
            Listener(f"px4-zenoh:{options}", routers=(endpoint,))
        )


@pytest.fixture
def listener(listen: Listen) -> Listener:
    """Receive from PX4s with the default options."""
    return listen()


def payload_of(timestamp: int, **fields: object) -> bytes:
    return encode_cdr({**downgrade(message(timestamp), "1.16"), **fields}, layout="1.16")


def times(messages: Iterable[SourceMessage]) -> list[object]:
    return [each.fields["timestamp"] for each in messages]


@pytest.mark.slow
def test_message_of_px4_reaches_readers(
    serve: Callable[[], Process], zenoh_session: Session, every: nedbus.Subscription
) -> None:
    """A service publishes PX4's message for its vehicle; `sample.missing` has the fields that the release lacks."""
    serve()
    px4 = Px4(zenoh_session, layout="1.14")
    sent = message(1, x=0.1, xy_valid=True, y=-1.0, hagl_max_z=5.0)
    px4.put(sent)
    sample, expected = every.receive(DEADLINE), upgrade(downgrade(sent, "1.14"))
    assert sample.message == expected
    assert (sample.vehicle, sample.topic, sample.source) == ("1", VLP, "px4-zenoh")
    assert sample.missing == frozenset(LAYOUTS["1.16"].fields) - expected.model_fields_set


def test_layout_is_selected_by_type_hash(listener: Listener, zenoh_session: Session) -> None:
    """Messages of any release are received with exactly the fields of this release."""
    for domain, layout in enumerate(LAYOUTS):
        px4 = Px4(zenoh_session, layout=layout, domain=domain)
        sent = [
            message(each, x=0.1 * each, xy_valid=True, y=-1.0, hagl_max_z=5.0)
            for each in range(1, 11)
        ]
        for each in sent:
            px4.put(each)
        received = listener.receive(10)
        assert all(each.fields.keys() == {*LAYOUTS[layout].fields} for each in received)
        assert [(upgrade(each.fields), each.lost) for each in received] == [
            (upgrade(downgrade(each, layout)), 0) for each in sent
        ]


def test_topic_names_map_to_addresses(listener: Listener, zenoh_session: Session) -> None:
    """Topics, instances in either notation, and versioned topics map to the addresses of the service."""
    px4 = Px4(zenoh_session)
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
    received = {
        str(each.address): each.fields["timestamp"] for each in listener.receive(len(names))
    }
    assert received == {address: timestamp for timestamp, address in enumerate(names.values(), 1)}


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("", ["1", "domain5", "domain5-px4_1", "px4_2", "domain3-swarm-px4_3"]),
        (
            "?vehicle=lead&vehicles=5:wing,px4_2:tail,swarm/px4_3:end",
            ["lead", "wing", "wing-px4_1", "tail", "end"],
        ),
        ("?domain=5", ["1", "px4_1"]),
    ],
)
def test_vehicles_are_named_by_domain_and_namespace(
    listen: Listen, zenoh_session: Session, options: str, expected: list[str]
) -> None:
    """All vehicles in SITL have the same gid; `vehicles=` renames them, and `domain=` ignores other domains."""
    listener = listen(options)
    places = ((0, ""), (5, ""), (5, "px4_1"), (0, "px4_2"), (3, "swarm/px4_3"))
    expected_places = [place for place in places if options != "?domain=5" or place[0] == 5]
    fleet = [
        Px4(zenoh_session, domain=domain, namespace=namespace)
        for domain, namespace in expected_places
    ]
    for domain, namespace in set(places) - set(expected_places):
        zenoh_session.put(
            Px4(zenoh_session, domain=domain, namespace=namespace).key(), payload_of(2)
        )
    for timestamp in range(1, 21):
        for px4 in fleet:
            px4.put(timestamp)
    received = listener.receive(20 * len(fleet))
    for vehicle in expected:
        assert times(each for each in received if each.address.vehicle == vehicle) == list(
            range(1, 21)
        )
    assert not listener.rejections


def test_loss_and_reboot_are_counted(
    listener: Listener, zenoh_session: Session, caplog: pytest.LogCaptureFixture
) -> None:
    """PX4's sequence numbers reveal losses before the service; a backward step is a reboot."""
    caplog.set_level("WARNING")
    px4 = Px4(zenoh_session)
    px4.put(1)
    px4.put(2, skip=3)
    px4.reboot()
    px4.put(3)
    px4.put(4, skip=1)
    px4.raw(payload_of(5))  # like any Zenoh client, without an attachment
    received = [
        (each.fields["timestamp"], each.lost, each.rebooted) for each in listener.receive(5)
    ]
    assert received == [(1, 0, False), (2, 3, False), (3, 0, True), (4, 1, False), (5, 0, False)]
    assert not listener.rejections
    assert caplog.text.count("counted as a reboot of the vehicle") == 1


def test_key_without_type_hash_needs_layout(listen: Listen, zenoh_session: Session) -> None:
    """Messages without type hashes are rejected with a hint, and received once the layout is configured."""
    px4 = Px4(zenoh_session, layout="1.14")
    px4.type_hash = NO_HASH
    first, second = listen(), listen("?layout=1.14")
    px4.put(1)
    first.step_until(lambda: first.rejections, what="the rejection")
    assert "choose a layout, as in px4-zenoh:?layout=1.14" in first.rejections[0].reason
    assert times(second.receive()) == [1]


@pytest.mark.slow
@pytest.mark.parametrize("type_hash_of_key", [type_hash("1.16"), NO_HASH])
@pytest.mark.parametrize("trailer", [b"", 8 * b"\xa5"])
def test_payloads_of_another_layout_are_explained(
    run_nedbus: Start,
    endpoint: str,
    zenoh_session: Session,
    bus: nedbus.Bus,
    *,
    type_hash_of_key: str,
    trailer: bytes,
) -> None:
    """`info` and `doctor` name the release whose layout the payloads have, from ROS 2 or with the bytes PX4 appends."""
    run_nedbus("serve", "--connect", endpoint, "-s", "px4-zenoh:?layout=1.16")
    px4 = Px4(zenoh_session, layout="1.15")
    px4.type_hash = type_hash_of_key
    fields = downgrade(message(1, x=1.0, y=2.0, xy_valid=True), "1.15")
    for _ in range(3):
        px4.raw(encode_cdr(fields, layout="1.15") + trailer)
    wait_for(lambda: source_status(bus).rejected >= 3, what="the rejections")
    reason = (
        f"{204 + len(trailer)} bytes, expected 220 for layout 1.16; they fit the layout of PX4 1.15"
    )
    for command in ("info", "doctor"):
        shown = " ".join(run_command(command, "--connect", endpoint).out.split())
        assert reason in shown
        assert "rebuild px4_msgs at release/1.15" in shown


WHEELS = "uint64 timestamp\nfloat32[2] wheel_speed  # [rad/s] @range 0, 500\nuint8 COUNT = 2\n"


@pytest.mark.slow
def test_user_definition_adds_a_message(
    run_nedbus: Start, endpoint: str, zenoh_session: Session, bus: nedbus.Bus, tmp_path: Path
) -> None:
    """With msg= the message is published, range-checked and readable without the file; without, it is "not carried"."""
    (tmp_path / "WheelEncoders.msg").write_text(WHEELS)
    definition = define_msg("WheelEncoders", WHEELS)
    name = ros2_type(definition)
    key = f"0/fmu/out/wheel_encoders/{dds_type(name)}/{hash_of(definition.current, name)}"
    service = run_nedbus("serve", "--connect", endpoint, "-s", "px4-zenoh:")
    wait_for_matching(zenoh_session, key)
    token = zenoh_session.liveliness().declare_token(
        TopicKey.parse(key).token("MP", "px4", "px4", 1)
    )
    zenoh_session.put(key, b"")
    wait_for(
        lambda: source_status(bus).not_carried == ("WheelEncoders",), what="the unsupported message"
    )
    assert source_status(bus).rejected == 0
    run_until_shown("not carried: WheelEncoders", "info", "--connect", endpoint)
    token.undeclare()
    wait_for(lambda: source_status(bus).not_carried == (), what="no unsupported message")
    service.kill()
    run_nedbus("serve", "--connect", endpoint, "-s", f"px4-zenoh:?msg={tmp_path}")
    wait_for_matching(zenoh_session, key)

    def put(speed: float) -> None:
        fields = {"timestamp": 1, "wheel_speed": (speed, 2.0)}
        zenoh_session.put(key, encode_with(definition, fields, definition.current) + bytes(8))

    with bus.subscribe("wheel_encoders") as wheels, repeating(lambda: put(1.5)):
        assert wheels.receive(DEADLINE).message.__dict__ == {
            "timestamp": 1,
            "wheel_speed": (1.5, 2.0),
        }
    put(501.0)
    wait_for(lambda: source_status(bus).rejected == 1, what="the message out of range")


def test_user_definition_has_timestamp_at_any_place(
    listen: Listen, zenoh_session: Session, tmp_path: Path
) -> None:
    """A message is decoded in the order of its definition, although nedbus's models begin with the timestamp."""
    text = "float32 speed\nuint64 timestamp\n"
    (tmp_path / "WheelEncoders.msg").write_text(text)
    dds_name, type_hash = (
        dds_type(ros2_type(define_msg("WheelEncoders", text))),
        hash_of_msg("WheelEncoders", text),
    )
    listener, key = listen(f"?msg={tmp_path}"), f"0/fmu/out/wheel_encoders/{dds_name}/{type_hash}"
    wait_for_matching(zenoh_session, key)
    zenoh_session.put(key, struct.pack("<4sf4xQ", b"\0\1\0\0", 2.5, 7))
    assert listener.receive()[0].fields == {"speed": 2.5, "timestamp": 7}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("LogMessage", "uint64 timestamp\nuint8 severity\nchar[127] text\n"),
        ("Letter", "uint64 timestamp\nchar letter\nbyte flags\n"),
    ],
)
def test_hash_with_literal_char_is_accepted(
    listen: Listen, zenoh_session: Session, tmp_path: Path, name: str, text: str
) -> None:
    """Messages of a library that hashes char as IDL's char are carried, although ROS 2 does not match them."""
    (tmp_path / f"{name}.msg").write_text(text)
    own, literal = hash_of_msg(name, text), hash_of_msg(name, text, literal_char=True)
    assert own != literal
    definition = define_msg(name, text)
    listener = listen(f"?msg={tmp_path}") if name == "Letter" else listen()
    topic = "letter" if name == "Letter" else "log_message"
    key = f"0/fmu/out/{topic}/{dds_type(ros2_type(definition))}/{literal}"
    wait_for_matching(zenoh_session, key)
    fields = {field: kind.absent for field, kind in definition.current.types.items()} | {
        "timestamp": 7
    }
    for _ in range(2):
        zenoh_session.put(key, encode_with(definition, fields, definition.current))
    assert [each.fields["timestamp"] for each in listener.receive(2)] == [7, 7]


def test_user_definition_decodes_newer_layout(
    listen: Listen, zenoh_session: Session, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """An unknown field is logged once; without msg=, or with a wrong file, the rejection names the remedy."""
    caplog.set_level("WARNING")
    text = message_definition("1.16") + "bool altitude_good_for_lock\n"
    (tmp_path / "VehicleLocalPosition.msg").write_text(text)
    newer = define_msg("VehicleLocalPosition", text)
    px4 = Px4(zenoh_session)
    px4.type_hash = hash_of(newer.current, ROS2_TYPE)
    without, supplied, other = (
        listen(),
        listen(f"?msg={tmp_path}/VehicleLocalPosition.msg"),
        listen(f"?msg={tmp_path}"),
    )
    fields = {**downgrade(message(1, x=0.5), "1.16"), "altitude_good_for_lock": True}
    for _ in range(2):
        px4.raw(encode_with(newer, fields, newer.current))
    assert [upgrade(each.fields).x for each in supplied.receive(2)] == [0.5, 0.5]
    assert caplog.text.count("altitude_good_for_lock") == 1
    without.step_until(lambda: without.rejections, what="the rejection")
    for word in ("VehicleLocalPosition", px4.type_hash, "px4-zenoh:?msg=VehicleLocalPosition.msg"):
        assert word in without.rejections[0].reason
    own, px4.type_hash = px4.type_hash, "RIHS01_" + 64 * "0"
    px4.raw(b"", topic=f"{VLP}_groundtruth")
    other.step_until(lambda: other.rejections, what="the rejection")
    assert own in other.rejections[0].reason
    assert px4.type_hash in other.rejections[0].reason


def test_only_selected_topics_are_received(listen: Listen, zenoh_session: Session) -> None:
    """Other topics are ignored silently; a selected topic whose message is unknown is rejected with a hint."""
    listener = listen("?topics=vehicle_local_position,wheel_encoders")
    px4 = Px4(zenoh_session)
    px4.put(1, topic="estimator_local_position")
    zenoh_session.put(
        f"0/fmu/out/wheel_encoders/{dds_type('px4_msgs/msg/WheelEncoders')}/{px4.type_hash}", b""
    )
    zenoh_session.put(
        f"0/fmu/out/tecs_status/{dds_type('px4_msgs/msg/TecsStatus')}/{px4.type_hash}", b""
    )
    px4.put(2)
    assert [str(each.address) for each in listener.receive()] == [f"1/{VLP}"]
    assert [each.count for each in listener.rejections] == [1]
    assert "px4-zenoh:?msg=WheelEncoders.msg" in listener.rejections[0].reason
    assert listener.unavailable.unsupported == ()


def test_message_of_another_type_is_rejected(listener: Listener, zenoh_session: Session) -> None:
    """A position on the topic of attitudes is not decoded as an attitude."""
    px4 = Px4(zenoh_session)
    px4.put(1, topic="vehicle_attitude")
    listener.step_until(lambda: listener.rejections, what="the rejection")
    assert "vehicle_attitude has messages of type VehicleAttitude" in listener.rejections[0].reason


@pytest.mark.parametrize(
    ("text", "where", "reason"),
    [
        ("uint64 timestamp\n  float33 x\n", "line 2, column 3", "'float33' is not a type"),
        ("uint64 timestamp\nfloat32[] x\n", "line 2, column 1", "is not a type"),
        ("uint64 timestamp\nEscReport[8] esc\n", "line 2, column 1", "'EscReport' is not a type"),
        ("uint64 timestamp\nfloat32\n", "line 2, column 1", "expected a field"),
        ("float32 x\n", "line 1, column 1", "timestamp"),
    ],
)
def test_invalid_msg_file_raises(tmp_path: Path, text: str, where: str, reason: str) -> None:
    """The error states file, line and column; an invalid file in a folder is skipped; a missing file raises."""
    file = tmp_path / "EscStatus.msg"
    file.write_text(text)
    with pytest.raises(ConfigError, match=rf"{file}: {where}: .*{reason}"):
        parse_source(f"px4-zenoh:?msg={file}").open_source(vehicle="1")
    parse_source(f"px4-zenoh:?msg={tmp_path}").open_source(vehicle="1")
    with pytest.raises(ConfigError, match=r"other\.msg: no such file"):
        parse_source(f"px4-zenoh:?msg={tmp_path},{tmp_path}/other.msg").open_source(vehicle="1")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match=r"empty: no \.msg file in this folder"):
        parse_source(f"px4-zenoh:?msg={tmp_path}/empty").open_source(vehicle="1")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1"])
def test_msg_file_encoding_is_detected(tmp_path: Path, encoding: str) -> None:
    """A byte order mark or Latin-1 is accepted, even in the file of a nested message."""
    (tmp_path / "Esc.msg").write_text("float32 rpm # 10 °\n", encoding=encoding)
    (tmp_path / "EscStatus.msg").write_text("uint64 timestamp # °\nEsc[2] esc\n", encoding=encoding)
    parse_source(f"px4-zenoh:?msg={tmp_path}/EscStatus.msg").open_source(vehicle="1")


def test_invalid_input_is_rejected_and_counted(listener: Listener, zenoh_session: Session) -> None:
    """Wrong hashes, lengths and attachments, and random payloads, are counted as rejected, by key."""
    good = Px4(zenoh_session)
    good.put(1)
    unknown = Px4(zenoh_session, domain=1)
    unknown.type_hash = "RIHS01_" + 64 * "0"
    for timestamp in range(10):
        unknown.put(timestamp)
    short = Px4(zenoh_session, domain=2)
    for payload in (b"\x00\x01\x00\x00" + bytes(100), b"", bytes(100_000)):
        short.raw(payload)
    wrong = Px4(zenoh_session, domain=3)
    for attachment in (
        b"x",
        bytes(33),
        bytes(34),
        bytes(Attachment(2**62, 0, GID))[:-1],
        16 * b"\xff" + b"\x10" + GID,
    ):
        wrong.put(1, attachment=attachment)
    noise, rng = Px4(zenoh_session, domain=4), random.Random(0)
    for each in range(2000):
        noise.raw(
            rng.randbytes(220)
            if each % 2
            else b"\x00\x01\x00\x00" + rng.randbytes(rng.randrange(240))
        )
    other = Px4(zenoh_session, domain=5)
    other.raw(payload_of(1), topic="somebody/pose")
    for start in (f"0/{'x' * 200}", "ä"):
        zenoh_session.put(f"{start}/fmu/out/{VLP}/{dds_type(ROS2_TYPE)}/{type_hash('1.16')}", b"")
    listener.step_until(lambda: listener.rejected >= 18 + 2000 + 3, what="all rejections")
    good.put(2)
    assert times(listener.receive(2)) == [1, 2]
    assert (listener.rejected, listener.messages) == (18 + 2000 + 3, [])
    assert len({each.where for each in listener.rejections}) <= 8
    assert any("update nedbus" in each.reason for each in listener.rejections)


@pytest.mark.slow
def test_invalid_values_are_reported(
    serve: Callable[[], Process], zenoh_session: Session, every: nedbus.Subscription[Any]
) -> None:
    """A payload that is valid CDR but violates a rule is reported with its reason, as from any source."""
    serve()
    reports = zenoh_session.declare_subscriber(
        "nedbus/@rejected/**", zenoh.handlers.FifoChannel(10)
    )
    px4 = Px4(zenoh_session)
    px4.raw(payload_of(1, xy_valid=True))
    px4.raw(payload_of(1, eph=-1.0) + b"too long")
    assert "must be finite while xy_valid is true" in reports.handler.recv().payload.to_string()
    assert "228 bytes, expected 220 for layout 1.16" in reports.handler.recv().payload.to_string()
    px4.put(2)
    assert every.receive(DEADLINE).message.timestamp == 2


def test_two_publishers_of_one_key_are_not_mixed(
    listener: Listener, zenoh_session: Session
) -> None:
    """Two ROS 2 nodes on one topic have different gids: only the first one is received."""
    px4 = Px4(zenoh_session)
    for sequence in range(10):
        px4.put(sequence, attachment=bytes(Attachment(sequence, 0, GID)))
        px4.put(100 + sequence, attachment=bytes(Attachment(sequence, 0, GID[::-1])))
    listener.step_until(
        lambda: len(listener.messages) + listener.rejected == 20, what="all messages"
    )
    assert times(listener.receive(10)) == list(range(10))


@pytest.mark.slow
def test_long_keys_do_not_break_the_status(
    serve: Callable[[], Process], zenoh_session: Session, bus: nedbus.Bus
) -> None:
    """Long keys and reasons do not make the status too large to be received."""
    serve()
    Px4(zenoh_session).put(1)
    for number in range(100):
        zenoh_session.put(f"0/{'a' * 4000}{number}/{dds_type(ROS2_TYPE)}/{type_hash('1.16')}", b"")
        zenoh_session.put(f"0/{'a' * 300}{number}/{dds_type(ROS2_TYPE)}/{type_hash('1.16')}", b"")
    wait_for(lambda: source_status(bus).rejected == 200, what="the status")


def test_oversized_samples_are_not_queued(listener: Listener, zenoh_session: Session) -> None:
    """Keys that are too long for ROS 2, and large payloads, are not queued, but counted as rejected."""
    name = dds_type(ROS2_TYPE)
    wait_for_matching(zenoh_session, f"0/a/{name}/hash")
    for topic, payload in (
        ("a", bytes(300)),
        ("b", bytes(5000)),
        ("x" * 2000, bytes(300)),
        ("last", bytes(300)),
    ):
        zenoh_session.put(f"0/{topic}/{name}/hash", payload)
    listener.step_until(lambda: listener.rejected == 4, what="all rejections")
    listener.step()
    counts = Counter(each.where for each in listener.rejections for _ in range(each.count))
    assert counts == {"size": 2, f"0/a/{name}/hash": 1, f"0/last/{name}/hash": 1}


class Panics:
    """A limit that panics when it is compared; like pyo3's PanicException, the error is not an Exception."""

    def __lt__(self, _: int) -> bool:
        raise BaseException("panic")  # noqa: TRY002 - see above


def test_panic_in_the_receiving_thread_fails_the_source(
    listener: Listener, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A panic of Zenoh on the receiving thread fails the source, which the service then restarts."""
    key = f"0/a/{dds_type(ROS2_TYPE)}/hash"
    wait_for_matching(zenoh_session, key)
    monkeypatch.setattr(limits, "PX4_PAYLOAD", Panics())
    zenoh_session.put(key, bytes(300))
    with pytest.raises(BaseException, match="panic"):
        listener.step_until(lambda: False, what="the error")


def test_ended_source_undeclares_its_subscriber(zenoh_session: Session, endpoint: str) -> None:
    """A source borrows the service's session, and leaves no subscriber in it."""
    probe = zenoh_session.declare_publisher(Px4(zenoh_session).key())
    with plain_session(endpoint) as session:
        with Listener("px4-zenoh:", router=session):
            wait_for(lambda: is_read(probe), what="the subscriber")
        wait_for(lambda: not is_read(probe), what="the subscriber to be undeclared")


@pytest.mark.slow
def test_vehicle_connects_to_router_of_service(run_nedbus: Start) -> None:
    """If the service is the router, its source uses the router's session, with or without an explicit endpoint."""
    own = free_endpoint()
    service = run_nedbus(
        "serve", "--listen", own, "-s", "px4-zenoh:", "-s", f"px4-zenoh:{own}?domain=3"
    )
    wait_for(lambda: service.err.count("listening") == 2, what="both sources")
    with (
        nedbus.connect(own, timeout=DEADLINE) as bus,
        bus.subscribe() as every,
        plain_session(own) as vehicle,
    ):
        Px4(vehicle).put(1)
        assert every.receive(DEADLINE).message.timestamp == 1
        [reply] = vehicle.get("@/*/router")
        assert reply.ok is not None
        assert len(json.loads(reply.ok.payload.to_bytes())["sessions"]) == 2


@pytest.mark.slow
def test_source_uses_configured_router_of_service(run_nedbus: Start, tmp_path: Path) -> None:
    """The source uses the service's router even with a configuration file, or connected to a router that is down."""
    own, down = free_endpoint(), free_endpoint()
    file = tmp_path / "router.json5"
    listen = f'listen: {{endpoints: ["{own}"]}}'
    file.write_text(f'{{mode: "router", {listen}, scouting: {{multicast: {{enabled: false}}}}}}')
    for arguments in (["--router-config", str(file)], ["--listen", own, "--connect", down]):
        service = run_nedbus("serve", *arguments, "-s", "px4-zenoh:")
        with (
            nedbus.connect(own, timeout=DEADLINE) as bus,
            bus.subscribe() as every,
            plain_session(own) as vehicle,
        ):
            Px4(vehicle).put(1)
            assert every.receive(DEADLINE).message.timestamp == 1
        service.kill()


@pytest.mark.slow
def test_unreachable_router_is_retried(run_nedbus: Start) -> None:
    """A router that does not answer is logged and retried, while other sources continue."""
    endpoint, other = free_endpoint(), free_endpoint()
    service = run_nedbus("serve", "--listen", endpoint, "-s", f"px4-zenoh:{other}", "-s", "sim:")
    with (
        nedbus.connect(endpoint, timeout=DEADLINE) as bus,
        bus.subscribe(vehicle="7") as subscription,
    ):
        wait_for(lambda: "no Zenoh router answers;" in service.err, what="the first attempt")
        run_nedbus("router", "--listen", other)
        with plain_session(other) as vehicle:
            Px4(vehicle, namespace="7").put(1)
            assert subscription.receive(DEADLINE).message.timestamp == 1


@pytest.mark.slow  # waits 3 s; nedbus/daemon/test_worker.py uses a fake clock
def test_stale_vehicle_is_not_listed(
    serve: Callable[[], Process],
    zenoh_session: Session,
    bus: nedbus.Bus,
    every: nedbus.Subscription,
) -> None:
    """A vehicle that sends nothing for 3 s is stale in the status and not listed; others are not affected."""
    service = serve()
    px4, other = Px4(zenoh_session), Px4(zenoh_session, domain=1)
    px4.put(1)
    every.receive(DEADLINE)

    def is_stale() -> bool:
        other.put(time.monotonic_ns())
        return source_status(bus).stale == (f"1/{VLP}",)

    assert source_status(bus).state == "running"
    wait_for(is_stale, what="the status to be stale")
    assert list(bus.vehicles()) == ["domain1"]
    assert f"1/{VLP} is stale: no message for " in service.err  # 3 s, or more on a busy machine
    px4.put(2)
    wait_for(lambda: source_status(bus).stale == (), what="the vehicle to return")
    assert {"1", "domain1"} >= set(bus.vehicles()) >= {"1"}


@pytest.mark.slow
def test_restarted_ros_2_publisher_is_received_at_once(listener: Listener, peer: Peer) -> None:
    """A node of zenoh-ros2-sdk that is killed and restarted has a new gid: no rejection, and one reboot."""
    messages = flight()
    received: list[SourceMessage] = []
    for _ in range(2):
        node = peer(
            "talk",
            "1.16",
            topic=f"/fmu/out/{VLP}",
            rows=[downgrade(each, "1.16") for each in messages],
        )
        received += listener.receive(len(messages))
        node.kill()
    assert [upgrade(each.fields) for each in received] == 2 * messages
    assert [index for index, each in enumerate(received) if each.rebooted] == [len(messages)]
    assert (sum(each.lost for each in received), listener.rejections) == (0, [])


@pytest.mark.slow
def test_ros_2_lists_source_as_subscriber(
    listener: Listener, peer: Peer, zenoh_session: Session
) -> None:
    """The tokens that `ros2 topic info -v` reads name the source as a subscriber while there is a publisher."""

    def subscriptions() -> list[dict[str, object]]:
        tokens = zenoh_session.liveliness().get("@ros2_lv/4/*/*/*/MS/**")
        return [
            _parse_liveliness_keyexpr(str(reply.ok.key_expr)) or {} for reply in tokens if reply.ok
        ]

    node = peer("talk", "1.14", topic=f"/drone/{VLP}", rows=[], domain_id=4)
    listener.step_until(subscriptions, what="the subscription")
    [found] = subscriptions()
    assert str(found["node_name"]).startswith("nedbus_px4_zenoh_")
    topic = (found["qualified_name"], found["dds_type"], found["type_hash"])
    assert topic == (f"/drone/{VLP}", dds_type(ROS2_TYPE), type_hash("1.14"))
    nodes = [
        str(reply.ok.key_expr)
        for reply in zenoh_session.liveliness().get("@ros2_lv/4/*/*/*/NN/**")
        if reply.ok
    ]
    assert any(name.endswith(f"/{found['node_name']}") for name in nodes)
    node.kill()
    listener.step_until(lambda: not subscriptions(), what="the subscription to be withdrawn")
