"""`mavlink:LINK?log=1`: recorded ULog streams of a real PX4, published in full and compared with its own log."""

from __future__ import annotations

import random
import socket
import struct
from collections import Counter, defaultdict
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import replace
from itertools import count, groupby, permutations
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest
from pymavlink.dialects.v20 import common as dialect
from pyulog import ULog

from nedbus import limits
from nedbus.client import LogStreamStatus
from nedbus.mavlink.log_reassembly import Chunk, Reassembly
from nedbus.sources import LiveSource, Rejection, SourceMessage, parse_source
from nedbus.sources.mavlink import log_stream
from nedbus.sources.mavlink.log_client import LogStatus, LogStreamClient
from nedbus.sources.mavlink.log_stream import LogStream
from nedbus.sources.options import MavlinkOptions
from nedbus.timings import Timings
from nedbus.ulog import LOG_MESSAGE, Data, LogMessageBuilder, UlogParser
from tests.flights.ulogs import UlogWriter, log_messages_in, write_raw_log
from tests.peers.ports import free_port
from tests.peers.px4_log_stream import (
    SHORT,
    START,
    STOP,
    STREAMS,
    Entry,
    Px4LogStream,
    Recording,
    read_recording,
)
from tests.waits import DEADLINE

from .test_log_reassembly import compare as compare_records, deliver, recorded, to_messages

MESSAGES: Final = 47_708
"""Number of messages of all topics in the stream of the flight."""

FLIGHT: Final = STREAMS / "ulog_stream_flight1.bin.gz"

pytestmark = pytest.mark.timeout(400)  # a flight of 84 s, which coverage slows down


def recorded_flight(test: Any) -> Any:
    """Mark a test that plays a complete flight."""
    absent = pytest.mark.skipif(
        not STREAMS.exists(), reason=f"no recordings of a PX4's ULog stream in {STREAMS}"
    )
    return pytest.mark.logs(pytest.mark.slow(absent(test)))


@pytest.fixture(autouse=True)
def long_timeouts(monkeypatch: pytest.MonkeyPatch, timings: Timings) -> None:
    """Lengthen queues and timeouts, because a flight is sent as fast as it is read."""
    timings.log_answer, timings.log_link, timings.log_header = DEADLINE, DEADLINE, 10 * DEADLINE
    timings.link_wait = DEADLINE
    monkeypatch.setattr(limits, "MAVLINK_WAITING", 1_000_000)


Attack = Callable[[bytes, int], None]


class Received:
    """Messages that a source yields until the recording has ended and nothing more arrives."""

    def __init__(
        self, options: str, recording: Path | Recording = SHORT, *, attack: Attack | None = None, **peer: Any
    ) -> None:  # fmt: skip
        port = free_port()
        if isinstance(recording, Path):
            recording = read_recording(recording)
        if attack:
            peer["on_send"] = lambda frame: attack(frame, port)
        self.rejections: list[Rejection] = []
        self.messages: list[SourceMessage] = []
        self.status = LogStreamStatus()
        self.reasons: set[str] = set()
        recording = read_recording(recording) if isinstance(recording, Path) else recording
        source = cast(
            "LiveSource",
            parse_source(f"mavlink:udpin:127.0.0.1:{port}?{options}").open_source(vehicle="1"),
        )
        with (
            closing(cast("Any", source.listen(None))) as items,
            Px4LogStream(recording, port, speed=None, deadline=300, **peer) as self.peer,
        ):
            for item in items:
                if isinstance(item, SourceMessage):
                    self.messages.append(item)
                elif isinstance(item, Rejection):
                    self.rejections.append(item)
                elif isinstance(item, LogStreamStatus) and item.vehicle == "1":
                    is_end = self.peer.finished.is_set() and item.received == self.status.received
                    self.status = item
                    self.reasons.add(item.reason)
                    if is_end:
                        break
        data = [each for each in self.messages if each.address.topic != LOG_MESSAGE.name]
        self.stream = [each for each in data if each.source]
        self.converted = [each for each in data if not each.source]


