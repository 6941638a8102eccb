"""Many messages of a settled stream at once: the sequence tracker looks at them together while none is absent."""

from __future__ import annotations

from collections.abc import Sequence
from unittest import mock

import hypothesis.strategies as st
import pytest
from hypothesis import given

from nedbus.client import sequence_tracker as module
from nedbus.client.sequence_tracker import SETTLED, SequenceTracker

from .raw_samples import follow, name_of

WRAP = 2**32


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


def test_unknown_stream_is_in_no_order() -> None:
    """The first messages of a stream say who publishes it."""
    tracker = SequenceTracker()
    assert not tracker.arrived_in_order("key", [*range(100)])


def test_wrap_is_looked_at_message_by_message() -> None:
    """The numbers around it are in order all the same, and lose nothing."""
    tracker = SequenceTracker()
    start = WRAP - SETTLED - 10
    follow(tracker, *range(start, start + SETTLED + 1))
    numbers = [number % WRAP for number in range(start + SETTLED + 1, start + SETTLED + 50)]
    assert not tracker.arrived_in_order("key", numbers)
    assert not any(follow(tracker, *numbers))
    assert tracker.arrived_in_order("key", [*range(numbers[-1] + 1, numbers[-1] + 20)])
    assert follow(tracker, numbers[-1] + 21) == [1]


def test_two_publishers_of_a_stream_are_never_in_one_order() -> None:
    """A stream is settled only while one publisher alone sends it."""
    tracker = SequenceTracker()
    for number in range(2 * SETTLED):
        follow(tracker, number, publisher="a")
        follow(tracker, number, publisher="b")
    assert not tracker.arrived_in_order("key", [*range(2 * SETTLED, 2 * SETTLED + 20)])
    assert follow(tracker, 2 * SETTLED, publisher="a") == follow(tracker, 2 * SETTLED, publisher="b") == [0]


def test_second_publisher_unsettles_a_stream() -> None:
    """From its first message on each one is asked for its publisher again."""
    tracker = SequenceTracker()
    follow(tracker, *range(SETTLED + 1))
    follow(tracker, 7, publisher="b")
    assert not tracker.arrived_in_order("key", [*range(SETTLED + 1, SETTLED + 20)])
    assert follow(tracker, SETTLED + 3) == [2]


def test_one_publisher_of_many_keys_is_followed_as_one() -> None:
    """The numbers count its messages on all of them: a stream is settled on its own, a gap belongs to the publisher."""
    tracker = SequenceTracker()
    for number in range(0, 3000, 2):
        assert follow(tracker, number, stream="one") == follow(tracker, number + 1, stream="two") == [0]
    assert not tracker.arrived_in_order("one", [3000, 3002])
    assert follow(tracker, 3004, stream="one") == [4]


def test_publisher_that_is_followed_together_is_not_forgotten() -> None:
    """To be heard is to be heard, whichever way it is noted."""
    tracker = SequenceTracker(max_publishers=3)
    follow(tracker, *range(SETTLED))
    for life in range(20):
        start = SETTLED + 10 * life
        assert tracker.arrived_in_order("key", [*range(start, start + 10)])
        follow(tracker, 0, stream="other", publisher=f"publisher {life}")
    assert tracker.has(name_of("a"), SETTLED + 199)


def test_forgotten_publisher_is_in_no_order() -> None:
    """It is asked for its name, and then known again."""
    tracker = SequenceTracker(max_publishers=1)
    follow(tracker, *range(SETTLED + 1))
    follow(tracker, 0, stream="key", publisher="b")
    assert not tracker.arrived_in_order("key", [*range(SETTLED + 1, SETTLED + 20)])


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
