"""A reader of mode `every` that is slower than the data: what is kept for it, what is dropped, and what it is told."""

from __future__ import annotations

import pytest
import zenoh

from nedbus import Counts, Mode
from nedbus.client import receive_queue as module
from nedbus.client.decoder import Kept
from nedbus.client.questions import Question
from nedbus.client.receive_queue import CAPACITY, ReceiveQueue
from nedbus_msgs import encoding_of

from .raw_samples import INVALID, OTHER_KEY, drain, make_queue, miss, raw, timestamps


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> ReceiveQueue:
    """Return a queue of mode `every` for 10 samples, of which 4 are kept as they are."""
    monkeypatch.setattr(module, "CAPACITY", 10)
    monkeypatch.setattr(module, "_FRESH", 4)
    return make_queue("every")


def test_every_keeps_65536_samples(caplog: pytest.LogCaptureFixture) -> None:
    """Up to there a slow reader loses nothing; one more, and the oldest is dropped."""
    receive_queue = make_queue("every")
    for start in range(0, CAPACITY, 2**12):
        receive_queue.put([raw(number) for number in range(start, start + 2**12)])
    assert receive_queue.counts == Counts()
    assert not caplog.messages
    receive_queue.put([raw(CAPACITY)])
    assert receive_queue.counts == Counts(dropped=1)
    assert len(drain(receive_queue)) == CAPACITY == 65_536
    assert receive_queue.counts == Counts(received=CAPACITY, dropped=1)


def test_oldest_are_dropped_counted_and_warned_of_once(small: ReceiveQueue, caplog: pytest.LogCaptureFixture) -> None:
    """The reader goes on with what is newer, knows how many it missed, and the log says so one time."""
    for start in range(0, 40, 8):
        small.put([raw(number, timestamp=number + 1) for number in range(start, start + 8)])
    assert small.counts == Counts(dropped=30)
    assert timestamps(small) == list(range(31, 41))
    assert small.counts == Counts(received=10, dropped=30)
    assert caplog.messages == ["queue: the reader is slower than the data: messages are dropped"]


def test_what_was_dropped_was_not_lost(small: ReceiveQueue) -> None:
    """Drops are no gaps of the sequence: no sample tells a loss of what arrived here."""
    small.put([raw(number) for number in range(25)])
    assert not any(sample.lost for sample in drain(small))
    assert small.counts == Counts(received=10, dropped=15)


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


def test_samples_that_wait_are_kept_compact(small: ReceiveQueue) -> None:
    """Zenoh's sample holds the buffer in which it was received: what waits behind others is kept without it."""
    stamp = zenoh.Timestamp.parse_rfc3339("2026-11-21T00:00:00.000000000Z/33")
    encoding = encoding_of("ulog", frozenset({"timestamp"}))
    for number in range(9):
        small.put([raw(number, stamp=stamp, encoding=encoding)])
    kinds = [isinstance(each, Kept) for _, _, each, _ in small._every]
    assert kinds == [False] * 5 + [True] * 4
    samples = drain(small)
    assert {sample.sent for sample in samples} == {stamp.get_time_as_ntp64().as_nanos()}
    assert {sample.provenance for sample in samples} == {samples[0].provenance}
    assert (samples[-1].source, len(samples[-1].missing)) == ("ulog", 52)


def test_compact_samples_keep_their_place_in_the_sequence(small: ReceiveQueue) -> None:
    """A batch has the stamp, the sequence number and the provenance of each, however long it waited."""
    stamp = zenoh.Timestamp.parse_rfc3339("2026-11-21T00:00:00.000000000Z/33")
    for number in range(9):
        small.put([raw(number, stamp=stamp if number % 2 else None, encoding=encoding_of(f"source{number}"))])
    batch = small.pop_batch()
    assert batch is not None
    assert batch.sequence.tolist() == list(range(9))
    assert [bool(sent) for sent in batch.sent] == [bool(number % 2) for number in range(9)]
    assert [each.source for each in batch.provenances] == [f"source{number}" for number in range(9)]


def test_channel_that_was_full_dropped_what_is_absent(caplog: pytest.LogCaptureFixture) -> None:
    """What Zenoh's channel pushed out, unread, was dropped here, and not lost in transit; the log says so once."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0), raw(1)])
    receive_queue.put([raw(50), raw(51), raw(60)], overflowed=True)
    receive_queue.put([raw(100)], overflowed=True)
    assert not any(sample.lost for sample in drain(receive_queue))
    assert receive_queue.counts == Counts(received=6, dropped=48 + 8 + 39)
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


def test_gap_after_the_channel_was_emptied_is_a_loss_again() -> None:
    """Only what comes out of a full channel is in doubt."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0)])
    receive_queue.put([raw(10)], overflowed=True)
    receive_queue.put([raw(11), raw(15)])
    assert [sample.lost for sample in drain(receive_queue)] == [0, 0, 0, 3]
    assert receive_queue.counts == Counts(received=4, lost=3, dropped=9)


def test_dropped_message_keeps_no_publisher_waiting(small: ReceiveQueue) -> None:
    """A publisher that asks whether its message was read is answered when it was dropped, too."""
    answered: list[bool] = []
    small.put([raw(0), raw(1)])
    small.ask(Question("a:1", 1, read=True, reply=lambda: answered.append(True)))
    assert not answered
    small.put([raw(number) for number in range(2, 20)])
    assert answered == [True]
