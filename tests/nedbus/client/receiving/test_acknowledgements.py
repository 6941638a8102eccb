"""Acknowledgements of a reader in mode `every`, without Zenoh and without a publisher."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import pytest

from nedbus import limits
from nedbus.client.receiving.inbox import AckRequest
from nedbus.transport import RawSample

from .raw_samples import INVALID, KEY, OTHER_KEY, Payload, make_queue, name_of, raw


@dataclass
class AcknowledgingReader:
    """A queue that receives acknowledgement requests; `acknowledged`: names of the answered requests, in order.

    `drained`: the ring is empty when a request arrives.
    """

    now: float = 0.0
    drained: bool = False
    acknowledged: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.queue = make_queue("every", clock=lambda: self.now)

    def request(
        self, number: int, *, read: bool = False, publisher: str = "a", name: str = ""
    ) -> list[str]:
        """Send a request; return the names of all acknowledged requests."""
        reply = partial(self.acknowledged.append, name or str(number))
        self.queue.acknowledge(
            AckRequest(KEY, name_of(publisher), number, read, reply), drained=self.drained
        )
        return self.acknowledged

    def read(self, count: int) -> list[str]:
        """Read samples; return the names of all acknowledged requests."""
        assert all(self.queue.pop() for _ in range(count))
        return self.acknowledged

    def put(self, *samples: RawSample) -> list[str]:
        """Put samples into the queue; return the names of all acknowledged requests."""
        self.queue.put(samples)
        return self.acknowledged


@pytest.fixture
def reader() -> AcknowledgingReader:
    return AcknowledgingReader()


def test_read_is_acknowledged_after_all_earlier_samples_are_read(
    reader: AcknowledgingReader,
) -> None:
    """A request with `read` is acknowledged once its message and all samples queued before it have been read."""
    reader.put(raw(0))
    reader.request(1, read=True)
    assert reader.read(1) == []  # message 1 is still in transit
    reader.put(raw(0, publisher="b"), raw(1))
    reader.put(raw(2))
    assert reader.read(1) == []
    assert reader.read(1) == ["1"]  # later samples need not be read


def test_unknown_publisher_is_acknowledged_once_the_ring_is_empty(
    reader: AcknowledgingReader,
) -> None:
    """An unknown publisher's request waits until the ring is empty, because the ring may hold its messages.

    A request with `read` also waits until all samples queued at that time have been read.
    """
    reader.request(5, publisher="b")
    assert reader.request(6, publisher="b", read=True) == []
    assert reader.put(raw(0), raw(1)) == ["5"]
    assert reader.read(1) == ["5"]
    assert reader.read(1) == ["5", "6"]


def test_requests_of_publishers_are_independent(reader: AcknowledgingReader) -> None:
    """Requests of different publishers, or on different keys, neither delay nor replace each other."""
    reader.put(raw(0), raw(0, publisher="b"), raw(1, publisher="b"))
    reader.request(1)
    assert reader.request(1, publisher="b", name="b") == ["b"]
    assert reader.put(raw(0, key=OTHER_KEY), raw(1, key=OTHER_KEY)) == ["b"]


@pytest.mark.slow
def test_number_of_open_requests_is_bounded(reader: AcknowledgingReader) -> None:
    """Beyond the limit, the oldest acknowledgement requests are discarded; publishers repeat them."""
    reader.put(raw(0))
    for number in range(1, limits.ACK_REQUESTS + 3):
        reader.request(number)
    assert len(reader.put(*map(raw, range(1, limits.ACK_REQUESTS + 3)))) == limits.ACK_REQUESTS


def test_reception_is_acknowledged_at_once(reader: AcknowledgingReader) -> None:
    """A request without `read`, such as a flush, is acknowledged once its message is queued, even if unread."""
    reader.put(raw(0))
    assert reader.request(0) == ["0"]
    assert reader.request(1) == ["0"]
    assert reader.put(raw(1)) == ["0", "1"]


@pytest.mark.parametrize("payload", [None, INVALID], ids=["valid", "invalid"])
def test_read_is_acknowledged_when_the_script_reads(
    reader: AcknowledgingReader, payload: Payload | None
) -> None:
    """A request with `read` is acknowledged once its sample is read, skipped as invalid, or read in a batch."""
    reader.put(raw(0), raw(1, payload=payload))
    reader.request(1, read=True)
    reader.put(raw(2), raw(3))
    reader.request(3, read=True)
    for acknowledged in ([], ["1"]):
        assert reader.queue.pop() is not None
        assert reader.acknowledged == acknowledged
    assert reader.queue.pop_batch() is not None
    assert reader.acknowledged == ["1", "3"]


def test_request_of_unknown_publisher_waits_while_the_ring_is_drained(
    reader: AcknowledgingReader,
) -> None:
    """An unknown publisher's request waits while another thread drains the ring, which may hold its messages."""
    assert reader.request(7, name="while receiving") == []
    assert reader.put(raw(0, publisher="b")) == ["while receiving"]
    reader.drained = True
    assert reader.request(7, name="while idle") == ["while receiving", "while idle"]


def test_unknown_publisher_is_not_acknowledged_after_a_link_change(
    reader: AcknowledgingReader,
) -> None:
    """After a link change an unknown publisher's request waits, because a heartbeat may still reveal lost messages."""
    reader.drained = True
    reader.queue.on_link_change()
    reader.request(1)
    assert reader.put(raw(0, publisher="b")) == []
    assert reader.put(raw(0), raw(1)) == ["1"]
    reader.request(7, publisher="c")
    reader.now += 60.0
    assert reader.put(raw(1, publisher="b")) == ["1", "7"]


def test_acknowledgement_waits_until_gap_is_closed(reader: AcknowledgingReader) -> None:
    """A sample held back behind a gap is acknowledged only once the gap is filled or counted as lost."""
    reader.put(raw(0), raw(2))
    assert reader.request(2) == []
    reader.queue.give_up()
    assert reader.put(raw(3)) == ["2"]


def test_dropped_message_is_acknowledged(monkeypatch: pytest.MonkeyPatch) -> None:
    """A request with `read` is acknowledged if its message was dropped."""
    monkeypatch.setattr("nedbus.limits.UNREAD_MESSAGES", 10)
    reader = AcknowledgingReader()
    reader.put(raw(0), raw(1))
    assert reader.request(1, read=True) == []
    assert reader.put(*map(raw, range(2, 20))) == ["1"]


def test_closed_queue_acknowledges_all_requests(reader: AcknowledgingReader) -> None:
    """A closed queue acknowledges all open and later requests, so that no publisher waits for its reader."""
    reader.put(raw(0))
    reader.request(0, read=True, name="read")
    reader.request(9, name="arrived")
    assert reader.request(0, publisher="b", name="unknown") == []
    reader.queue.end()
    assert reader.acknowledged == ["read", "arrived", "unknown"]
    assert reader.request(9, name="after")[3:] == ["after"]