def logged_messages(path: Path) -> dict[tuple[str, int], set[str]]:
    """Return the messages of a vehicle's own log by topic and instance, as text, in which NaN equals itself."""
    parser, found = UlogParser(verify=True), defaultdict[tuple[str, int], set[str]](set)
    for record in [*parser.feed(path.read_bytes()), *parser.close()]:
        if isinstance(record, Data):
            subscription = record.subscription
            found[subscription.name, subscription.multi_id].add(
                repr(subscription.layout.decode(record.payload))
            )
    return found


def compare(received: Received, path: Path) -> int:
    """Count the streamed messages that are in PX4's log; only those in its gap during the header may be missing."""
    logged = logged_messages(path)
    missing = [
        each for each in received.stream
        if repr(dict(each.fields)) not in logged[each.address.topic, each.address.instance or 0]
    ]  # fmt: skip
    start = min(cast("int", each.fields["timestamp"]) for each in received.stream)
    assert all(cast("int", each.fields["timestamp"]) < start + 2_000_000 for each in missing), (
        missing[-3:]
    )
    return len(received.stream) - len(missing)


def sent_messages() -> list[tuple[str, str]]:
    """Return topic and fields of each message in the short recording."""
    recording = read_recording(SHORT)
    plain = [each.content for each in recording.entries if not isinstance(each.content, bytes)]
    records = UlogParser(verify=True).feed(
        b"".join(each.data for each in (*recording.header, *plain))
    )
    records = list(LogMessageBuilder().merge(records))
    return [
        (each.subscription.name, repr(each.subscription.layout.decode(each.payload)))
        for each in records
        if isinstance(each, Data)
    ]


@pytest.mark.slow
def test_stream_is_published_in_full() -> None:
    """All messages of all topics that a real PX4 (SITL) sent are published in order, with all of their fields."""
    received, sent = Received("log=1"), sent_messages()
    assert [
        (each.address.topic, repr(each.fields)) for each in received.messages if each.source
    ] == sent
    assert len({topic for topic, _ in sent}) == 20
    status = received.status
    assert (status.state, status.gaps, status.lost, status.undecodable) == ("streaming", 0, 0, 0), (
        received.reasons
    )
    assert status.header_time is not None


