"""Queue of received messages: limits of time and number, resynchronisation, fair turns, and the host's load."""

from __future__ import annotations

import threading
from collections import Counter
from itertools import groupby, islice
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus import limits
from nedbus.mavlink import Received
from nedbus.mavlink.log_reassembly import Chunk
from nedbus.sources import LinkLoad, Rejection
from nedbus.sources.mavlink.receive_queue import ReceiveQueue, join_data
from tests.waits import DEADLINE

HEARTBEAT: Any = dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3)
DATA: Any = dialect.MAVLink_logging_data_message(245, 191, 0, 1, 0, [0] * 249)
ACKED: Any = dialect.MAVLink_logging_data_acked_message(245, 191, 0, 1, 0, [0] * 249)


class Host:
    """A queue with a fake clock."""

    def __init__(self) -> None:
        self.time = 100.0
        self.queue = ReceiveQueue(lambda: self.time)
        self.loads: list[LinkLoad] = []
        self.rejections: list[Rejection] = []

    def put(
        self,
        sequence: int,
        chunk: Chunk | None = None,
        *,
        system: int = 1,
        message: Any = HEARTBEAT,
    ) -> None:
        self.queue.put(Received(message, system, sequence, None, self.time, chunk=chunk))

    def read(self, count: int | None = None, *, lost_by_host: int = 0) -> list[Received]:
        """Return what one call of `read` yields; `count`: stop after this number of messages."""
        found = []
        for each in self.queue.read(0.0, lost_by_host=lost_by_host):
            if isinstance(each, LinkLoad):
                self.loads.append(each)
            elif isinstance(each, Rejection):
                self.rejections.append(each)
            else:
                found.append(each)
                if len(found) == count:
                    break
        return found


@pytest.fixture
def host() -> Host:
    return Host()


def test_messages_wait_2_s_at_most(host: Host) -> None:
    """A message that waited for more than 2 s is dropped with all but the newest ones, which report the loss."""
    for number in range(50):
        host.put(number)
        host.time += 0.1
    assert [(each.sequence, each.lost) for each in host.read()] == [(48, 48), (49, 0)]
    [load] = host.loads
    assert (load.dropped, bool(load.overload)) == (48, True)


def test_messages_that_waited_for_less_than_2_s_are_all_read(host: Host) -> None:
    """A host that was stopped for 1.9 s loses nothing, and is overloaded until 5 s after the last late message."""
    for number in range(19):
        host.put(number)
        host.time += 0.1
    assert len(host.read()) == 19
    assert host.loads == [LinkLoad(0, "host overloaded: messages up to 1.9 s late, 0 dropped")]
    host.time += 4.9
    assert host.read() == []
    assert len(host.loads) == 1
    host.time += 0.2
    assert host.read() == []
    assert host.loads[1:] == [LinkLoad()]


def test_overload_is_reported_before_a_late_message(host: Host) -> None:
    """A message that is more than 0.5 s late follows the report of the overload."""
    host.put(0)
    host.time += 0.6
    first, second = islice(host.queue.read(0.0, lost_by_host=0), 2)
    assert isinstance(first, LinkLoad)
    assert "0.6 s late" in first.overload
    assert isinstance(second, Received)


def test_datagrams_that_the_system_dropped_are_an_overload(host: Host) -> None:
    """Datagrams that the operating system dropped count like messages that the queue dropped."""
    host.put(0)
    host.read(lost_by_host=3)
    assert host.loads == [LinkLoad(3, "host overloaded: messages up to 0.0 s late, 3 dropped")]


def test_messages_that_wait_are_limited(monkeypatch: pytest.MonkeyPatch, host: Host) -> None:
    """Beyond the limit, the oldest message of the vehicle with most messages is dropped, and counted as lost."""
    monkeypatch.setattr(limits, "MAVLINK_WAITING", 10)
    host.put(0, system=2)
    for number in range(12):
        host.put(number)
    read = host.read()
    assert [(each.sequence, each.lost) for each in read if each.system == 1] == [
        (3, 3),
        *((n, 0) for n in range(4, 12)),
    ]
    assert [(each.sequence, each.lost) for each in read if each.system == 2] == [(0, 0)]


