"""What a reader of mode `every` answers publishers, and when: without Zenoh, and without a publisher."""

from __future__ import annotations

import math

import pytest

from nedbus.client import questions as module
from nedbus.client.questions import Question, Questions
from nedbus.client.sequence_tracker import SequenceTracker
from nedbus_msgs import decode

from .raw_samples import INVALID, drain, follow, make_queue, miss, name_of, raw


class Asked:
    """The questions that were asked, and the names of those that were answered, in order."""

    def __init__(self) -> None:
        self.answered: list[str] = []

    def question(self, number: int, *, read: bool = False, publisher: str = "a", name: str = "") -> Question:
        return Question(name_of(publisher), number, read, lambda: self.answered.append(name or str(number)))


@pytest.fixture
def asked() -> Asked:
    return Asked()


def settled(questions: Questions, *, arrived: int = 0, taken: int = 0, drained: bool = False) -> list[int]:
    """Return the numbers of the questions that can be answered now."""
    return [each.number for each in questions.settle(arrived=arrived, taken=taken, drained=drained)]


def test_arrived_is_answered_at_arrival(asked: Asked) -> None:
    """Without `read` it is enough that the message is here."""
    tracker = SequenceTracker()
    questions = Questions(tracker)
    follow(tracker, 0, 1, 2)
    questions.add(asked.question(2))
    questions.add(asked.question(3))
    assert settled(questions, arrived=3) == [2]
    assert questions
    follow(tracker, 3)
    assert settled(questions, arrived=4) == [3]
    assert not questions


def test_read_is_answered_when_all_up_to_it_was_taken(asked: Asked) -> None:
    """With `read` the reader must have taken whatever was queued when the message had arrived."""
    tracker = SequenceTracker()
    questions = Questions(tracker)
    follow(tracker, 0, 1)
    questions.add(asked.question(1, read=True))
    assert settled(questions, arrived=5, taken=4) == []
    assert settled(questions, arrived=9, taken=4) == []  # what comes later need not be taken
    assert settled(questions, arrived=9, taken=5) == [1]


def test_read_waits_for_the_message_first(asked: Asked) -> None:
    """A reader that has taken all that it has is asked for something that is still on its way."""
    tracker = SequenceTracker()
    questions = Questions(tracker)
    follow(tracker, 0)
    questions.add(asked.question(1, read=True))
    assert settled(questions, arrived=1, taken=1, drained=True) == []
    follow(tracker, 1)
    assert settled(questions, arrived=2, taken=1) == []
    assert settled(questions, arrived=2, taken=2) == [1]


def test_unknown_publisher_is_answered_once_all_is_queued(asked: Asked) -> None:
    """It sent nothing to this reader, which is certain only when nothing is left in the channel."""
    questions = Questions(SequenceTracker())
    questions.add(asked.question(5))
    assert settled(questions, drained=False) == []
    assert settled(questions, drained=True) == [5]


def test_unknown_publisher_waits_for_what_is_queued(asked: Asked) -> None:
    """Its message may be among what was queued at that moment: with `read` all of that has to be taken."""
    questions = Questions(SequenceTracker())
    questions.add(asked.question(5, read=True))
    assert settled(questions, arrived=3, taken=1, drained=True) == []
    assert settled(questions, arrived=3, taken=3) == [5]


def test_lost_message_is_answered(asked: Asked) -> None:
    """What recovery gave up will never arrive: nobody waits for it."""
    tracker = SequenceTracker()
    questions = Questions(tracker)
    follow(tracker, 0)
    questions.add(asked.question(4))
    assert settled(questions) == []
    tracker.announce(name_of("a"), 4)
    assert settled(questions) == [4]


def test_questions_of_several_publishers_are_answered_apart(asked: Asked) -> None:
    """None waits for another."""
    tracker = SequenceTracker()
    questions = Questions(tracker)
    follow(tracker, 0, publisher="a")
    follow(tracker, 0, 1, 2, publisher="b")
    for publisher, number in [("a", 1), ("b", 2), ("c", 3)]:
        questions.add(asked.question(number, publisher=publisher))
    assert settled(questions) == [2]
    assert settled(questions, drained=True) == [3]
    assert [each.number for each in questions.take_all()] == [1]
    assert not questions


