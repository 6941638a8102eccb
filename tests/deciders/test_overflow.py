"""A reader of mode `every` that is slower than the data: what is kept for it, what is dropped, and what it is told."""

from __future__ import annotations

import weakref

import pytest
import zenoh

from nedbus import Counts, Mode
from nedbus.client import receive_queue as module
from nedbus.client.questions import Question
from nedbus.client.receive_queue import CAPACITY, ReceiveQueue
from nedbus_msgs import encoding_of

from .raw_samples import INVALID, OTHER_KEY, drain, make_queue, miss, raw

STAMP = zenoh.Timestamp.parse_rfc3339("2026-11-21T00:00:00.000000000Z/33")


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> ReceiveQueue:
    """Return a queue of mode `every` for 10 samples, of which 4 are kept as they are."""
    monkeypatch.setattr(module, "CAPACITY", 10)
    monkeypatch.setattr(module, "_FRESH", 4)
    return make_queue("every")


def test_oldest_are_dropped_counted_and_warned_of_once(small: ReceiveQueue, caplog: pytest.LogCaptureFixture) -> None:
    """The reader goes on with what is newer, knows how many it missed, not as lost, and the log says so once."""
    assert CAPACITY == 65_536
    for start in range(0, 40, 10):
        assert (small.counts, len(caplog.messages)) == (Counts(dropped=max(0, start - 10)), start > 10)
        small.put([raw(number, timestamp=number + 1) for number in range(start, start + 10)])
    samples = drain(small)
    assert [(sample.message.timestamp, sample.lost) for sample in samples] == [(each, 0) for each in range(31, 41)]
    assert small.counts == Counts(received=10, dropped=30)
    assert caplog.messages == ["queue: the reader is slower than the data: messages are dropped"]


def test_losses_before_dropped_samples_are_told_by_a_later_one_of_that_key(small: ReceiveQueue) -> None:
    """Nothing lost in transit goes untold because the sample behind the gap was dropped."""
    small.put([raw(0), raw(3), raw(0, key=OTHER_KEY, publisher="b"), raw(2, key=OTHER_KEY, publisher="b"), raw(5)])
    small.put([raw(number) for number in range(6, 15)])
    small.put([raw(3, key=OTHER_KEY, publisher="b")])
    samples = drain(small)
    assert [(sample.vehicle, sample.lost) for sample in samples if sample.lost] == [("1", 3), ("2", 1)]
    assert samples[-1].vehicle == "2"
    assert small.counts == Counts(received=10, lost=4, dropped=5)


def test_losses_before_a_dropped_sample_survive_invalid_ones(small: ReceiveQueue) -> None:
    """They wait for the next sample of that key that a reader gets."""
    small.put([raw(0), raw(3)])
    small.put([raw(number, payload=INVALID) for number in range(4, 13)])
    small.put([raw(13)])
    assert [sample.lost for sample in drain(small)] == [2]
    assert small.counts == Counts(received=1, lost=2, dropped=2, invalid=9)


@pytest.mark.parametrize("in_batches", [False, True])
def test_samples_that_wait_are_kept_compact(small: ReceiveQueue, in_batches: bool) -> None:
    """Zenoh's sample holds the buffer in which it was received: what waits behind others is kept without it.

    It keeps its place in the sequence, stamp and provenance.
    """
    encodings = [encoding_of(f"source{number}", frozenset({"timestamp"})) for number in range(9)]
    arriving = [raw(number, stamp=STAMP if number % 2 else None, encoding=encodings[number]) for number in range(9)]
    arrived = [weakref.ref(each) for each in arriving]
    while arriving:
        small.put([arriving.pop(0)])
    assert [each() is None for each in arrived] == [False] * 5 + [True] * 4
    if in_batches:
        batch = small.pop_batch()
        assert batch is not None
        assert batch.sequence.tolist() == list(range(9))
        sent, provenances = batch.sent.tolist(), list(batch.provenances)
    else:
        samples = drain(small)
        sent, provenances = [sample.sent or 0 for sample in samples], [sample.provenance for sample in samples]
    assert sent == [STAMP.get_time_as_ntp64().as_nanos() if number % 2 else 0 for number in range(9)]
    assert [(each.source, len(each.missing)) for each in provenances] == [(f"source{each}", 52) for each in range(9)]


def test_channel_that_was_full_dropped_what_is_absent(caplog: pytest.LogCaptureFixture) -> None:
    """What Zenoh's channel pushed out, unread, was dropped here, and not lost in transit; the log says so once.

    Only what comes out of a full channel is in doubt: a gap after that is a loss again.
    """
    receive_queue = make_queue("every")
    receive_queue.put([raw(0), raw(1)])
    receive_queue.put([raw(50), raw(51), raw(60)], overflowed=True)
    receive_queue.put([raw(100)], overflowed=True)
    receive_queue.put([raw(101), raw(105)])
    assert [sample.lost for sample in drain(receive_queue)] == [0] * 7 + [3]
    assert receive_queue.counts == Counts(received=8, lost=3, dropped=48 + 8 + 39)
    assert len(caplog.messages) == 1


@pytest.mark.parametrize("mode", ["every", "latest"])
def test_full_channel_does_not_hide_announced_losses(mode: Mode) -> None:
    """Of a gap that a full channel left, what Zenoh announced was lost in transit, and the rest was dropped."""
    receive_queue = make_queue(mode)
    receive_queue.put([raw(0)])
    drain(receive_queue)
    receive_queue.announce_loss(miss(3))
    receive_queue.put([raw(10)], overflowed=True)
    assert [sample.lost for sample in drain(receive_queue)] == [3]
    assert receive_queue.counts == Counts(received=2, lost=3, dropped=6)


def test_dropped_message_keeps_no_publisher_waiting(small: ReceiveQueue) -> None:
    """A publisher that asks whether its message was read is answered when it was dropped, too."""
    answered: list[bool] = []
    small.put([raw(0), raw(1)])
    small.ask(Question("a:1", 1, read=True, reply=lambda: answered.append(True)))
    assert not answered
    small.put([raw(number) for number in range(2, 20)])
    assert answered == [True]