def received(
    data: bytes, *, system: int = 1, message: Any = DATA, lost: int = 0, **chunk: Any
) -> Received:
    return Received(message, system, 7, None, 100.0, lost, Chunk("delivered", data, **chunk))


def test_contiguous_data_is_joined() -> None:
    """Plain ULog data of a vehicle without a gap becomes one message; a gap, a new stream and acked data separate."""
    heartbeat = Received(HEARTBEAT, 1, 8, None, 100.0)
    items = [
        received(b"ab", lost=2), heartbeat, received(b"cd"), received(b"x", system=2), received(b"ef", offset=255),
        received(b"gap", lost=1), received(b"h"), received(b"acked", message=ACKED), received(b"i"),
        received(b"new", begins=True), received(b"j"), Received(DATA, 1, 9, None, 1.0, 0, Chunk("duplicate")),
        received(b"k"),
    ]  # fmt: skip
    found = [each for each in join_data(items) if isinstance(each, Received)]
    data = [(each.chunk.data, each.parts, each.lost) for each in found if each.chunk]
    assert data == [
        (b"abcdef", 3, 2), (b"x", 1, 0), (b"gaph", 2, 1), (b"acked", 1, 0), (b"i", 1, 0), (b"newj", 2, 0), (b"", 1, 0),
        (b"k", 1, 0),
    ]  # fmt: skip
    assert found[1] is heartbeat
    lost_data = [received(b"ab"), received(b"cd")]
    lost_data[1] = lost_data[1]._replace(chunk=Chunk("delivered", b"cd", lost=1))
    assert join_data(lost_data) == lost_data


def test_data_of_another_address_and_acknowledged_data_is_not_joined() -> None:
    """Data from another address may be of another stream; acknowledged data may wait longer than other data."""
    stranger = received(b"cd")._replace(peer="stranger")
    for items in (
        [received(b"ab"), stranger],
        [received(b"ab", message=ACKED), received(b"cd", message=ACKED)],
    ):
        assert join_data(items) == items


@pytest.mark.parametrize(
    ("offsets", "offset"), [((0, 1), 0), ((255, 1), 4), ((255, 255), 258), ((2, 255), 2)]
)
def test_joined_data_has_the_offset_of_its_first_record(
    offsets: tuple[int, int], offset: int
) -> None:
    """The first record that begins in joined data is that of the first part, or else that of the second."""
    (joined,) = join_data([received(b"abc", offset=offsets[0]), received(b"de", offset=offsets[1])])
    assert isinstance(joined, Received)
    assert joined.chunk == Chunk("delivered", b"abcde", offset=offset)


def test_joined_data_counts_as_its_parts(host: Host) -> None:
    """Dropped joined data counts as lost with each of its messages."""
    (joined,) = join_data([received(b"abc"), received(b"de"), received(b"f")])
    host.queue.put(joined)
    host.time += 3
    host.put(9, Chunk("delivered", b"next", offset=0))
    (last,) = host.read()
    assert (last.lost, last.chunk) == (3, Chunk("delivered", b"next", lost=3))
    assert host.loads[0].dropped == 3


def test_stream_resumes_at_a_record_after_dropped_data(host: Host) -> None:
    """After dropped LOGGING_DATA, data begins with a record, and all dropped ones count as lost; acked ones stay."""
    host.put(0, Chunk("delivered", b"header", begins=True), message=ACKED)
    host.put(1, Chunk("delivered", b"one", lost=2, offset=1))
    host.put(2, Chunk("duplicate"))
    host.put(3, Chunk("delivered", b"late topic", offset=5), message=ACKED)
    host.put(4, Chunk("delivered", b"two"))
    host.time += 3
    host.put(5, Chunk("delivered", b"no begin", offset=255))
    host.put(6, Chunk("delivered", b"end, begin", lost=1, offset=5))
    host.put(7, Chunk("delivered", b"three", offset=2))
    assert [(each.sequence, each.chunk) for each in host.read()] == [
        (0, Chunk("delivered", b"header", begins=True)),
        (3, Chunk("delivered", b"topic", lost=3)),
        (5, Chunk("unsynchronised", lost=1)),
        (6, Chunk("delivered", b"begin", lost=1)),
        (7, Chunk("delivered", b"three", offset=2)),
    ]


