"""What a reader of mode `every` makes of holes: held, filled, given up; without Zenoh."""

from __future__ import annotations

import dataclasses
from functools import partial
from itertools import pairwise

import hypothesis.strategies as st
import pytest
from hypothesis import given

from nedbus import Counts
from nedbus.client import receive_queue as module
from nedbus.client.decoder import MAX_KEYS
from nedbus.client.publisher_sequence import Hole
from nedbus.client.questions import Question
from nedbus.client.receive_queue import ReceiveQueue

from .raw_samples import INVALID, KEY, OTHER_KEY, Payload, drain, junk, make_queue, miss, name_of, raw, timestamps


class Recovering:
    """A queue of mode `every` and the holes that it wants to be filled."""

    def __init__(self) -> None:
        self.queue: ReceiveQueue = make_queue("every")
        self.holes: list[Hole] = []
        self.queue.recover(self.holes.append)

    def put(self, *numbers: int, publisher: str = "a", key: str = KEY, overflowed: bool = False) -> None:
        self.queue.put([raw(n, timestamp=n + 1, publisher=publisher, key=key) for n in numbers], overflowed=overflowed)

    def fill(self, *numbers: int, hole: int = 0) -> None:
        """Fill a hole with these messages."""
        found = self.holes.pop(hole)
        name = found.publisher.partition(":")[0]
        self.queue.fill(found, [raw(n, timestamp=n + 1, publisher=name, key=found.stream) for n in numbers])

    @property
    def numbers(self) -> list[int]:
        """Take all that is queued."""
        return [timestamp - 1 for timestamp in timestamps(self.queue)]

    @property
    def asked(self) -> list[tuple[int, int, bool]]:
        return [(hole.start, hole.stop, hole.exact) for hole in self.holes]


@pytest.fixture
def recovering() -> Recovering:
    return Recovering()


def test_what_comes_after_a_hole_waits_for_it(recovering: Recovering) -> None:
    """The reader gets all in order, and nothing is lost."""
    recovering.put(0, 1, 4, 5)
    assert recovering.asked == [(2, 4, True)]
    recovering.put(6)
    assert recovering.numbers == [0, 1]
    assert recovering.queue.held == 3
    recovering.fill(3, 2)
    assert recovering.numbers == [2, 3, 4, 5, 6]
    assert recovering.queue.counts == Counts(received=7)
    assert (recovering.queue.held, recovering.queue.incomplete) == (0, False)


def test_holes_that_are_known_are_one_question(recovering: Recovering) -> None:
    """On a link that loses every second message each question would take a round trip, one after the other."""
    recovering.put(0, 2, 4, 5)
    assert recovering.asked == [(1, 4, True)]
    recovering.put(7, 9)
    recovering.fill(1, 2, 3)
    assert recovering.asked == [(6, 9, True)]
    assert recovering.numbers == [0, 1, 2, 3, 4, 5]


def test_restart_while_a_hole_is_open_is_not_a_gap_of_billions(recovering: Recovering) -> None:
    """A number that jumps so far is another life of the publisher."""
    recovering.put(0, 2, 2**31)
    assert recovering.asked == [(1, 2, True)]
    recovering.fill(1)
    assert recovering.queue.counts.lost == 0
    assert len(drain(recovering.queue)) == 4


def test_newest_messages_are_missed_by_heartbeat(recovering: Recovering) -> None:
    """Nothing comes after them: the heartbeat tells that they were sent."""
    recovering.put(0)
    recovering.queue.beat(KEY, name_of("a"), 0, begins=True)
    assert not recovering.holes
    recovering.queue.beat(KEY, name_of("a"), 2, begins=True)
    recovering.queue.beat(KEY, name_of("a"), 2, begins=True)
    assert recovering.asked == [(1, 3, True)]
    recovering.fill(1, 2)
    assert recovering.numbers == [0, 1, 2]


def test_publisher_that_is_new_begins_with_its_newest_message(recovering: Recovering) -> None:
    """A reader that joins late has missed nothing of what was sent before; what it cannot have is not lost."""
    recovering.queue.beat(KEY, name_of("a"), 7, begins=False)
    assert not recovering.holes
    recovering.queue.beat(KEY, name_of("a"), 7, begins=True)
    assert recovering.asked == [(7, 8, False)]
    recovering.fill()
    recovering.put(8)
    assert recovering.numbers == [8]
    assert recovering.queue.counts.lost == 0


def test_publisher_that_is_new_after_a_break_is_asked_for_all(recovering: Recovering) -> None:
    """It began while the link was broken: what it keeps no more is not lost, as nobody knows for whom it was."""
    recovering.queue.unsettled_until = float("inf")
    recovering.put(5, 6)
    recovering.put(0, 1, publisher="b")
    assert recovering.asked == [(0, 5, False)]
    recovering.fill(2, 3, 4)
    assert recovering.numbers == [0, 1, 2, 3, 4, 5, 6]
    assert recovering.queue.counts == Counts(received=7)


