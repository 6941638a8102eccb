"""Batches from the receive queue: the same messages, gaps and losses as one by one; with samples made by hand."""

from __future__ import annotations

from collections.abc import Callable
from unittest import mock

import hypothesis.strategies as st
from hypothesis import given

from nedbus import Batch, Counts
from nedbus.client import receive_queue as module
from nedbus.client.receive_queue import ReceiveQueue

from .raw_samples import INVALID, KEY, OTHER_KEY, drain, make_queue, miss, raw

# One of two publishers loses so many messages, which Zenoh announces or not, and sends one; then perhaps all is read.
ACTIONS = ["put", "put", "put and read", "put junk"]
EVENTS = st.lists(
    st.tuples(st.sampled_from("ab"), st.integers(0, 3), st.booleans(), st.sampled_from(ACTIONS)), min_size=10
)
KEYS = {"a": KEY, "b": OTHER_KEY}


def take_batch(receive_queue: ReceiveQueue) -> Batch:
    batch = receive_queue.pop_batch()
    assert batch is not None
    return batch


def test_batch_of_newest_tells_losses_before_what_was_superseded() -> None:
    """In mode latest a batch has one message of each key, and all that was lost before it."""
    receive_queue = make_queue("latest")
    receive_queue.put([raw(0), raw(3), raw(4)])
    batch = take_batch(receive_queue)
    assert (batch.sequence.tolist(), batch.lost) == ([4], 2)
    assert receive_queue.counts == Counts(received=1, lost=2, dropped=2)


def test_losses_come_with_the_batch_in_which_the_gap_is() -> None:
    """What is too much for one batch takes its losses into the next."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(number) for number in range(5000) if number not in {4500, 4501}])
    first, second = take_batch(receive_queue), take_batch(receive_queue)
    assert (len(first), len(second)) == (4096, 902)
    assert (first.lost, second.lost) == (0, 2)


def test_reader_that_changes_its_form_is_told_each_loss_once() -> None:
    """Samples and batches of one subscription share what was lost."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0), raw(5)])
    assert sum(sample.lost for sample in drain(receive_queue)) == 4
    receive_queue.put([raw(6), raw(9)])
    assert take_batch(receive_queue).lost == 2
    receive_queue.put([raw(11)])
    assert [sample.lost for sample in drain(receive_queue)] == [1]
    receive_queue.put([raw(12)])
    assert take_batch(receive_queue).lost == 0


def read_samples(receive_queue: ReceiveQueue) -> tuple[list[int], int]:
    """Return the timestamps of what is queued, and how many losses were told."""
    samples = drain(receive_queue)
    return [sample.message.timestamp for sample in samples], sum(sample.lost for sample in samples)


def read_batches(receive_queue: ReceiveQueue) -> tuple[list[int], int]:
    """Return the same, read in batches."""
    batches = list(iter(receive_queue.pop_batch, None))
    return [each for batch in batches for each in batch.messages["timestamp"].tolist()], sum(b.lost for b in batches)


def play(
    events: list[tuple[str, int, bool, str]], read: Callable[[ReceiveQueue], tuple[list[int], int]]
) -> tuple[list[int], int, Counts]:
    """Return what a reader gets in one form, how many losses it is told, and what is counted."""
    receive_queue = make_queue("every")
    numbers, messages, told = {"a": 0, "b": 0}, list[int](), 0
    for publisher, lost, announced, action in [*events, ("a", 0, False, "put"), ("b", 0, False, "put and read")]:
        if announced and lost and numbers[publisher]:
            receive_queue.announce_loss(miss(lost, publisher))
        number = numbers[publisher] + lost
        numbers[publisher] = number + 1
        payload = INVALID if action == "put junk" else None
        receive_queue.put(
            [raw(number, timestamp=number + 1, key=KEYS[publisher], publisher=publisher, payload=payload)]
        )
        if action == "put and read":
            taken, losses = read(receive_queue)
            messages, told = messages + taken, told + losses
    return messages, told, receive_queue.counts


@given(EVENTS)
def test_batches_count_what_samples_count(events: list[tuple[str, int, bool, str]]) -> None:
    """For any losses of two publishers, any drops and any junk: the same messages, losses and counts."""
    with mock.patch.multiple(module, CAPACITY=5, _FRESH=2):
        messages, told, counts = play(events, read_samples)
        assert play(events, read_batches) == (messages, told, counts)
    assert (len(messages), told) == (counts.received, counts.lost)
    assert counts.received + counts.dropped + counts.invalid <= len(events) + 2