def test_stream_whose_beginning_was_dropped_is_not_decoded(
    monkeypatch: pytest.MonkeyPatch, host: Host
) -> None:
    """Without the first message of a stream nothing is delivered until the next stream."""
    monkeypatch.setattr(limits, "MAVLINK_WAITING", 3)
    host.put(0, Chunk("delivered", b"header", begins=True), message=ACKED)
    host.put(1, Chunk("delivered", b"one"))
    host.put(2, Chunk("delivered", b"two"))
    host.put(3, Chunk("delivered", b"new", begins=True), message=ACKED)
    assert [each.chunk for each in host.read()] == [Chunk("no_definitions")] * 2 + [
        Chunk("delivered", b"new", begins=True)
    ]


def test_vehicles_share_the_time_of_the_source(host: Host) -> None:
    """A vehicle whose messages take 100 times as long gets half of the time, while others wait for one of them."""
    for number in range(400):
        host.put(number, system=1)
        host.put(number, system=2)
    read, wait = Counter[int](), 0.0
    waits = {2: 0.0}
    last = host.time
    while host.time < 101.5:
        for each in host.queue.read(0.0, lost_by_host=0):
            if isinstance(each, Received):
                read[each.system] += 1
                if each.system == 2:
                    waits[2], last = max(waits[2], host.time - last), host.time
                host.time += 0.1 if each.system == 1 else 0.001
        wait = max(wait, waits[2])
    assert read[2] == 400
    assert 4 <= read[1] <= 15
    assert wait < 0.25


def test_silent_vehicle_saves_no_time(host: Host) -> None:
    """A vehicle that was silent while another one was served gets no more than its share when it returns."""
    for number in range(20):
        host.put(number, system=2)
        for _ in host.queue.read(0.0, lost_by_host=0):
            host.time += 0.1
    for number in range(5):
        host.put(number, system=1)
        host.put(number, system=2)
    systems = list[int]()
    while len(systems) < 10:
        for each in host.queue.read(0.0, lost_by_host=0):
            if isinstance(each, Received):
                systems.append(each.system)
                host.time += 0.1
    assert max(len(list(run)) for _, run in groupby(systems)) <= 2, systems


def test_rejections_are_counted_together(host: Host) -> None:
    """Equal rejections that wait become one with their number, so that a flood of them takes no memory."""
    for _ in range(5000):
        host.queue.put(Rejection("link", "noise"))
    for number in range(2000):
        host.queue.put(Rejection("link", str(number)))
    assert host.read() == []
    assert host.rejections[0].count >= 5000
    assert len(host.rejections) == 1001  # the last one is for all beyond the limit
    assert sum(each.count for each in host.rejections) == 7000


def test_error_is_raised_after_the_last_message() -> None:
    """An error of the receiving thread wakes the source, which first reads all messages."""
    host = Host()
    host.put(0)
    threading.Timer(0.0, host.queue.fail, [OSError("gone")]).start()
    assert next(host.queue.read(DEADLINE, lost_by_host=0))
    with pytest.raises(OSError, match="gone"):
        list(host.queue.read(DEADLINE, lost_by_host=0))


def test_rejections_beyond_the_limit_are_counted_apart(
    host: Host, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beyond the limit of different rejections, further ones are counted together, and not for an unrelated place."""
    monkeypatch.setattr(limits, "WAITING_REJECTIONS", 3)
    host.queue.put(*(Rejection(f"{number} x", "bad") for number in range(3)))
    host.queue.put(
        *(Rejection("99 y", "worse", count=2) for _ in range(5)), Rejection("1 x", "bad")
    )
    host.read()
    assert [(each.where, each.count) for each in host.rejections] == [
        ("0 x", 1), ("1 x", 2), ("2 x", 1), ("further places", 10),
    ]  # fmt: skip
    host.queue.put(Rejection("99 y", "worse"))
    host.read()
    assert host.rejections[-1] == Rejection("99 y", "worse")
