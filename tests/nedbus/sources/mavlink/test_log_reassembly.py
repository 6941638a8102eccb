"""Reassembly of a ULog stream: sequence numbers, gaps, malformed messages, and recordings of a real PX4 (SITL)."""

from __future__ import annotations

import random
import socket
import struct
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from contextlib import closing
from functools import cache
from typing import Any, Final, NamedTuple

import pytest
from hypothesis import given, strategies as st
from pymavlink.dialects.v20 import common as dialect

from nedbus.mavlink.log_reassembly import Chunk, Reassembly, Verdict
from nedbus.mavlink.parser import Received
from nedbus.sources.mavlink.link import open_link
from nedbus.sources.mavlink.reader import LinkReader, LogReceiver
from nedbus.sources.options import MavlinkOptions
from tests.peers.ports import free_port
from tests.peers.px4_log_stream import STREAMS, Message, datagrams, split_records, stream_message
from tests.waits import DEADLINE, wait_for

HEADER: Final = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 3_000_000)
SIZE: Final = 249

needs_recordings = [
    pytest.mark.logs,
    pytest.mark.skipif(
        not STREAMS.exists(),
        reason=f"no recordings of a PX4's ULog stream: {STREAMS} does not exist",
    ),
]


class CountingReassembly(Reassembly):
    """Count messages per verdict, and also lost messages, delivered bytes and bytes skipped after a gap."""

    def __init__(self) -> None:
        super().__init__()
        self.counts = Counter[Verdict]()
        self.lost = self.bytes = self.skipped = 0

    def add(
        self,
        sequence: int,
        length: int,
        first_message_offset: int,
        data: Sequence[int],
        now: float | None = None,
    ) -> Chunk:
        """Add the next message and count the result."""
        chunk = super().add(sequence, length, first_message_offset, data, now)
        self.counts[chunk.verdict] += 1
        self.lost += chunk.lost
        self.bytes += len(chunk.data)
        if chunk.verdict in ("delivered", "unsynchronised"):
            self.skipped += length - len(chunk.data)
        return chunk


def add(reassembly: CountingReassembly, message: Message) -> Chunk:
    return reassembly.add(message.sequence, len(message.data), message.offset, message.data)


def begin(reassembly: CountingReassembly, content: bytes = bytes(SIZE - 16)) -> None:
    """Begin a stream."""
    assert add(reassembly, Message(True, 0, 0, HEADER + content)).begins


def plain(sequence: int, data: bytes = b"data", offset: int = 0) -> Message:
    return Message(False, sequence, offset, data)


def test_retransmitted_first_message_does_not_begin_new_stream() -> None:
    """Sequence number 0 with ULog's magic bytes begins a stream; identical bytes are a retransmission."""
    reassembly = CountingReassembly()
    begin(reassembly, b"a")
    assert add(reassembly, Message(True, 0, 0, HEADER + b"a")) == Chunk("duplicate")
    add(reassembly, plain(1))
    assert add(reassembly, Message(True, 0, 0, HEADER + b"b")) == Chunk(
        "delivered", HEADER + b"b", begins=True
    )
    assert add(reassembly, plain(1)) == Chunk("delivered", b"data")
    assert reassembly.lost == 0


def test_same_first_message_begins_new_stream_after_reboot() -> None:
    """After a reboot, a header with the same bytes begins a new stream; without a reboot it is a retransmission."""
    ids, port, encoder = (245, 191), free_port(), dialect.MAVLink(None, 1, 1)
    header = dialect.MAVLink_logging_data_acked_message(
        *ids, 0, SIZE, 0, [*HEADER.ljust(SIZE, b"\0")]
    )
    heartbeat = dialect.MAVLink_heartbeat_message(2, dialect.MAV_AUTOPILOT_PX4, 0, 0, 3, 3)
    times = [dialect.MAVLink_system_time_message(0, ms) for ms in (9000, 100)]
    with (
        closing(open_link(f"udpin:127.0.0.1:{port}", baud=57600)) as link,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
    ):
        options, reader = MavlinkOptions(log="1"), LinkReader(link, name="link")
        starts: list[Any] = []

        def transmit(*messages: Any) -> None:
            for message in messages:
                vehicle.sendto(message.pack(encoder), ("127.0.0.1", port))

        def answer(message: Any, _: object) -> None:
            if message.get_type() == "TIMESYNC":
                transmit(dialect.MAVLink_timesync_message(1, message.ts1))
            starts.extend([message] * (message.get_type() == "COMMAND_LONG"))

        receiver = LogReceiver(reader, options, answer)
        with closing(receiver):
            received: list[Received] = []
            for count, burst in enumerate(
                ([heartbeat], [header, header, *times, heartbeat], [header])
            ):
                transmit(*burst)
                wait_for(lambda count=count: len(starts) > min(count, 1), what="START")  # type: ignore[misc] # a default
            while (
                not received
                or sum(each.message.get_type().startswith("LOGGING") for each in received) < 3
            ):
                received += [each for each in receiver.read(DEADLINE) if isinstance(each, Received)]
    assert [each.chunk.begins for each in received if each.chunk] == [True, False, True]