@given(st.integers(0, 4), st.integers(0, 9), st.integers(0, 9), st.integers(0, 4), st.booleans())
def test_heartbeat_never_doubles_what_comes_by_itself(
    before: int, newest: int, start: int, count: int, unsettled: bool
) -> None:
    """In order and once, whatever is on its way while the newest message is asked for, and nothing is lost.

    Where it overtook the first message of all, what is missing between the two is not asked for, but counted.
    """
    recovering, after = Recovering(), range(start, start + count)
    recovering.put(*range(before))
    recovering.queue.unsettled_until = float("inf") if unsettled else 0.0
    recovering.queue.beat(KEY, name_of("a"), newest, begins=True)
    for number in after:
        recovering.put(number)
    while recovering.holes:
        recovering.fill(*range(recovering.holes[0].start, recovering.holes[0].stop))
    numbers = recovering.numbers
    assert numbers == sorted({*numbers, *range(before), newest})
    assert {number for number in after if number > newest} <= set(numbers)
    lost = 0 if before or unsettled else numbers[-1] - numbers[0] + 1 - len(numbers)
    assert dataclasses.replace(recovering.queue.counts, discarded=0) == Counts(received=len(numbers), lost=lost)


def test_heartbeats_on_another_key_decide_nothing(recovering: Recovering) -> None:
    """A peer may send them on its own key, with any name: the messages of that one tell where it publishes.

    Names that only heartbeats tell of have no place of those that publish.
    """
    recovering.queue.beat(OTHER_KEY, name_of("a"), 900, begins=True)
    recovering.put(0)
    for number in range(11_000):
        recovering.queue.beat(OTHER_KEY, f"{number:x}:1", 5, begins=True)
    recovering.put(1)
    recovering.put(4)
    assert len(recovering.holes) <= 10_002
    assert recovering.asked[-1] == (2, 4, True)
    recovering.fill(2, 3, hole=-1)
    assert recovering.numbers == [0, 1, 2, 3, 4]


def test_publisher_that_is_forgotten_with_a_hole_is_counted(recovering: Recovering) -> None:
    """Memory is bounded: what waited for it is lost, and told."""
    recovering.put(0, 2, 3)
    for number in range(MAX_KEYS):
        recovering.put(0, publisher=str(number), key=OTHER_KEY)
    recovering.put(4)
    recovering.fill(1)
    counts = recovering.queue.counts
    assert counts.lost + sum(sample.vehicle == "1" for sample in drain(recovering.queue)) == 5


def test_nothing_is_held_any_more(recovering: Recovering) -> None:
    """When nobody asks any more, what is missing is lost at once."""
    recovering.put(0, 2)
    recovering.queue.recover(None)
    recovering.fill()
    recovering.put(4)
    recovering.queue.beat(KEY, name_of("a"), 9, begins=True)
    assert not recovering.holes
    assert recovering.numbers == [0, 2, 4]
    assert recovering.queue.counts == Counts(received=3, lost=2)


def test_announced_hole_is_no_loss_yet(recovering: Recovering) -> None:
    """Zenoh announces each gap at once; whether it is a loss is decided here, and once.

    A reader that is too slow for the data is not sent it twice: of what a full channel dropped nothing is asked for.
    """
    recovering.put(0)
    recovering.queue.announce_loss(miss(3))
    assert recovering.queue.counts.lost == 0
    recovering.put(4)
    recovering.fill(1, 2)
    assert recovering.queue.counts.lost == 1
    recovering.queue.announce_loss(miss(3))
    recovering.put(14, overflowed=True)
    assert not recovering.holes
    assert recovering.queue.counts == Counts(lost=1 + 3, dropped=6)


@pytest.mark.parametrize("when", ["before", "after"])
def test_announced_messages_that_a_heartbeat_told_of_are_no_loss(recovering: Recovering, when: str) -> None:
    """They were asked for when Zenoh announces them, with the next message: that is counted neither then nor later."""
    recovering.put(0)
    recovering.queue.beat(KEY, name_of("a"), 3, begins=True)
    if when == "after":
        recovering.fill(1, 2, 3)
    recovering.queue.announce_loss(miss(3))
    recovering.put(4)
    if when == "before":
        recovering.fill(1, 2, 3)
    assert recovering.numbers == [0, 1, 2, 3, 4]
    recovering.queue.recover(None)  # the end of a subscription
    assert recovering.queue.counts == Counts(received=5)


def test_message_that_comes_too_late_is_left_out(recovering: Recovering) -> None:
    """It was given up before, and counted: the order that a reader sees is never broken, and it is counted as well.

    So are messages under the id of another publisher, which push the honest ones out of the sequence.
    """
    recovering.put(0, 3)
    recovering.fill()
    recovering.put(1, 4)
    assert recovering.numbers == [0, 3, 4]
    assert recovering.queue.counts == Counts(received=3, lost=2, discarded=1)


