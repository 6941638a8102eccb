"""`mavlink:LINK?log=1`: recorded ULog streams of a real PX4, published in full and compared with its own log."""

from __future__ import annotations

import random
import socket
import struct
from collections import Counter, defaultdict
from collections.abc import Callable
from contextlib import closing, suppress
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest
from pymavlink.dialects.v20 import common as dialect
from pyulog import ULog

from nedbus.client import LogStreamStatus
from nedbus.sources import LiveSource, Rejection, SourceMessage, parse_source
from nedbus.sources.mavlink import reader
from nedbus.sources.mavlink.log_client import LogStatus, LogStreamClient
from nedbus.sources.mavlink.log_reassembly import Chunk, Reassembly
from nedbus.sources.mavlink.log_stream import LogStream
from nedbus.sources.options import MavlinkOptions
from nedbus.timings import Timings
from nedbus.ulog import LOG_MESSAGE, Data, LogMessageBuilder, UlogParser
from tests.flights.ulogs import log_messages_in, write_raw_log
from tests.peers.ports import free_port
from tests.peers.px4_log_stream import SHORT, START, STREAMS, Px4LogStream, read_recording
from tests.waits import DEADLINE

from .test_log_reassembly import compare as compare_records
from .test_log_reassembly import deliver, recorded, to_messages

MESSAGES: Final = 47_708
"""Number of messages of all topics in the stream of the flight."""

FLIGHT: Final = STREAMS / "ulog_stream_flight1.bin.gz"

pytestmark = pytest.mark.timeout(400)  # a flight of 84 s, which coverage slows down


def recorded_flight(test: Any) -> Any:
    """Mark a test that plays a complete flight."""
    absent = pytest.mark.skipif(not STREAMS.exists(), reason=f"no recordings of a PX4's ULog stream in {STREAMS}")
    return pytest.mark.logs(pytest.mark.slow(absent(test)))


@pytest.fixture(autouse=True)
def long_timeouts(monkeypatch: pytest.MonkeyPatch, timings: Timings) -> None:
    """Lengthen queues and timeouts, because a flight is sent as fast as it is read."""
    timings.log_answer, timings.log_link, timings.log_header = DEADLINE, DEADLINE, 10 * DEADLINE
    monkeypatch.setattr(reader, "_MAX_WAITING", 1_000_000)


Attack = Callable[[bytes, int], None]


