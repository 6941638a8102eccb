"""Acknowledgements of a reader of mode `every`, without Zenoh and without a publisher."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import pytest

from nedbus.client.receiving.pending_queue import MAX_ACK_REQUESTS, AckRequest
from nedbus.transport import RawSample

from .raw_samples import INVALID, KEY, OTHER_KEY, Payload, make_queue, name_of, raw


@dataclass
class Asked:
    """A queue that receives acknowledgement requests, and the names of the acknowledged ones, in order.

    `drained`: the ring is empty when a request arrives.
    """

    now: float = 0.0
    drained: bool = False
    answered: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.queue = make_queue("every", clock=lambda: self.now)

    def ask(self, number: int, *, read: bool = False, publisher: str = "a", name: str = "") -> list[str]:
        """Send a request; return the names of all acknowledged ones."""
        reply = partial(self.answered.append, name or str(number))
        self.queue.acknowledge(AckRequest(KEY, name_of(publisher), number, read, reply), drained=self.drained)
        return self.answered

    def take(self, count: int) -> list[str]:
        """Read samples; return the names of all acknowledged requests."""
        assert all(self.queue.pop(rows=False) for _ in range(count))
        return self.answered

    def put(self, *samples: RawSample) -> list[str]:
        """Put samples into the queue; return the names of all acknowledged requests."""
        self.queue.put(samples)
        return self.answered


@pytest.fixture
def asked() -> Asked:
    return Asked()


def test_read_is_answered_when_all_up_to_it_was_taken(asked: Asked) -> None:
    """A request with `read` is acknowledged once the reader has taken all samples queued when the message arrived."""
    asked.put(raw(0))
    asked.ask(1, read=True)
    assert asked.take(1) == []  # it is still on its way
    asked.put(raw(0, publisher="b"), raw(1))
    asked.put(raw(2))
    assert asked.take(1) == []
    assert asked.take(1) == ["1"]  # what comes later need not be taken


def test_unknown_publisher_is_answered_once_all_is_queued(asked: Asked) -> None:
    """An unknown publisher has sent nothing to this reader, which is certain only when the ring is empty.

    Its message may be among those queued at that time: with `read` all of them have to be taken.
    """
    asked.ask(5, publisher="b")
    assert asked.ask(6, publisher="b", read=True) == []
    assert asked.put(raw(0), raw(1)) == ["5"]
    assert asked.take(1) == ["5"]
    assert asked.take(1) == ["5", "6"]


def test_publishers_are_answered_apart(asked: Asked) -> None:
    """Requests of different publishers, or on different keys, neither delay nor replace each other."""
    asked.put(raw(0), raw(0, publisher="b"), raw(1, publisher="b"))
    asked.ask(1)
    assert asked.ask(1, publisher="b", name="b") == ["b"]
    assert asked.put(raw(0, key=OTHER_KEY), raw(1, key=OTHER_KEY)) == ["b"]


def test_of_too_many_requests_the_oldest_is_forgotten(asked: Asked) -> None:
    """The number of open requests is bounded; publishers repeat theirs."""
    asked.put(raw(0))
    for number in range(1, MAX_ACK_REQUESTS + 3):
        asked.ask(number)
    assert len(asked.put(*map(raw, range(1, MAX_ACK_REQUESTS + 3)))) == MAX_ACK_REQUESTS


def test_queue_answers_when_the_message_is_put(asked: Asked) -> None:
    """A publisher that flushes is acknowledged at once, however slow the script is."""
    asked.put(raw(0))
    assert asked.ask(0) == ["0"]
    assert asked.ask(1) == ["0"]
    assert asked.put(raw(1)) == ["0", "1"]


@pytest.mark.parametrize("payload", [None, INVALID], ids=["valid", "invalid"])
def test_queue_answers_when_the_script_takes_the_message(asked: Asked, payload: Payload | None) -> None:
    """A lossless publisher gets credit for each sample that is read, discarded as invalid, or read in a batch."""
    asked.put(raw(0), raw(1, payload=payload))
    asked.ask(1, read=True)
    asked.put(raw(2), raw(3))
    asked.ask(3, read=True)
    for answered in ([], ["1"]):
        assert asked.queue.pop(rows=False) is not None
        assert asked.answered == answered
    assert asked.queue.pop_batch() is not None
    assert asked.answered == ["1", "3"]


def test_queue_answers_unknown_publishers_while_nothing_is_left_to_receive(asked: Asked) -> None:
    """While another thread receives, the message may be on its way: the request is acknowledged after that."""
    assert asked.ask(7, name="while receiving") == []
    assert asked.put(raw(0, publisher="b")) == ["while receiving"]
    asked.drained = True
    assert asked.ask(7, name="while idle") == ["while receiving", "while idle"]


def test_unknown_publisher_is_not_answered_while_its_messages_may_still_come(asked: Asked) -> None:
    """After the link was broken, an unknown publisher may have sent messages, which its heartbeats will reveal."""
    asked.drained = True
    asked.queue.on_link()
    asked.ask(1)
    assert asked.put(raw(0, publisher="b")) == []
    assert asked.put(raw(0), raw(1)) == ["1"]
    asked.ask(7, publisher="c")
    asked.now += 60.0
    assert asked.put(raw(1, publisher="b")) == ["1", "7"]


def test_request_waits_for_a_gap(asked: Asked) -> None:
    """A sample held back behind a gap has not arrived; a sample that is given up is not waited for."""
    asked.put(raw(0), raw(2))
    assert asked.ask(2) == []
    asked.queue.give_up()
    assert asked.put(raw(3)) == ["2"]


def test_dropped_message_keeps_no_publisher_waiting(asked: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    """A request with `read` is acknowledged if its message was dropped."""
    monkeypatch.setattr("nedbus.client.receiving.pending_queue.CAPACITY", 10)
    asked.put(raw(0), raw(1))
    assert asked.ask(1, read=True) == []
    assert asked.put(*map(raw, range(2, 20))) == ["1"]


def test_end_of_the_queue_answers_all(asked: Asked) -> None:
    """A closed queue acknowledges all open and all later requests, so that no publisher waits for it."""
    asked.put(raw(0))
    asked.ask(0, read=True, name="read")
    asked.ask(9, name="arrived")
    assert asked.ask(0, publisher="b", name="unknown") == []
    asked.queue.end()
    assert asked.answered == ["read", "arrived", "unknown"]
    assert asked.ask(9, name="after")[3:] == ["after"]