def test_error_of_the_receiving_thread_is_raised_by_the_source(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An error of the receiving thread, even one that is not an Exception, is raised where messages are read."""

    def fail(_: LogReceiver) -> None:
        raise BaseException("panic")  # noqa: TRY002 - like pyo3's PanicException, it is not an Exception

    monkeypatch.setattr(LogReceiver, "_step", fail)
    with closing(open_link(f"udpin:127.0.0.1:{free_port()}", baud=57600)) as link:
        receiver = LogReceiver(LinkReader(link, name="link"), MavlinkOptions(), lambda *_: None)
        with closing(receiver), pytest.raises(BaseException, match="panic"):
            list(receiver.read(DEADLINE))


def test_stream_joined_midway_has_no_definitions() -> None:
    """Without its header a stream cannot be decoded: nothing is delivered or counted as lost until the next header."""
    reassembly = CountingReassembly()
    for sequence in (0, 70, 3):
        assert add(reassembly, plain(sequence)) == Chunk("no_definitions")
    assert (reassembly.lost, reassembly.counts["no_definitions"]) == (0, 3)
    begin(reassembly)


def test_trailing_zeros_are_restored() -> None:
    """Trailing zeros, which MAVLink 2 truncates, are restored up to the declared length."""
    reassembly = CountingReassembly()
    begin(reassembly)
    assert reassembly.add(1, 6, 0, b"ab").data == b"ab\0\0\0\0"
    assert reassembly.add(2, 3, 0, [1, 2, 3, 0, 0]).data == b"\1\2\3"


def test_gap_skips_to_next_record() -> None:
    """After a gap, bytes before the first record are skipped, as are messages without the start of a record."""
    reassembly = CountingReassembly()
    begin(reassembly)
    assert add(reassembly, plain(3, offset=255)) == Chunk("unsynchronised", lost=2)
    assert add(reassembly, plain(4, offset=255)) == Chunk("unsynchronised")
    assert add(reassembly, plain(6, b"end-begin", offset=4)) == Chunk("delivered", b"begin", lost=1)
    assert add(reassembly, plain(7, offset=255)) == Chunk("delivered", b"data", offset=255)
    assert (reassembly.lost, reassembly.skipped, reassembly.bytes) == (3, 12, SIZE + 9)


def test_empty_message_does_not_resynchronise() -> None:
    """After a gap, a message without data in which no record begins does not resynchronise the stream."""
    reassembly = CountingReassembly()
    begin(reassembly)
    add(reassembly, plain(2, b"", offset=255))
    assert add(reassembly, plain(3, offset=255)) == Chunk("unsynchronised")


def test_late_message_stays_lost() -> None:
    """A late message is indistinguishable from a retransmission, so it stays lost."""
    reassembly = CountingReassembly()
    begin(reassembly)
    assert add(reassembly, plain(2)).lost == 1
    assert add(reassembly, plain(1)) == Chunk("duplicate")
    assert add(reassembly, plain(2)) == Chunk("duplicate")
    assert reassembly.lost == 1


@pytest.mark.parametrize(("length", "offset"), [(250, 0), (255, 255), (10, 10), (10, 254), (0, 0)])
def test_malformed_message_leaves_a_gap(length: int, offset: int) -> None:
    """A message with an impossible length or offset is rejected and counted as lost."""
    reassembly = CountingReassembly()
    begin(reassembly)
    assert reassembly.add(1, length, offset, bytes(SIZE)) == Chunk("malformed")
    assert add(reassembly, plain(2)).lost == 1


def test_sequence_wraps_without_loss() -> None:
    """The sequence number continues with 0 after 65535, with or without losses."""
    reassembly = CountingReassembly()
    begin(reassembly)
    for sequence in range(1, 2**16):
        assert not add(reassembly, plain(sequence)).lost
    assert add(reassembly, plain(0)) == Chunk("delivered", b"data")
    assert add(reassembly, plain(2)).lost == 1
    assert reassembly.counts.total() == 2**16 + 2


def test_largest_loss_is_half_of_sequence_range() -> None:
    """A step of 32,768 is the largest one that counts as a loss; a larger step indicates a late message."""
    reassembly = CountingReassembly()
    begin(reassembly)
    assert add(reassembly, plain(2**15)).lost == 2**15 - 1
    reassembly = CountingReassembly()
    begin(reassembly)
    assert add(reassembly, plain(2**15 + 1)) == Chunk("duplicate")


def test_stream_resumes_after_loss_of_over_half_the_sequence_range() -> None:
    """A long run of consecutive old sequence numbers resumes the stream, and all skipped messages count as lost."""
    reassembly = CountingReassembly()
    begin(reassembly)
    chunks = [add(reassembly, plain(sequence)) for sequence in range(40_000, 40_300)]
    first = next(index for index, chunk in enumerate(chunks) if chunk.verdict == "delivered")
    assert first < 256
    assert chunks[first].lost == reassembly.lost == 40_000 + first - 1
    assert all(chunk == Chunk("delivered", b"data") for chunk in chunks[first + 1 :])


def to_messages(records: Iterable[bytes], size: int = SIZE) -> list[Message]:
    """Split a header and records into messages, as PX4 does."""
    data, starts = bytearray(HEADER), []
    for record in records:
        starts.append(len(data))
        data += record
    messages = []
    for sequence, at in enumerate(range(0, len(data), size)):
        index = bisect_left(starts, at)
        begins = starts[index] - at if index < len(starts) and starts[index] < at + size else 255
        messages.append(Message(False, sequence, begins if at else 0, bytes(data[at : at + size])))
    return messages


def deliver(messages: Iterable[Message]) -> tuple[list[tuple[str, bytes]], CountingReassembly]:
    """Return the records of the reassembled stream, split by a parser that trusts all lengths."""
    reassembly, data = CountingReassembly(), bytearray()
    records: list[tuple[str, bytes]] = []
    for message in messages:
        chunk = add(reassembly, message)
        if chunk.lost or chunk.begins:
            data.clear()
        data += chunk.data[16:] if chunk.begins else chunk.data
        records += split_records(data)
    return records, reassembly


class Impaired(NamedTuple):
    """`messages`: in order of arrival; `in_order`: original indices of the messages that do not arrive late."""

    messages: list[Message]
    in_order: set[int]


def impair(
    messages: Sequence[Message], *, loss: float, burst: int = 1, reorder: float = 0.0, seed: int = 1
) -> Impaired:
    """Drop LOGGING_DATA in bursts, and delay some by up to eight messages; acknowledged messages always arrive."""
    rng, drops, arriving = random.Random(seed), 0, []
    for index, message in enumerate(messages):
        if not message.acked and index:
            drops = burst if not drops and rng.random() < loss / burst else max(0, drops - 1)
            if drops:
                continue
        is_late = not message.acked and index and rng.random() < reorder
        arriving.append((index + (rng.randint(2, 8) + 0.5 if is_late else 0), index))
    order = [index for _, index in sorted(arriving)]
    newest, in_order = -1, set()
    for index in order:
        if index > newest:
            newest = index
            in_order.add(index)
    return Impaired([messages[index] for index in order], in_order)


def complete_records(messages: Sequence[Message], arrived: set[int]) -> list[tuple[str, bytes]]:
    """Return the records whose bytes are all in messages that arrived in order."""
    data, ends, records = bytearray(), [], []
    for message in messages:
        data += message.data
        ends.append(len(data))
    at = 16
    rest = data[16:]
    for kind, body in split_records(rest):
        stop = at + 3 + len(body)
        spanned = range(bisect_left(ends, at + 1), bisect_left(ends, stop) + 1)
        if arrived.issuperset(spanned):
            records.append((kind, body))
        at = stop
    return records


@given(st.data())
def test_exactly_the_complete_records_are_delivered(data: st.DataObject) -> None:
    """With messages dropped, delayed or repeated, each complete record is delivered, and nothing else."""
    rng = random.Random(data.draw(st.integers(0, 2**32)))
    sizes = [rng.choice([1, 5, 40, 300, 900]) for _ in range(data.draw(st.integers(1, 300)))]
    messages = to_messages(
        struct.pack("<HB", size, ord("D")) + rng.randbytes(size) for size in sizes
    )
    loss, reorder = (
        data.draw(st.sampled_from([0.0, 0.05, 0.3])),
        data.draw(st.sampled_from([0.0, 0.1])),
    )
    impaired = impair(
        messages, loss=loss, burst=rng.randint(1, 5), reorder=reorder, seed=rng.randrange(1000)
    )
    repeated = [each for each in impaired.messages for _ in range(rng.choice([1, 1, 1, 2]))]
    records, reassembly = deliver(repeated)
    assert records == complete_records(messages, impaired.in_order)
    assert reassembly.lost == max(impaired.in_order) + 1 - len(impaired.in_order)
    assert reassembly.counts["duplicate"] == len(repeated) - len(impaired.in_order)


@cache
def recorded(name: str) -> list[Message]:
    """Return the messages of a recorded stream, without retransmissions."""
    found = [
        stream_message(frame)
        for _, is_sent, frame in datagrams(STREAMS / f"ulog_stream_{name}.bin.gz")
        if is_sent
    ]
    return [each for each in found if each]


def logged(name: str) -> list[bytes]:
    """Return the data messages in the vehicle's own log, each with its message id."""
    data, at, found = (STREAMS / f"ulog_stream_{name}.ulg").read_bytes(), 16, []
    while at + 3 <= len(data):
        stop = at + 3 + int.from_bytes(data[at : at + 2], "little")
        if data[at + 2] == ord("D"):
            found.append(data[at + 3 : stop])
        at = stop
    return found


class Comparison(NamedTuple):
    """Numbers of data messages: in both stream and log, in the stream only, and missing at each gap."""

    common: int
    invented: int
    missing: list[int]


def compare(records: Iterable[tuple[str, bytes]], name: str) -> Comparison:
    """Find each data message of a stream in the vehicle's own log, in the same order."""
    places = defaultdict[bytes, list[int]](list)
    for index, message in enumerate(logged(name)):
        places[message].append(index)
    common = invented = 0
    missing: list[int] = []
    last: int | None = None
    for kind, body in records:
        if kind != "D":
            continue
        at = bisect_left(where := places.get(body, []), 0 if last is None else last + 1)
        if at == len(where):
            invented += 1
            continue
        common += 1
        if last is not None and where[at] > last + 1:
            missing.append(where[at] - last - 1)
        last = where[at]
    return Comparison(common, invented, missing)


@pytest.mark.parametrize(
    ("name", "messages", "lost", "common"),
    [
        ("flight1", 23_032, 0, 47_708),
        ("lossy1", 23_847, 237, 49_054),
        ("default_topics", 5_969, 11, 18_482),
    ],
)
class TestRecordings:
    """Streams of a real PX4 (SITL, main of 2026-05-14), compared with the log that it wrote at the same time."""

    pytestmark = needs_recordings

    @pytest.mark.slow
    def test_stream_equals_log_of_vehicle(
        self, name: str, messages: int, lost: int, common: int
    ) -> None:
        """Each data message is in the log, in order; only at gaps does the log contain more."""
        records, reassembly = deliver(recorded(name))
        compared = compare(records, name)
        assert (reassembly.counts["delivered"], reassembly.counts.total(), reassembly.lost) == (
            messages,
            messages,
            lost,
        )
        assert (compared.common, compared.invented) == (common, 0)
        assert len(compared.missing) <= lost  # consecutive lost messages leave one gap


@pytest.mark.parametrize(
    ("loss", "burst", "reorder"),
    [(0.03, 1, 0.0), (0.05, 1, 0.0), (0.05, 20, 0.0), (0.0, 1, 0.02), (0.03, 5, 0.02)],
)
class TestImpairedLink:
    """A recorded flight with messages dropped and reordered."""

    pytestmark = needs_recordings

    @pytest.mark.slow
    def test_every_complete_record_is_delivered(
        self, loss: float, burst: int, reorder: float
    ) -> None:
        """Exactly the complete records are delivered, decoding resumes after each gap, and the loss count is exact."""
        messages = recorded("flight1")
        impaired = impair(messages, loss=loss, burst=burst, reorder=reorder)
        records, reassembly = deliver(impaired.messages)
        assert records == complete_records(messages, impaired.in_order)
        assert reassembly.lost == len(messages) - len(impaired.in_order)
        compared = compare(records, "flight1")
        assert compared.invented == 0
        lost_bytes = (
            sum(len(each.data) for each in messages) - reassembly.bytes - reassembly.skipped
        )
        assert lost_bytes <= SIZE * reassembly.lost
        assert 0 < len(compared.missing) <= reassembly.lost