class Received:
    """Messages that a source yields until the recording has ended and nothing more arrives."""

    def __init__(
        self, options: str, recording: Path = SHORT, *, attack: Attack | None = None, **peer: Any
    ) -> None:  # fmt: skip
        port = free_port()
        if attack:
            peer["on_send"] = lambda frame: attack(frame, port)
        self.rejections: list[Rejection] = []
        self.messages: list[SourceMessage] = []
        self.status = LogStreamStatus()
        self.reasons: set[str] = set()
        source = cast("LiveSource", parse_source(f"mavlink:udpin:127.0.0.1:{port}?{options}").open_source(vehicle="1"))
        with (
            closing(cast("Any", source.listen(None))) as items,
            Px4LogStream(read_recording(recording), port, speed=None, deadline=300, **peer) as self.peer,
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
            found[subscription.name, subscription.multi_id].add(repr(subscription.layout.decode(record.payload)))
    return found


def compare(received: Received, path: Path) -> int:
    """Count the streamed messages that are in PX4's log; only those in its gap during the header may be missing."""
    logged = logged_messages(path)
    missing = [
        each for each in received.stream
        if repr(dict(each.fields)) not in logged[each.address.topic, each.address.instance or 0]
    ]  # fmt: skip
    start = min(cast("int", each.fields["timestamp"]) for each in received.stream)
    assert all(cast("int", each.fields["timestamp"]) < start + 2_000_000 for each in missing), missing[-3:]
    return len(received.stream) - len(missing)


def sent_messages() -> list[tuple[str, str]]:
    """Return topic and fields of each message in the short recording."""
    recording = read_recording(SHORT)
    plain = [each.content for each in recording.entries if not isinstance(each.content, bytes)]
    records = UlogParser(verify=True).feed(b"".join(each.data for each in (*recording.header, *plain)))
    records = list(LogMessageBuilder().merge(records))
    return [
        (each.subscription.name, repr(each.subscription.layout.decode(each.payload)))
        for each in records
        if isinstance(each, Data)
    ]


def test_stream_is_published_in_full() -> None:
    """All messages of all topics that a real PX4 (SITL) sent are published in order, with all of their fields."""
    received, sent = Received("log=1"), sent_messages()
    assert [(each.address.topic, repr(each.fields)) for each in received.messages if each.source] == sent
    assert len({topic for topic, _ in sent}) == 20
    status = received.status
    assert (status.state, status.gaps, status.lost, status.undecodable) == ("streaming", 0, 0, 0), received.reasons
    assert status.header_time is not None


@recorded_flight
def test_conversion_resumes_when_stream_ends() -> None:
    """After another client's STOP, converted messages replace those of the stream, without overlap."""
    received = Received("log=1&topics=vehicle_attitude", FLIGHT, events={40.0: "foreign_stop"})
    sources = [each.source for each in received.messages if each.address.topic == "vehicle_attitude"]
    assert [source for source, _ in groupby(sources)] == [None, "mavlink-ulog", None]
    assert any("PX4 stopped the ULog stream" in each for each in received.reasons), received.reasons


@recorded_flight
def test_published_stream_and_saved_file_equal_log_of_vehicle(tmp_path: Path) -> None:
    """All messages of a real PX4 (SITL) arrive without a gap and equal its own log, and so does the saved file."""
    received = Received(f"log=1&save={tmp_path}", FLIGHT)
    status = received.status
    assert (status.state, status.gaps, status.lost, status.undecodable) == ("streaming", 0, 0, 0), received.reasons
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
    texts = [each for each in received.messages if cast("int", each.fields["timestamp"]) > 7_000_000]
    assert {each.source for each in texts} == {"mavlink-ulog"}
    logged = log_messages_in(STREAMS / "ulog_stream_flight1.ulg")
    assert [tuple(each.fields.values()) for each in texts] == [
        each for each in logged if 7_000_000 < each[0] <= cast("int", texts[-1].fields["timestamp"])
    ]
    assert len(texts) == 10


@recorded_flight
def test_stream_replaces_converted_topics() -> None:
    """A topic is converted until it arrives in the stream, never both; topics that the stream lacks stay converted."""
    received = Received("log=1&topics=vehicle_attitude,vehicle_local_position,home_position", FLIGHT)
    first = min(cast("int", each.fields["timestamp"]) for each in received.stream)
    after = Counter(
        each.address.topic for each in received.converted if cast("int", each.fields["timestamp"]) > first + 2_000_000
    )
    assert set(after) <= {"home_position"}
    assert {each.address.topic for each in received.converted} >= {"vehicle_attitude", "vehicle_local_position"}


@recorded_flight
@pytest.mark.parametrize(("name", "messages", "lost", "gaps", "impairment"), [
    ("default_topics", 18_482, 44, 11, {}),  # lost by PX4 after the header, and in the gap of its own log
    ("lossy1", 49_052, 0, 237, {}),
    ("flight1", MESSAGES, 0, 500, {"loss": 0.03, "reorder": 0.02, "seed": 1}),
    ("flight1", MESSAGES, 0, 1000, {"loss": 0.05, "seed": 3}),
    ("flight1", MESSAGES, 0, 1000, {"loss": 0.05, "burst": 20, "seed": 2}),
])  # fmt: skip
def test_losses_are_within_bounds(name: str, messages: int, lost: int, gaps: int, impairment: dict[str, Any]) -> None:
    """No value is wrong, and the number of missing messages is within the bounds of the status, for recordings of PX4.

    `messages`: number in the recording before STOP; `lost`: number missing in both the recording and the log;
    `gaps`: number of lost LOGGING_DATA; with an impairment, its lower bound.
    """
    received = Received("log=armed", STREAMS / f"ulog_stream_{name}.bin.gz", **impairment)
    assert received.stream, received.reasons
    compare(received, STREAMS / f"ulog_stream_{name}.ulg")
    status, (records, _) = received.status, deliver(recorded(name))
    lost += messages - len(received.stream) + sum(compare_records(records, name).missing)
    assert status.lost_at_least <= lost <= status.lost_at_most
    assert status.undecodable == 0
    if impairment:
        assert status.lost == received.peer.dropped + received.peer.late > gaps
    else:
        assert (status.lost, len(received.stream)) == (gaps, messages)


@pytest.mark.parametrize(("size", "lost"), [(20, 1), (20, 3), (250, 1), (900, 1)])
def test_bounds_of_gaps_are_exact_for_records_of_one_size(size: int, lost: int) -> None:
    """Wherever a gap begins, it loses a number of records within the bounds of the status; some gap loses the most."""
    bodies = [
        ("F", f"noise:uint64_t timestamp;uint8_t[{size - 13}] data;".encode()), ("A", bytes(3) + b"noise"),
        *(("D", struct.pack(f"<HQ{size - 13}x", 0, number)) for number in range(200_000 // size)),
    ]  # fmt: skip
    sent = to_messages(struct.pack("<HB", len(body), ord(kind)) + body for kind, body in bodies)
    period = lost + 5 + 2 * (size // 249)
    client = cast("LogStreamClient", SimpleNamespace(status=LogStatus("streaming"), header_seconds=None))
    reassembly, stream = Reassembly(), LogStream("1", MavlinkOptions(log=frozenset({"1"})), client)
    last, before, surplus = -1, (0, 0), set[int]()
    for each in sent:
        if each.sequence % period >= period - lost:
            continue
        chunk = reassembly.add(each.sequence, len(each.data), each.offset, each.data)
        for message in stream.add(chunk, 0.0):
            assert isinstance(message, SourceMessage)
            number = cast("int", message.fields["timestamp"])
            missing, last = number - last - 1, number
            if missing:
                status = stream.status(0.0)
                least, most = status.lost_at_least - before[0], status.lost_at_most - before[1]
                before = status.lost_at_least, status.lost_at_most
                assert least <= missing <= most
                surplus.add(most - missing)
    assert min(surplus) == 0


def test_rate_is_measured_since_the_last_window(tmp_path: Path) -> None:
    """The status has the mean rate of the last window, which is at least a second long, and the total of all bytes."""
    fields = "uint64_t timestamp;uint8_t[87] data;"
    header = write_raw_log(tmp_path / "a.ulg", {"noise": (fields, "Q87x")}, []).read_bytes()
    record = struct.pack("<HBHQ87x", 97, ord("D"), 0, 1)
    client = cast("LogStreamClient", SimpleNamespace(status=LogStatus("streaming"), header_seconds=None))
    stream, found = LogStream("1", MavlinkOptions(log=frozenset({"1"})), client), []
    assert not [*stream.add(Chunk("delivered", header, begins=True), 10.0)]
    stream.status(10.0)
    for now, count in ((11.0, 100), (11.5, 100), (13.0, 50), (14.0, 0)):
        assert len([*stream.add(Chunk("delivered", record * count), now)]) == count
        status = stream.status(now)
        found.append((status.received - len(header), status.rate))
    assert found == [(10_000, 10_000.0), (20_000, 10_000.0), (25_000, 7_500.0), (25_000, 0.0)]


@pytest.mark.parametrize(("peer", "reason"), [
    ({"refusal": 1}, "another client already receives it"), ({"refusal": 2}, "5000 B/s"),
])  # fmt: skip
def test_rejected_stream_reports_reason(peer: dict[str, Any], reason: str) -> None:
    """The status names the cause of a rejection, and messages are converted from MAVLink as without `log=`."""
    received = Received("log=1", **peer)
    assert not received.stream
    assert len(received.converted) > 500
    assert any(reason in each for each in received.reasons), received.reasons


HOSTILE: Final = [
    b"\0" * 249,
    b"ULog\x01\x12\x35\x01" + bytes(8) + b"".join(
        struct.pack("<HB", len(body), ord(kind)) + body
        for kind, body in (
            ("F", b"loop:uint64_t timestamp;loop inner;"),
            ("F", b"wide:" + b"uint8_t[999999999] a;"),
            ("F", b"vehicle_status:uint64_t timestamp;float timestamp;"),
            ("A", struct.pack("<BH", 0, 1) + b"loop"),
            ("A", struct.pack("<BH", 0, 2) + b"wide"),
            ("A", struct.pack("<BH", 0, 3) + b"vehicle_status"),
            ("A", struct.pack("<BH", 0, 4) + b"unknown"),
            ("D", struct.pack("<HQ", 1, 1)),
        )
    ),
    struct.pack("<HBH", 2000, ord("D"), 9) + bytes(240),
]  # fmt: skip


def test_hostile_vehicle_does_not_affect_others() -> None:
    """A vehicle that sends invalid streams is rejected and reported; the stream of another vehicle is complete."""
    rng, mav, sent = random.Random(5), dialect.MAVLink(None, 66, 1), Counter[str]()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as hostile:
        hostile.bind(("127.0.0.1", 0))
        hostile.setblocking(False)

        def attack(frame: bytes, port: int) -> None:
            """Send an invalid message for each valid one."""
            message: Any = dialect.MAVLink_heartbeat_message(2, dialect.MAV_AUTOPILOT_PX4, 0, 0, 3, 3)
            mav.srcSystem = 66
            if (number := sent["frames"]) % 50:
                mav.srcSystem = rng.choice((66, 66, 67))  # no request was sent to 67
                content = HOSTILE[number % 3] if number > 100 else HOSTILE[1]
                sequence = rng.choice((0, 1, number % 2**16, rng.randrange(2**16)))
                target = rng.choice(((245, 191), (245, 191), (1, 1)))
                offset, length = rng.choice((0, 0, 255, rng.randrange(256))), rng.choice((len(content), 255))
                data = [*content[:249].ljust(249, b"\0")]
                message = dialect.MAVLink_logging_data_message(*target, sequence, min(length, 255), offset, data)
            hostile.sendto(message.pack(mav), ("127.0.0.1", port))
            with suppress(BlockingIOError):
                for command in mav.parse_buffer(hostile.recv(2048)) or []:
                    if command.get_type() == "COMMAND_LONG":
                        answer = dialect.MAVLink_command_ack_message(command.command, 0, 0, 0, 245, 191)
                        hostile.sendto(answer.pack(mav), ("127.0.0.1", port))
                        sent[str(command.command)] += 1
            sent["frames"] += 1

        received = Received("log=armed", attack=attack)
    ours = [each for each in received.stream if each.address.vehicle == "1"]
    sent_data = [topic for topic, _ in sent_messages() if topic != LOG_MESSAGE.name]
    assert len(ours) == len(received.stream) == len(sent_data), received.reasons
    reasons = {(each.where, each.reason) for each in received.rejections}
    assert sent[str(START)]
    assert any("not requested" in reason for _, reason in reasons)
    assert any("loop cannot be decoded" in reason for _, reason in reasons), reasons
    assert any("two fields are called timestamp" in reason for _, reason in reasons), reasons
    assert len(reasons) < 110


def test_field_types_of_old_release_are_converted(tmp_path: Path) -> None:
    """Fields of another type are converted as in a log, and the message after a dropout has the dropout's duration."""
    fields = "uint64_t timestamp;int32_t cell_count;"
    rows = [("battery_status", (number, count)) for number, count in enumerate((6, 300, -1, 7))]
    path = write_raw_log(tmp_path / "a.ulg", {"battery_status": (fields, "Qi")}, rows)
    data = path.read_bytes() + struct.pack("<HBH", 2, ord("O"), 1500) + struct.pack("<HBHQi", 14, ord("D"), 0, 9, 8)
    client = cast("LogStreamClient", SimpleNamespace(status=LogStatus("streaming")))
    stream = LogStream("1", MavlinkOptions(log=frozenset({"1"})), client)
    found = list(stream.add(Chunk("delivered", data, begins=True), 0.0))
    messages = [each for each in found if isinstance(each, SourceMessage)]
    assert [each.fields.get("cell_count") for each in messages] == [6, None, None, 7, 8]
    assert [each.dropout for each in messages] == [0.0, 0.0, 0.0, 0.0, 1.5]
    [rejection] = [each for each in found if isinstance(each, Rejection)]
    assert rejection.reason == "battery_status.cell_count is left out where its value does not fit uint8, such as 300"
    assert rejection.count == 0