def test_what_is_released_pushes_out_nothing(recovering: Recovering, monkeypatch: pytest.MonkeyPatch) -> None:
    """What waited behind gaps of many false publishers takes the places that are free, and no others."""
    monkeypatch.setattr(module, "CAPACITY", 20)
    recovering.put(*range(15), publisher="honest")
    for number in range(10):
        recovering.put(0, 5, 6, 7, publisher=f"false {number}", key=OTHER_KEY)
    while recovering.holes:
        recovering.fill()
    taken = [sample for sample in drain(recovering.queue) if sample.vehicle == "1"]
    assert [sample.message.timestamp for sample in taken] == list(range(6, 16))


def test_share_of_one_key_in_what_waits_is_bounded(recovering: Recovering) -> None:
    """Whoever leaves gaps on one key has them given up, and not those of others."""
    recovering.put(0, 2, 3, key=OTHER_KEY, publisher="honest")
    for number in range(10):
        recovering.put(0, 5, 6, 7, publisher=f"false {number}")
    given_up = recovering.queue.excess(1000, 12)
    assert {hole.stream for hole in given_up} == {KEY}
    assert len(given_up) == 6
    assert len(recovering.queue.excess(5, 12)) == 9
    assert len(recovering.queue.excess(-1, -1)) == 11
    assert not recovering.queue.excess(1000, 1000)


def test_hole_is_filled_once(recovering: Recovering) -> None:
    """Whoever comes second changes nothing, not even a hole that was found since."""
    recovering.put(0, 2)
    hole = recovering.holes[0]
    recovering.fill(1)
    recovering.put(5)
    recovering.queue.fill(hole, [raw(1, timestamp=2)])
    assert recovering.numbers == [0, 1, 2]
    assert recovering.asked == [(3, 5, True)]


def test_rejected_messages_leave_no_hole(recovering: Recovering) -> None:
    """They came: they are counted as what they are, and not asked for, also behind a hole."""
    recovering.put(0)
    recovering.queue.put([raw(1, payload=Payload(b"junk")), raw(2, timestamp=3), junk(b"junk")])
    assert not recovering.holes
    recovering.queue.put([raw(4, payload=Payload(b"junk")), raw(5, timestamp=6), raw(6, payload=INVALID)])
    recovering.fill(3)
    assert recovering.numbers == [0, 2, 3, 5]
    assert recovering.queue.counts == Counts(received=4, invalid=4)


def test_nobody_holds_up_another(recovering: Recovering) -> None:
    """A hole holds up its own publisher only. A peer may use its name, on another key: then it waits for nothing."""
    recovering.put(0, 5, publisher="b", key=OTHER_KEY)
    recovering.put(0)
    recovering.put(900, key=OTHER_KEY)
    recovering.put(1, 2)
    assert recovering.asked == [(1, 5, True)]
    assert sum(sample.vehicle == "1" for sample in drain(recovering.queue)) == 3


def test_question_waits_for_a_hole(recovering: Recovering) -> None:
    """A publisher that asks whether its message was read is answered when the reader has it.

    Filling a hole tells nothing of a publisher that is unknown: only who empties the channel knows what is left there.
    """
    answered: list[str] = []
    recovering.put(0, 2)
    for publisher, number in (("a", 2), ("b", 7)):
        recovering.queue.ask(Question(name_of(publisher), number, False, partial(answered.append, publisher)))
    assert not answered
    recovering.fill(1)
    assert answered == ["a"]
    recovering.put(3)
    assert answered == ["a", "b"]


@given(st.data(), st.integers(1, 60))
def test_every_message_is_read_once_or_counted(data: st.DataObject, total: int) -> None:
    """Whatever arrives, whatever is found of what does not, whenever: in order, once; the next one tells the rest."""
    recovering = Recovering()
    recovering.put(0)
    kept = data.draw(st.sets(st.integers(1, total)), label="kept")
    arriving = sorted(data.draw(st.sets(st.integers(1, total)), label="arriving"))

    def fill_first() -> None:
        first = recovering.holes[0]
        recovering.fill(*(kept & set(range(first.start, first.stop))))

    for number in arriving:
        recovering.put(number)
        if data.draw(st.booleans()) and recovering.holes:
            fill_first()
        if data.draw(st.booleans()):
            recovering.queue.beat(KEY, name_of("a"), data.draw(st.integers(0, number)), begins=True)
    recovering.queue.beat(KEY, name_of("a"), total, begins=True)
    while recovering.holes:
        fill_first()
        recovering.queue.beat(KEY, name_of("a"), total, begins=True)
    absent = total - len({*arriving} | kept)
    assert recovering.queue.counts.lost == absent
    recovering.put(total + 1)
    samples = drain(recovering.queue)
    numbers = [sample.message.timestamp - 1 for sample in samples]
    assert numbers == sorted({0, *arriving, total + 1} | kept)
    assert [sample.lost for sample in samples] == [0, *(after - before - 1 for before, after in pairwise(numbers))]
    assert recovering.queue.counts == Counts(received=len(numbers), lost=absent)