def test_of_too_many_questions_the_oldest_is_forgotten(asked: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    """No peer can make a reader remember more: an honest one asks again."""
    monkeypatch.setattr(module, "MAX_PENDING", 3)
    questions = Questions(SequenceTracker())
    for number in range(5):
        questions.add(asked.question(number))
    assert settled(questions, drained=True) == [2, 3, 4]


def test_queue_answers_when_the_message_is_put(asked: Asked) -> None:
    """A publisher that flushes is told at once, however slow the script is."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0)])
    receive_queue.ask(asked.question(0))
    receive_queue.ask(asked.question(1))
    assert asked.answered == ["0"]
    receive_queue.put([raw(1)])
    assert asked.answered == ["0", "1"]


def test_queue_answers_when_the_script_takes_the_message(asked: Asked) -> None:
    """A lossless publisher goes on with what is read, sample by sample."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0), raw(1)])
    receive_queue.ask(asked.question(1, read=True))
    receive_queue.put([raw(2), raw(3)])
    assert asked.answered == []
    for number in range(4):
        assert receive_queue.pop(decode) is not None
        assert asked.answered == (["1"] if number else [])
    assert receive_queue.pop(decode) is None


def test_queue_answers_when_a_batch_is_taken(asked: Asked) -> None:
    """The same for a reader of batches."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0), raw(1)])
    receive_queue.ask(asked.question(1, read=True))
    assert asked.answered == []
    assert receive_queue.pop_batch() is not None
    assert asked.answered == ["1"]


def test_queue_answers_for_invalid_messages(asked: Asked) -> None:
    """A message that its reader leaves out was taken too."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0, payload=INVALID)])
    receive_queue.ask(asked.question(0, read=True))
    assert drain(receive_queue) == []
    assert asked.answered == ["0"]


def test_queue_answers_unknown_publishers_while_nothing_is_left_to_receive(asked: Asked) -> None:
    """While somebody receives, the publisher's message may be in between: then it is answered after that."""
    receive_queue = make_queue("every")
    receive_queue.ask(asked.question(7, name="while receiving"))
    assert asked.answered == []
    receive_queue.put([raw(0, publisher="b")])
    assert asked.answered == ["while receiving"]
    receive_queue.idle = True
    receive_queue.ask(asked.question(7, name="while idle"))
    assert asked.answered == ["while receiving", "while idle"]


def test_unknown_publisher_is_not_answered_while_its_messages_may_still_come(asked: Asked) -> None:
    """After a break of the link a publisher that is not known has sent something that heartbeats bring soon."""
    receive_queue = make_queue("every")
    receive_queue.idle = True
    receive_queue.unsettled_until = math.inf
    receive_queue.ask(asked.question(1))
    receive_queue.put([raw(0, publisher="b")])
    assert asked.answered == []
    receive_queue.put([raw(0), raw(1)])
    assert asked.answered == ["1"]
    receive_queue.ask(asked.question(7, publisher="c"))
    receive_queue.unsettled_until = 0.0
    receive_queue.put([raw(1, publisher="b")])
    assert asked.answered == ["1", "7"]


def test_announced_loss_at_the_end_of_a_stream_is_answered(asked: Asked) -> None:
    """Recovery gave up the last messages, and nothing follows: the next question at the latest is answered."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0)])
    receive_queue.ask(asked.question(3))
    receive_queue.announce_loss(miss(3))
    receive_queue.ask(asked.question(3, name="again"))
    assert asked.answered == ["3", "again"]


def test_end_of_the_queue_answers_all(asked: Asked) -> None:
    """Nobody reads any more, and no publisher waits for it: not with what it asked, nor with what it asks now."""
    receive_queue = make_queue("every")
    receive_queue.put([raw(0)])
    receive_queue.ask(asked.question(0, read=True, name="read"))
    receive_queue.ask(asked.question(9, name="arrived"))
    receive_queue.ask(asked.question(0, publisher="b", name="unknown"))
    assert asked.answered == []
    receive_queue.end()
    assert asked.answered == ["read", "arrived", "unknown"]
    receive_queue.ask(asked.question(9, name="after"))
    assert asked.answered[3:] == ["after"]