@pytest.mark.slow
def test_losses_of_link_are_reported_with_stream() -> None:
    """MAVLink messages that are lost while all topics come from the stream are reported with its messages."""
    recording, camera = read_recording(SHORT), dialect.MAVLink(None, 1, dialect.MAV_COMP_ID_CAMERA)
    # The peer numbers all frames together, so a frame of another component is a gap in those of the autopilot.
    gap = dialect.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3).pack(camera)
    entries = recording.entries
    middle = range(len(entries) // 2, len(entries) * 3 // 4)
    recording.entries = [
        each
        for index, entry in enumerate(entries)
        for each in [entry] + [Entry(entry.time, gap)] * (index in middle)
    ]
    received = Received("log=1&topics=vehicle_attitude", recording)
    assert {each.source for each in received.messages[-50:]} == {"mavlink-ulog"}
    assert sum(each.lost for each in received.messages) == len(middle)


@pytest.mark.slow
def test_failing_sensor_does_not_end_stream() -> None:
    """A sensor that repeats the time of its last sample is not taken for a reboot, which would end the stream."""
    recording, mav = read_recording(SHORT), dialect.MAVLink(None, 1, 1)
    failing = dialect.MAVLink_scaled_pressure_message(100, 1.0, 0.0, 20).pack(mav)
    entries = recording.entries
    recording.entries = [each for entry in entries for each in (entry, Entry(entry.time, failing))]
    received = Received("log=1", recording)
    assert [(each.address.topic, repr(each.fields)) for each in received.stream] == [
        each for each in sent_messages() if each[0] != LOG_MESSAGE.name
    ]
    assert received.rejections == []
    assert received.status.state == "streaming"
    assert not any(each.rebooted for each in received.messages)


@recorded_flight
def test_failing_barometer_does_not_end_stream() -> None:
    """While the barometer of a real PX4 (SITL) fails in flight, the stream continues, and equals the vehicle's log."""
    received = Received("log=armed&vehicles=4:1", STREAMS.parent / "baro_failure_mavlink.bin.gz")
    assert compare(received, STREAMS.parent / "baro_failure.ulg") > 4_500
    assert [each for each in received.rejections if "not requested" in each.reason] == []
    assert not any(each.rebooted for each in received.messages)
    status = received.status
    assert (status.state, status.gaps, status.lost, status.undecodable) == ("streaming", 0, 0, 0), (
        received.reasons
    )
    assert len({each for each in received.reasons if each}) == 0, received.reasons


@recorded_flight
def test_conversion_resumes_when_stream_ends(timings: Timings) -> None:
    """After another client's STOP, converted messages replace those of the stream, without overlap."""
    # at full speed the rest of the flight takes little more than a second
    timings.log_silence = 0.2
    received = Received("log=1&topics=vehicle_attitude", FLIGHT, events={40.0: "foreign_stop"})
    sources = [
        each.source for each in received.messages if each.address.topic == "vehicle_attitude"
    ]
    assert [source for source, _ in groupby(sources)] == [None, "mavlink-ulog", None]
    assert any("PX4 stopped the ULog stream" in each for each in received.reasons), received.reasons


@recorded_flight
def test_published_stream_and_saved_file_equal_log_of_vehicle(tmp_path: Path) -> None:
    """All messages of a real PX4 (SITL) arrive without a gap and equal its own log, and so does the saved file."""
    received = Received(f"log=1&save={tmp_path}", FLIGHT)
    status = received.status
    assert (status.state, status.gaps, status.lost, status.undecodable) == ("streaming", 0, 0, 0), (
        received.reasons
    )
    assert status.header_time is not None
    assert compare(received, STREAMS / "ulog_stream_flight1.ulg") >= 47_000
    assert len(received.stream) == MESSAGES
    (path,) = tmp_path.glob("1_*.ulg")
    log = ULog(str(path))
    assert not log.file_corruption
    assert sum(len(each.data["timestamp"]) for each in log.data_list) == MESSAGES
    assert log.dropouts == []


@recorded_flight
def test_log_messages_of_stream_equal_those_of_log() -> None:
    """Logged strings and events in a stream become the same log_message as in the log, and replace STATUSTEXT."""
    received = Received("log=1&topics=log_message", FLIGHT)
    texts = [
        each for each in received.messages if cast("int", each.fields["timestamp"]) > 7_000_000
    ]
    assert {each.source for each in texts} == {"mavlink-ulog"}
    logged = log_messages_in(STREAMS / "ulog_stream_flight1.ulg")
    assert [tuple(each.fields.values()) for each in texts] == [
        each for each in logged if 7_000_000 < each[0] <= cast("int", texts[-1].fields["timestamp"])
    ]
    assert len(texts) == 10


@recorded_flight
def test_stream_replaces_converted_topics(timings: Timings) -> None:
    """A topic is converted until it arrives in the stream, never both; topics that the stream lacks stay converted."""
    timings.log_silence = DEADLINE  # on a busy host, no data for a second do not end the stream
    timings.log_longest_silence = 2 * DEADLINE
    received = Received(
        "log=1&topics=vehicle_attitude,vehicle_local_position,home_position", FLIGHT
    )
    first = min(cast("int", each.fields["timestamp"]) for each in received.stream)
    after = Counter(
        each.address.topic
        for each in received.converted
        if cast("int", each.fields["timestamp"]) > first + 2_000_000
    )
    assert set(after) <= {"home_position"}
    assert {each.address.topic for each in received.converted} >= {
        "vehicle_attitude",
        "vehicle_local_position",
    }


@pytest.mark.parametrize(
    ("spread", "count", "is_known"),
    [(19, 100, True), (21, 100, False), (19, 98, False), (30, 220, False), (30, 230, True)],
)
def test_mean_size_is_known_within_two_percent(*, spread: int, count: int, is_known: bool) -> None:
    """The mean size of messages is known from 100 messages on, once its standard error is at most 2 %."""
    sizes = log_stream._MeanSize()
    sizes.add([100 - spread, 100 + spread] * (count // 2))
    assert sizes.is_known == is_known
    assert sizes.mean == 100


@pytest.mark.long
@recorded_flight
@pytest.mark.parametrize(("name", "messages", "lost", "gaps", "impairment"), [
    # lost by PX4 after the header, and in the gap of its own log
    ("default_topics", 18_482, 44, 11, {}),
    ("lossy1", 49_052, 0, 237, {}),
    ("flight1", MESSAGES, 0, 500, {"loss": 0.03, "reorder": 0.02, "seed": 1}),
    ("flight1", MESSAGES, 0, 1000, {"loss": 0.05, "seed": 3}),
    ("flight1", MESSAGES, 0, 1000, {"loss": 0.05, "burst": 20, "seed": 2}),
])  # fmt: skip
def test_estimate_of_losses(
    name: str, messages: int, lost: int, gaps: int, impairment: dict[str, Any]
) -> None:
    """No value is wrong, and the estimated number of missing messages is within 20 %, for recordings of PX4.

    `messages`: number in the recording before STOP; `lost`: number missing in both the recording and the log;
    `gaps`: number of lost LOGGING_DATA; with an impairment, its lower bound.
    """
    received = Received("log=armed", STREAMS / f"ulog_stream_{name}.bin.gz", **impairment)
    assert received.stream, received.reasons
    compare(received, STREAMS / f"ulog_stream_{name}.ulg")
    status, (records, _) = received.status, deliver(recorded(name))
    lost += messages - len(received.stream) + sum(compare_records(records, name).missing)
    assert status.lost_messages == pytest.approx(lost, rel=0.2)
    assert status.undecodable == 0
    if impairment:
        assert status.lost == received.peer.dropped + received.peer.late > gaps
    else:
        assert (status.lost, len(received.stream)) == (gaps, messages)


@pytest.mark.parametrize(("size", "lost"), [(20, 1), (20, 3), (250, 1), (900, 1)])
def test_estimate_of_gaps_with_records_of_one_size(size: int, lost: int) -> None:
    """Wherever gaps begin, the estimated number of lost records is within 10 % of the actual one."""
    bodies = [
        ("F", f"noise:uint64_t timestamp;uint8_t[{size - 13}] data;".encode()), ("A", bytes(3) + b"noise"),
        *(("D", struct.pack(f"<HQ{size - 13}x", 0, number)) for number in range(200_000 // size)),
    ]  # fmt: skip
    sent = to_messages(struct.pack("<HB", len(body), ord(kind)) + body for kind, body in bodies)
    period = lost + 5 + 2 * (size // 249)
    client = cast(
        "LogStreamClient", SimpleNamespace(status=LogStatus("streaming"), header_seconds=None)
    )
    reassembly, stream = Reassembly(), LogStream("1", MavlinkOptions(log="1"), client)
    last = missing = estimated = 0
    for each in sent:
        if each.sequence % period >= period - lost:
            continue
        chunk = reassembly.add(each.sequence, len(each.data), each.offset, each.data)
        for message in stream.add(chunk, 0.0):
            assert isinstance(message, SourceMessage)
            number = cast("int", message.fields["timestamp"])
            missing, last = missing + max(0, number - last - 1), number
            estimated = stream.status(0.0).lost_messages
    assert missing > 50
    assert estimated == pytest.approx(missing, rel=0.1)


@pytest.mark.parametrize("first", [20, 300])
def test_estimate_after_a_restart_does_not_depend_on_the_first_messages(first: int) -> None:
    """A stream that continues that of an earlier process begins with a gap; its estimate is within 10 % of the truth.

    The first message after the gap is much smaller or larger than the mean of all, which is 120 bytes.
    """
    sizes = [first, *[60, 180] * 2000]
    bodies = [
        *(("F", f"noise{size}:uint64_t timestamp;uint8_t[{size - 13}] data;".encode()) for size in {*sizes}),
        *(("A", struct.pack("<BH", 0, size) + f"noise{size}".encode()) for size in {*sizes}),
    ]  # fmt: skip
    definitions = b"ULog\x01\x12\x35\x01" + bytes(8)
    definitions += b"".join(
        struct.pack("<HB", len(body), ord(kind)) + body for kind, body in bodies
    )
    client = cast(
        "LogStreamClient", SimpleNamespace(status=LogStatus("streaming"), header_seconds=None)
    )
    stream = LogStream("1", MavlinkOptions(log="1"), client)
    assert not [*stream.add(Chunk("delivered", definitions, begins=True), 0.0)]
    lost, reported = 500, 0
    for number, size in enumerate(sizes):
        record = struct.pack("<HBHQ", size - 3, ord("D"), size, number) + bytes(size - 13)
        chunk = Chunk("delivered", record, lost=0 if number else lost)
        for message in stream.add(chunk, 0.0):
            assert isinstance(message, SourceMessage)
            reported += message.lost
        assert stream.status(0.0).lost_messages <= 1.1 * lost * 249 / 120
    assert reported == stream.status(0.0).lost_messages == pytest.approx(lost * 249 / 120, rel=0.1)


def test_rate_is_measured_since_the_last_window(tmp_path: Path) -> None:
    """The status has the mean rate of the last window, which is at least a second long, and the total of all bytes."""
    fields = "uint64_t timestamp;uint8_t[87] data;"
    header = write_raw_log(tmp_path / "a.ulg", {"noise": (fields, "Q87x")}, []).read_bytes()
    record = struct.pack("<HBHQ87x", 97, ord("D"), 0, 1)
    client = cast(
        "LogStreamClient", SimpleNamespace(status=LogStatus("streaming"), header_seconds=None)
    )
    stream, found = LogStream("1", MavlinkOptions(log="1"), client), []
    assert not [*stream.add(Chunk("delivered", header, begins=True), 10.0)]
    stream.status(10.0)
    for now, number in ((11.0, 100), (11.5, 100), (13.0, 50), (14.0, 0)):
        assert len([*stream.add(Chunk("delivered", record * number), now)]) == number
        status = stream.status(now)
        found.append((status.received - len(header), status.rate))
    assert found == [(10_000, 10_000.0), (20_000, 10_000.0), (25_000, 7_500.0), (25_000, 0.0)]


@pytest.mark.slow
@pytest.mark.parametrize(("peer", "reason"), [
    ({"refusal": 1}, "another client already receives it"), ({"refusal": 2}, "5000 B/s"),
])  # fmt: skip
def test_rejected_stream_reports_reason(peer: dict[str, Any], reason: str) -> None:
    """The status names the cause of a rejection, and messages are converted from MAVLink as without `log=`."""
    received = Received("log=1", **peer)
    assert not received.stream
    assert len(received.converted) > 500
    assert any(reason in each for each in received.reasons), received.reasons


@pytest.mark.slow
def test_unreadable_stream_is_stopped_with_reason() -> None:
    """A stream with an unknown incompatible flag is stopped once; the status names the flag."""
    recording = read_recording(SHORT)
    first = recording.header[0]
    flags = 16 + 3 + 8  # after the file header, the record's header and the compatible flags
    header = [
        first._replace(data=first.data[:flags] + b"\x02" + first.data[flags + 1 :]),
        *recording.header[1:],
    ]
    received = Received("log=1", replace(recording, header=header))
    assert not received.stream
    assert len(received.converted) > 500
    assert received.status.state == "refused"
    reason = "the ULog stream cannot be read, because it has the unknown incompatible flags 0x2; update nedbus"
    assert received.status.reason == reason
    assert not received.rejections
    assert [each for each in received.peer.commands if each in (START, STOP)] == [START, STOP]


def test_topic_that_is_subscribed_in_turns_is_one_stream() -> None:
    """Unsubscriptions neither restart a stream nor repeat its rejection; topics that are not selected stay unread."""
    stream = LogStream(
        "1", MavlinkOptions(topics=("vehicle_attitude", "bad/topic")), cast("Any", None)
    )
    writer = UlogWriter()
    for name, fields in (("vehicle_attitude", ""), ("bad/topic", "float x;"), ("other", "")):
        writer.put("F", f"{name}:uint64_t timestamp;{fields}".encode())
    for number in range(6):
        for message_id, topic in enumerate((b"vehicle_attitude", b"bad/topic", b"other"), number):
            writer.put("A", struct.pack("<BH", 0, message_id) + topic)
            writer.put(
                "D",
                struct.pack("<HQ", message_id, number) + bytes(4 if topic == b"bad/topic" else 0),
            )
            writer.put("R", struct.pack("<H", message_id))
    found = [*stream.add(Chunk("delivered", bytes(writer.data), begins=True), 0.0)]
    messages = [each.fields["timestamp"] for each in found if isinstance(each, SourceMessage)]
    assert messages == [0, 1, 2, 3, 4, 5]
    assert [each.where for each in found if isinstance(each, Rejection)] == ["1 bad/topic"]


def test_unreadable_event_metadata_is_rejected_once() -> None:
    """A stream whose event metadata is damaged reports it with its first event."""
    stream = LogStream("1", MavlinkOptions(topics=("*",)), cast("Any", None))
    writer = UlogWriter()
    writer.put("M", b"\0\x1auint8_t[6] metadata_eventsnot xz")
    writer.put(
        "F",
        b"event:uint64_t timestamp;uint32_t id;uint16_t event_sequence;uint8_t[25] arguments;uint8_t log_levels;",
    )
    writer.put("A", struct.pack("<BH", 0, 1) + b"event")
    found = [*stream.add(Chunk("delivered", bytes(writer.data), begins=True), 0.0)]
    for number in range(3):
        record = struct.pack("<HBHQIH26x", 42, ord("D"), 1, number, 1, number)
        found += stream.add(Chunk("delivered", record), 0.0)
    [rejection] = [each for each in found if isinstance(each, Rejection)]
    assert (rejection.where, rejection.count) == ("1 log_message", 0)
    assert "the event metadata cannot be read" in rejection.reason


HOSTILE: Final = [
    b"\0" * 249,
    b"ULog\x01\x12\x35\x01" + bytes(8) + b"".join(
        struct.pack("<HB", len(body), ord(kind)) + body
        for kind, body in (
            ("F", b"deep:uint64_t timestamp;a a;"),
            *(("F", f"{name}:{name}a a;".encode()) for name in ("a", "aa", "aaa", "aaaa")),
            ("F", b"wide:" + b"uint8_t[65534] a;"),
            ("F", b"vehicle_status:uint64_t timestamp;float timestamp;"),
            ("A", struct.pack("<BH", 0, 1) + b"deep"),
            ("A", struct.pack("<BH", 0, 2) + b"wide"),
            ("A", struct.pack("<BH", 0, 3) + b"vehicle_status"),
            ("A", struct.pack("<BH", 0, 4) + b"unknown"),
            ("D", struct.pack("<HQ", 1, 1)),
        )
    ),
    struct.pack("<HBH", 2000, ord("D"), 9) + bytes(240),
]  # fmt: skip


@pytest.mark.slow
def test_hostile_vehicle_does_not_affect_others() -> None:
    """A vehicle that sends invalid streams is rejected and reported; the stream of another vehicle is complete."""
    rng, mav, sent = random.Random(5), dialect.MAVLink(None, 66, 1), Counter[str]()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as hostile:
        hostile.bind(("127.0.0.1", 0))
        hostile.setblocking(False)

        def attack(frame: bytes, port: int) -> None:
            """Send an invalid message for each valid one."""
            message: Any = dialect.MAVLink_heartbeat_message(
                2, dialect.MAV_AUTOPILOT_PX4, 0, 0, 3, 3
            )
            mav.srcSystem = 66
            if (number := sent["frames"]) % 50:
                mav.srcSystem = rng.choice((66, 66, 67))  # 67 sends no HEARTBEAT
                content = HOSTILE[number % 3] if number > 100 else HOSTILE[1]
                sequence = rng.choice((0, 1, number % 2**16, rng.randrange(2**16)))
                target = rng.choice(((245, 191), (245, 191), (1, 1)))
                offset, length = (
                    rng.choice((0, 0, 255, rng.randrange(256))),
                    rng.choice((len(content), 255)),
                )
                data = [*content[:249].ljust(249, b"\0")]
                message = dialect.MAVLink_logging_data_message(
                    *target, sequence, min(length, 255), offset, data
                )
            hostile.sendto(message.pack(mav), ("127.0.0.1", port))
            with suppress(BlockingIOError):
                mav.srcSystem = 66
                for command in mav.parse_buffer(hostile.recv(2048)) or []:
                    if command.get_type() == "TIMESYNC":
                        answer: Any = dialect.MAVLink_timesync_message(1, command.ts1)
                        hostile.sendto(answer.pack(mav), ("127.0.0.1", port))
                    elif command.get_type() == "COMMAND_LONG":
                        answer = dialect.MAVLink_command_ack_message(
                            command.command, 0, 0, 0, 245, 191
                        )
                        hostile.sendto(answer.pack(mav), ("127.0.0.1", port))
                        sent[str(command.command)] += 1
            sent["frames"] += 1

        received = Received("log=armed", attack=attack)
    ours = [each for each in received.stream if each.address.vehicle == "1"]
    sent_data = [topic for topic, _ in sent_messages() if topic != LOG_MESSAGE.name]
    assert len(ours) == len(received.stream) == len(sent_data), received.reasons
    reasons = {(each.where, each.reason) for each in received.rejections}
    assert sent[str(START)]
    assert not any("system 67" in where for where, _ in reasons), "it sent no HEARTBEAT"
    assert any("deep cannot be decoded" in reason for _, reason in reasons), reasons
    assert any("two fields are called timestamp" in reason for _, reason in reasons), reasons
    assert len(reasons) < 110


WINDOWS: Final = count(10**9, 1000)
"""Times [s] at which the delay is measured, each in a new window."""


def small_stream(tmp_path: Path) -> tuple[LogStream, bytes]:
    """Return a stream and its header; each message has a timestamp and a cell count."""
    path = write_raw_log(
        tmp_path / "a.ulg", {"battery_status": ("uint64_t timestamp;int32_t cell_count;", "Qi")}, []
    )
    client = cast(
        "LogStreamClient", SimpleNamespace(status=LogStatus("streaming"), header_seconds=0.0)
    )
    return LogStream("1", MavlinkOptions(log="1"), client), path.read_bytes()


def measured_delay(stream: LogStream, vehicle_time: float, now: float) -> float | None:
    """Return the delay of one message, logged at a time of the vehicle [s]."""
    record = struct.pack("<HBHQi", 14, ord("D"), 0, round(vehicle_time * 1e6), 4)
    [message] = stream.add(Chunk("delivered", record), now)
    assert isinstance(message, SourceMessage)
    stream.add_delay(message.fields["timestamp"], now)
    return stream.status(next(WINDOWS)).delay


class TestClock:
    """The vehicle's clock, from its answers to TIMESYNC; the vehicle booted 50 s before the host's time 0."""

    BOOT: Final = 50.0

    def answer(self, stream: LogStream, there: float, back: float, boot: float = BOOT) -> float:
        """Answer a request after delays in both directions [s]; return the time of arrival."""
        sent = stream.request_time()
        vehicle_time = sent / 1e9 + there + boot
        stream.add_timesync(round(vehicle_time * 1e9), sent, now := sent / 1e9 + there + back)
        return now

    def test_answers_for_other_clients_are_ignored(self, tmp_path: Path) -> None:
        """Only an answer with the time of an own request counts, once; others may have Unix time, or another clock."""
        stream, header = small_stream(tmp_path)
        list(stream.add(Chunk("delivered", header, begins=True), 0.0))
        now = self.answer(stream, 0.002, 0.003)
        for sent in (1_700_000_000 * 10**9, round(now * 1e9) - 1, 1):
            stream.add_timesync(10**9, sent, now)
        repeated = stream.request_time()
        stream.add_timesync(
            round((repeated / 1e9 + 0.002 + self.BOOT) * 1e9), repeated, repeated / 1e9 + 0.005
        )
        stream.add_timesync(10**9, repeated, repeated / 1e9 + 0.001)
        assert measured_delay(stream, now + self.BOOT - 0.25, now) == pytest.approx(0.25, abs=0.001)

    def test_requests_without_answer_are_bounded(self, tmp_path: Path) -> None:
        """An answer to a request before the last ten is too late to be used."""
        stream, header = small_stream(tmp_path)
        list(stream.add(Chunk("delivered", header, begins=True), 0.0))
        sent = [stream.request_time() for _ in range(11)]
        stream.add_timesync(10**9, sent[0], sent[0] / 1e9 + 10)
        assert measured_delay(stream, 1.0, 1.0) is None

    def test_answer_with_shortest_round_trip_is_used(self, tmp_path: Path) -> None:
        """Of several answers that agree, the one with the shortest round trip gives the offset, in any order."""
        for delays in permutations([(0.001, 0.003), (0.005, 0.5), (0.2, 0.01)]):
            stream, header = small_stream(tmp_path)
            list(stream.add(Chunk("delivered", header, begins=True), 0.0))
            now = max(self.answer(stream, *each) for each in delays)
            assert measured_delay(stream, now + self.BOOT - 0.25, now) == pytest.approx(
                0.25, abs=0.0015
            ), delays

    def test_clock_that_went_back_is_measured_again(self, tmp_path: Path) -> None:
        """An answer that disproves the offset replaces it, even if its round trip is longer."""
        stream, header = small_stream(tmp_path)
        list(stream.add(Chunk("delivered", header, begins=True), 0.0))
        self.answer(stream, 0.001, 0.001)
        now = self.answer(stream, 0.02, 0.02, boot=self.BOOT - 21.57)
        assert measured_delay(stream, now + self.BOOT - 21.57 - 0.25, now) == pytest.approx(
            0.25, abs=0.001
        )

    def test_new_stream_has_no_delay_until_clock_is_measured(self, tmp_path: Path) -> None:
        """A new stream may be that of a new boot: its delay is unknown until the vehicle answers again."""
        stream, header = small_stream(tmp_path)
        list(stream.add(Chunk("delivered", header, begins=True), 0.0))
        now = self.answer(stream, 0.001, 0.001)
        list(stream.add(Chunk("delivered", header, begins=True), now))
        assert measured_delay(stream, now + self.BOOT, now) is None
        now = self.answer(stream, 0.02, 0.02)
        assert measured_delay(stream, now + self.BOOT - 0.25, now) == pytest.approx(0.25, abs=0.001)


def test_field_types_of_old_release_are_converted(tmp_path: Path) -> None:
    """Fields of another type are converted as in a log, and the message after a dropout has the dropout's duration."""
    fields = "uint64_t timestamp;int32_t cell_count;"
    rows = [("battery_status", (number, count)) for number, count in enumerate((6, 300, -1, 7))]
    path = write_raw_log(tmp_path / "a.ulg", {"battery_status": (fields, "Qi")}, rows)
    data = (
        path.read_bytes()
        + struct.pack("<HBH", 2, ord("O"), 1500)
        + struct.pack("<HBHQi", 14, ord("D"), 0, 9, 8)
    )
    client = cast("LogStreamClient", SimpleNamespace(status=LogStatus("streaming")))
    stream = LogStream("1", MavlinkOptions(log="1"), client)
    found = list(stream.add(Chunk("delivered", data, begins=True), 0.0))
    messages = [each for each in found if isinstance(each, SourceMessage)]
    assert [each.fields.get("cell_count") for each in messages] == [6, None, None, 7, 8]
    assert [each.dropout for each in messages] == [0.0, 0.0, 0.0, 0.0, 1.5]
    [rejection] = [each for each in found if isinstance(each, Rejection)]
    assert (
        rejection.reason
        == "battery_status.cell_count is left out where its value does not fit uint8, such as 300"
    )
    assert rejection.count == 0


def test_uninitialized_bools_of_stream_are_true(tmp_path: Path) -> None:
    """As in a file, a bool whose byte is not 0 is true; the reason is the same for each message, and logged once."""
    fields = "uint64_t timestamp;bool[2] flags;"
    path = write_raw_log(
        tmp_path / "a.ulg", {"rtl_status": (fields, "Q2B")}, [("rtl_status", (1, 194, 94))] * 2
    )
    stream = LogStream("1", MavlinkOptions(log="1", topics=("rtl_status",)), cast("Any", None))
    found = [*stream.add(Chunk("delivered", path.read_bytes(), begins=True), 0.0)]
    assert [each.encode().payload[-3:] for each in found if isinstance(each, SourceMessage)] == [
        b"\x92\xc3\xc3"
    ] * 2
    reason = "bools of rtl_status whose byte is neither 0 nor 1 are read as true (2 in the first such message)"
    assert [each for each in found if isinstance(each, Rejection)] == [
        Rejection("1 rtl_status", reason, count=0)
    ] * 2
