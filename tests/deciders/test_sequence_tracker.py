"""The sequence tracker: what is lost, what is dropped, what is only late."""

from __future__ import annotations

from typing import cast

import hypothesis.strategies as st
import zenoh
from hypothesis import given

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


def test_first_message_tells_no_loss() -> None:
    """A reader that joins late has missed nothing of its own."""
    tracker = SequenceTracker()
    assert follow(tracker, 1000) == [0]
    assert tracker.lost == 0


def test_gap_is_lost_just_before_the_message_behind_it() -> None:
    """Numbers that are absent are counted once, at the next message."""
    tracker = SequenceTracker()
    assert follow(tracker, 0, 1, 5, 6, 8) == [0, 0, 3, 0, 1]
    assert (tracker.lost, tracker.dropped) == (4, 0)


def test_settled_stream_needs_no_publisher() -> None:
    """The id of a publisher is costly: a stream of one publisher is soon followed by number alone."""
    tracker = SequenceTracker()
    follow(tracker, *range(SETTLED + 1))
    unnamed = [cast("zenoh.SourceInfo", Unnamed(SETTLED + 1 + number)) for number in range(3)]
    assert [tracker.arrived("key", each) for each in unnamed] == [0, 0, 0]
    assert follow(tracker, SETTLED + 10) == [6]


def test_numbers_wrap() -> None:
    """After 2^32 - 1 comes 0, without a loss; a gap across the wrap has its true size."""
    tracker = SequenceTracker()
    assert follow(tracker, WRAP - 2, WRAP - 1, 0, 1) == [0, 0, 0, 0]
    assert follow(tracker, WRAP - 3, stream="other", publisher="b") == [0]
    assert follow(tracker, 2, stream="other", publisher="b") == [4]
    assert follow(tracker, 4) == [2]


def test_losses_are_still_seen_after_the_wrap() -> None:
    """Ten hours at full speed do not end the counting."""
    tracker = SequenceTracker()
    follow(tracker, WRAP - 1, 0)
    assert follow(tracker, 2, 3, 5) == [1, 0, 1]


def test_late_and_doubled_messages_are_not_losses() -> None:
    """A number that comes too late, or twice, changes nothing; the next expected one is none lost."""
    tracker = SequenceTracker()
    assert follow(tracker, 10, 12, 11, 12, 13) == [0, 1, 0, 0, 0]
    assert tracker.lost == 1


def test_restart_with_another_id_begins_anew() -> None:
    """A publisher that starts again has a new id and begins at 0: nothing is lost, and its own gaps count."""
    tracker = SequenceTracker()
    assert follow(tracker, 5000, 5001) == [0, 0]
    assert follow(tracker, 0, 1, 3, publisher="b") == [0, 0, 1]
    assert tracker.lost == 1


def test_restart_with_the_same_id_begins_anew() -> None:
    """A number that is far too low is a restart, not a late message: losses after it are seen at once."""
    tracker = SequenceTracker()
    follow(tracker, 10_000_000)
    assert follow(tracker, 0, 1, 3) == [0, 0, 1]


def test_restart_far_ahead_is_not_a_gap_of_billions() -> None:
    """No stream misses 2^30 messages: what jumps so far started again."""
    tracker = SequenceTracker()
    assert follow(tracker, 0, 2**31 - 5) == [0, 0]
    assert tracker.lost == 0


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


def test_announced_loss_is_counted_once() -> None:
    """Zenoh announces what recovery gave up; the gap that follows is the same loss."""
    tracker = SequenceTracker()
    follow(tracker, 0)
    tracker.announce(name_of("a"), 3)
    assert tracker.lost == 3
    assert follow(tracker, 4) == [3]
    assert tracker.lost == 3


def test_announced_loss_at_the_end_of_a_stream_counts() -> None:
    """No message follows, and it is lost all the same; so is one of a publisher that was never heard."""
    tracker = SequenceTracker()
    follow(tracker, 0)
    tracker.announce(name_of("a"), 2)
    tracker.announce(name_of("never heard"), 5)
    assert tracker.lost == 7


def test_queue_that_drops_tells_loss_and_drop_apart() -> None:
    """Of a gap only what was announced was lost in transit; the reader's own queue dropped the rest."""
    tracker = SequenceTracker(queue_drops=True)
    follow(tracker, 0)
    tracker.announce(name_of("a"), 2)
    assert follow(tracker, 10) == [2]
    assert (tracker.lost, tracker.dropped) == (2, 7)


def test_memory_is_bounded_by_least_recent_use() -> None:
    """Many lifetimes of publishers: a stream that is heard all the time is never forgotten, its losses are exact."""
    tracker = SequenceTracker(max_publishers=10)
    for life in range(1000):
        assert follow(tracker, 2 * life, stream="steady", publisher="steady") == [1 if life else 0]
        follow(tracker, 0, 1, 2, stream=f"key {life}", publisher=f"publisher {life}")
    assert tracker.lost == 999
    assert len(tracker._publishers) <= 10
    assert len(tracker._streams) <= 10


def test_forgotten_publisher_keeps_what_was_announced() -> None:
    """Forgetting one bounds memory, and takes nothing back."""
    tracker = SequenceTracker(max_publishers=1)
    follow(tracker, 0)
    tracker.announce(name_of("a"), 3)
    follow(tracker, 0, stream="other", publisher="b")
    assert tracker.lost == 3


@given(
    numbers=st.lists(st.integers(0, 400), min_size=1, max_size=80, unique=True).map(sorted),
    start=st.integers(0, WRAP - 1),
    announced=st.booleans(),
    queue_drops=st.booleans(),
)
def test_every_absent_number_is_counted_once(
    numbers: list[int], start: int, announced: bool, queue_drops: bool
) -> None:
    """For any gaps, anywhere in the sequence, announced or not: arrived, lost and dropped make up the whole."""
    tracker = SequenceTracker(queue_drops=queue_drops)
    reported, last = 0, None
    for number in numbers:
        gap = 0 if last is None else number - last - 1
        if announced and gap:
            tracker.announce(name_of("a"), gap)
        reported += sum(follow(tracker, (start + number) % WRAP))
        last = number
    absent = numbers[-1] - numbers[0] + 1 - len(numbers)
    assert tracker.lost + tracker.dropped == absent
    assert tracker.lost == reported == (absent if announced or not queue_drops else 0)


def test_has_knows_what_arrived_and_what_is_lost() -> None:
    """A publisher is told of all up to a number: it arrived, or recovery gave it up; None where it was never heard."""
    tracker = SequenceTracker()
    assert tracker.has(name_of("a"), 0) is None
    follow(tracker, 10, 11, 15)
    assert [tracker.has(name_of("a"), number) for number in (9, 15, 16, 18)] == [True, True, False, False]
    tracker.announce(name_of("a"), 3)
    assert [tracker.has(name_of("a"), number) for number in (16, 18, 19)] == [True, True, False]
    follow(tracker, 19)
    assert [tracker.has(name_of("a"), number) for number in (19, 20)] == [True, False]
    assert tracker.has(name_of("b"), 0) is None


def test_has_is_right_around_the_wrap() -> None:
    """After 2^32 - 1 comes 0, for whoever asks as well."""
    tracker = SequenceTracker()
    follow(tracker, WRAP - 2, WRAP - 1)
    assert [tracker.has(name_of("a"), number) for number in (WRAP - 1, 0)] == [True, False]
    follow(tracker, 0)
    assert [tracker.has(name_of("a"), number) for number in (WRAP - 1, 0, 1)] == [True, True, False]
