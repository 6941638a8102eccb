"""The sequence tracker: what is lost, dropped, or only late; one by one, and together while none is absent."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from typing import cast
from unittest import mock

import hypothesis.strategies as st
import pytest
import zenoh
from hypothesis import given

from nedbus.client import sequence_tracker as module
from nedbus.client.sequence_tracker import SETTLED, SequenceTracker

from .raw_samples import follow, name_of

WRAP = 2**32


class Unnamed:
    """The source of a message whose publisher must not be asked for."""

    def __init__(self, number: int) -> None:
        self.source_sn = number

    @property
    def source_id(self) -> object:
        raise AssertionError("the publisher's id is not needed for a number that was expected")


def test_settled_stream_needs_no_publisher() -> None:
    """The id of a publisher is costly: a stream of one publisher is soon followed by number alone."""
    tracker = SequenceTracker()
    follow(tracker, *range(SETTLED + 1))
    unnamed = [cast("zenoh.SourceInfo", Unnamed(SETTLED + 1 + number)) for number in range(3)]
    assert [tracker.arrived("key", each) for each in unnamed] == [0, 0, 0]
    assert follow(tracker, SETTLED + 10) == [6]


def test_late_and_doubled_messages_are_not_losses() -> None:
    """A number that comes too late, or twice, changes nothing; the next expected one is none lost."""
    tracker = SequenceTracker()
    assert follow(tracker, 10, 12, 11, 12, 13) == [0, 1, 0, 0, 0]
    assert tracker.lost == 1


@pytest.mark.parametrize(
    ("before", "after", "publisher"),
    [(5000, 0, "b"), (10_000_000, 0, "a"), (0, 2**31 - 5, "a")],
    ids=["another id", "far below", "far ahead"],
)
def test_restart_begins_anew(before: int, after: int, publisher: str) -> None:
    """Nothing is lost by it, be it known by its new id or by a number that jumps far; losses after it count at once."""
    tracker = SequenceTracker()
    assert follow(tracker, before, before + 1) == [0, 0]
    assert follow(tracker, after, after + 1, after + 3, publisher=publisher) == [0, 0, 1]
    assert tracker.lost == 1


def test_two_publishers_of_one_stream_are_followed_apart() -> None:
    """Their numbers interleave, and even coincide, without a loss; a gap of either counts."""
    tracker = SequenceTracker()
    for number in range(2 * SETTLED):
        assert follow(tracker, number, publisher="a") == [0]
        assert follow(tracker, number + 1, publisher="b") == [0]
    assert follow(tracker, 2 * SETTLED + 2, publisher="a") == [2]
    assert follow(tracker, 2 * SETTLED + 2, publisher="b") == [1]
    assert tracker.lost == 3


def test_second_publisher_of_a_settled_stream_is_noticed() -> None:
    """A number that is expected of another publisher is taken for it once at the most."""
    tracker = SequenceTracker()
    follow(tracker, *range(SETTLED + 1))
    assert follow(tracker, SETTLED + 1, publisher="b") == [0]  # taken for that of a
    for number in range(SETTLED + 1, 2 * SETTLED):
        assert follow(tracker, number, publisher="a") == [0]
        assert follow(tracker, number + 1, publisher="b") == [0]
    assert follow(tracker, 2 * SETTLED + 5, publisher="b") == [4]
    assert follow(tracker, 2 * SETTLED + 1, publisher="a") == [1]
    assert tracker.lost == 5


def test_memory_is_bounded_by_least_recent_use() -> None:
    """Many lifetimes of publishers: a stream that is heard all the time is never forgotten, its losses are exact."""
    tracker = SequenceTracker(max_publishers=10)
    sizes = []
    for life in range(1000):
        assert follow(tracker, 2 * life, stream="steady", publisher="steady") == [1 if life else 0]
        follow(tracker, 0, 1, 2, stream=f"key {life}", publisher=f"publisher {life}")
        sizes.append(len(pickle.dumps(tracker)))
    assert tracker.lost == 999
    assert sizes[-1] < 1.2 * sizes[20]
    known = [life for life in range(1000) if tracker.has(name_of(f"publisher {life}"), 0)]
    assert known == list(range(991, 1000))


def test_announced_loss_that_no_message_follows_counts() -> None:
    """At the end of a stream, of a publisher that was never heard, and of one that was forgotten meanwhile."""
    tracker = SequenceTracker(max_publishers=1)
    follow(tracker, 0)
    tracker.announce(name_of("a"), 2)
    tracker.announce(name_of("never heard"), 5)
    assert tracker.lost == 7
    follow(tracker, 0, stream="other", publisher="b")
    assert tracker.lost == 7


@given(
    gaps=st.lists(st.integers(0, 3) | st.integers(0, 200), max_size=80),
    start=st.integers(0, WRAP - 1) | st.integers(WRAP - 200, WRAP - 1),
    announced=st.integers(0, 300),
    queue_drops=st.booleans(),
)
def test_every_absent_number_is_counted_once(gaps: list[int], start: int, announced: int, queue_drops: bool) -> None:
    """For any gaps, anywhere in the sequence, announced up to a size or not: each is told just behind it, and once.

    The first message tells none. Of a gap that the reader's own queue left only what was announced was lost in transit.
    """
    tracker = SequenceTracker(queue_drops=queue_drops)
    assert follow(tracker, start) == [0]
    number, told = start, 0
    for gap in gaps:
        if in_transit := min(gap, announced):
            tracker.announce(name_of("a"), in_transit)
        assert tracker.lost == told + in_transit
        number += gap + 1
        lost = in_transit if queue_drops else gap
        assert follow(tracker, number % WRAP) == [lost]
        told += lost
    assert (tracker.lost, tracker.dropped) == (told, sum(gaps) - told)


@pytest.mark.parametrize("first", [10, WRAP - 2, WRAP - 7])
def test_has_knows_what_arrived_and_what_is_lost(first: int) -> None:
    """A publisher is told of all up to a number: it arrived, or recovery gave it up; None where it was never heard.

    After 2^32 - 1 comes 0, for whoever asks as well.
    """
    tracker = SequenceTracker()

    def has(*steps: int) -> list[bool | None]:
        return [tracker.has(name_of("a"), (first + step) % WRAP) for step in steps]

    assert has(0) == [None]
    follow(tracker, *((first + step) % WRAP for step in (0, 1, 5)))
    assert has(-1, 5, 6, 8) == [True, True, False, False]
    tracker.announce(name_of("a"), 3)
    assert has(6, 8, 9) == [True, True, False]
    follow(tracker, (first + 9) % WRAP)
    assert has(9, 10) == [True, False]
    assert tracker.has(name_of("b"), 0) is None


def follow_together(tracker: SequenceTracker, numbers: Sequence[int]) -> int:
    """Return what was lost before any of these numbers, which are looked at together if that suffices."""
    if tracker.arrived_in_order("key", list(numbers)):
        return 0
    return sum(follow(tracker, *numbers))


def test_many_in_order_are_noted_together() -> None:
    """Of a settled stream a whole batch costs one comparison, and what is lost behind it is seen."""
    tracker = SequenceTracker()
    follow(tracker, *range(SETTLED + 1))
    assert tracker.arrived_in_order("key", [*range(SETTLED + 1, SETTLED + 50)])
    assert tracker.arrived_in_order("key", [*range(SETTLED + 50, SETTLED + 60)])
    assert follow(tracker, SETTLED + 63) == [3]
    assert tracker.lost == 3


@pytest.mark.parametrize(
    ("settled", "numbers"),
    [
        (0, range(100)),  # the first, which say who publishes the stream
        (SETTLED - 1, range(SETTLED - 1, SETTLED + 20)),  # one message short of settled
        (SETTLED + 1, range(SETTLED + 2, SETTLED + 20)),  # a gap before
        (SETTLED + 1, [SETTLED + 1, SETTLED + 2, SETTLED + 4]),  # a gap within
        (SETTLED + 1, [SETTLED + 2, SETTLED + 1]),  # in another order
        (SETTLED + 1, range(SETTLED, SETTLED + 20)),  # one twice
    ],
)
def test_what_is_not_in_order_has_to_be_looked_at(settled: int, numbers: Sequence[int]) -> None:
    """Nothing is noted of it: each message is then followed by itself, and tells its own loss."""
    tracker, twin = SequenceTracker(), SequenceTracker()
    follow(tracker, *range(settled))
    follow(twin, *range(settled))
    assert not tracker.arrived_in_order("key", list(numbers))
    assert follow(tracker, *numbers) == follow(twin, *numbers)
    assert tracker.lost == twin.lost


def test_second_publisher_unsettles_a_stream() -> None:
    """From its first message on each one is asked for its publisher again, and as long as both send."""
    tracker = SequenceTracker()
    follow(tracker, *range(SETTLED + 1))
    follow(tracker, 7, publisher="b")
    assert not tracker.arrived_in_order("key", [*range(SETTLED + 1, SETTLED + 20)])
    assert follow(tracker, SETTLED + 3) == [2]
    for number in range(SETTLED + 4, 3 * SETTLED):
        assert follow(tracker, number) == [0]
        follow(tracker, number, publisher="b")
    assert not tracker.arrived_in_order("key", [*range(3 * SETTLED, 3 * SETTLED + 20)])


def test_one_publisher_of_many_keys_is_followed_as_one() -> None:
    """The numbers count its messages on all of them: a stream is settled on its own, a gap belongs to the publisher."""
    tracker = SequenceTracker()
    for number in range(0, 3000, 2):
        assert follow(tracker, number, stream="one") == follow(tracker, number + 1, stream="two") == [0]
    assert not tracker.arrived_in_order("one", [3000, 3002])
    assert follow(tracker, 3004, stream="one") == [4]


def test_publisher_that_is_followed_together_is_not_forgotten() -> None:
    """To be heard is to be heard, whichever way it is noted; one that was forgotten is asked for its name."""
    tracker = SequenceTracker(max_publishers=3)
    follow(tracker, *range(SETTLED))
    for life in range(20):
        start = SETTLED + 10 * life
        assert tracker.arrived_in_order("key", [*range(start, start + 10)])
        follow(tracker, 0, stream="other", publisher=f"publisher {life}")
    assert tracker.has(name_of("a"), SETTLED + 199)
    for life in range(3):
        follow(tracker, 0, stream="key", publisher=f"new {life}")
    assert not tracker.arrived_in_order("key", [*range(SETTLED + 200, SETTLED + 220)])


@given(
    gaps=st.lists(st.sampled_from([0, 0, 0, 0, 0, 0, 0, 0, 1, 5]), min_size=1, max_size=100),
    start=st.integers(0, WRAP - 1) | st.integers(WRAP - 100, WRAP - 1),
    sizes=st.lists(st.integers(1, 12), min_size=1),
)
def test_together_counts_what_one_by_one_counts(gaps: list[int], start: int, sizes: list[int]) -> None:
    """For any gaps, however the messages are divided into batches."""
    numbers, number = list[int](), start
    for gap in gaps:
        number += gap
        numbers.append(number % WRAP)
        number += 1
    with mock.patch.object(module, "SETTLED", 5):
        together, single = SequenceTracker(), SequenceTracker()
        lost, at, turn = 0, 0, 0
        while at < len(numbers):
            size = sizes[turn % len(sizes)]
            lost += follow_together(together, numbers[at : at + size])
            at, turn = at + size, turn + 1
        assert lost == sum(follow(single, *numbers)) == sum(gaps[1:])
    assert (together.lost, together.dropped) == (single.lost, single.dropped) == (lost, 0)
