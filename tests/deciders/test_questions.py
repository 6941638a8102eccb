"""What a reader of mode `every` answers publishers, and when: without Zenoh, and without a publisher."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import pytest

from nedbus.client import questions as module
from nedbus.client.questions import Question, Questions
from nedbus.client.receive_queue import ReceiveQueue
from nedbus.client.sequence_tracker import SequenceTracker
from nedbus.transport import RawSample
from nedbus_msgs import decode

from .raw_samples import INVALID, Payload, follow, make_queue, miss, name_of, raw


@dataclass
class Asked:
    """A queue that is asked, and the names of the questions that were answered, in order."""

    queue: ReceiveQueue = field(default_factory=lambda: make_queue("every"))
    answered: list[str] = field(default_factory=list)

    def ask(self, number: int, *, read: bool = False, publisher: str = "a", name: str = "") -> list[str]:
        """Ask the queue, and return what is answered so far."""
        self.queue.ask(self.question(number, read=read, publisher=publisher, name=name))
        return self.answered

    def put(self, *samples: RawSample) -> list[str]:
        """Put samples into the queue, and return what is answered so far."""
        self.queue.put(samples)
        return self.answered

    def question(self, number: int, *, read: bool = False, publisher: str = "a", name: str = "") -> Question:
        return Question(name_of(publisher), number, read, lambda: self.answered.append(name or str(number)))


@pytest.fixture
def asked() -> Asked:
    return Asked()


def settled(questions: Questions, *, arrived: int = 0, taken: int = 0, drained: bool = False) -> list[int]:
    """Return the numbers of the questions that can be answered now."""
    return [each.number for each in questions.settle(arrived=arrived, taken=taken, drained=drained)]


def test_read_is_answered_when_all_up_to_it_was_taken(asked: Asked) -> None:
    """With `read` the reader must have taken whatever was queued when the message had arrived."""
    tracker = SequenceTracker()
    questions = Questions(tracker)
    follow(tracker, 0)
    questions.add(asked.question(1, read=True))
    assert settled(questions, arrived=1, taken=1, drained=True) == []  # it is still on its way
    follow(tracker, 1)
    assert settled(questions, arrived=5, taken=4) == []
    assert settled(questions, arrived=9, taken=4) == []  # what comes later need not be taken
    assert settled(questions, arrived=9, taken=5) == [1]


def test_unknown_publisher_is_answered_once_all_is_queued(asked: Asked) -> None:
    """It sent nothing to this reader, which is certain only when nothing is left in the channel.

    Its message may be among what was queued at that moment: with `read` all of that has to be taken.
    """
    questions = Questions(SequenceTracker())
    questions.add(asked.question(5))
    questions.add(asked.question(6, read=True))
    assert settled(questions, drained=False) == []
    assert settled(questions, arrived=3, taken=1, drained=True) == [5]
    assert settled(questions, arrived=3, taken=3) == [6]


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
    asked.put(raw(0))
    assert asked.ask(0) == ["0"]
    assert asked.ask(1) == ["0"]
    assert asked.put(raw(1)) == ["0", "1"]


@pytest.mark.parametrize("payload", [None, INVALID], ids=["valid", "invalid"])
def test_queue_answers_when_the_script_takes_the_message(asked: Asked, payload: Payload | None) -> None:
    """A lossless publisher goes on with what is read, sample by sample, be it left out as invalid, or in batches."""
    asked.put(raw(0), raw(1, payload=payload))
    asked.ask(1, read=True)
    asked.put(raw(2), raw(3))
    asked.ask(3, read=True)
    for answered in ([], ["1"]):
        assert asked.queue.pop(decode) is not None
        assert asked.answered == answered
    assert asked.queue.pop_batch() is not None
    assert asked.answered == ["1", "3"]


def test_queue_answers_unknown_publishers_while_nothing_is_left_to_receive(asked: Asked) -> None:
    """While somebody receives, the publisher's message may be in between: then it is answered after that."""
    assert asked.ask(7, name="while receiving") == []
    assert asked.put(raw(0, publisher="b")) == ["while receiving"]
    asked.queue.idle = True
    assert asked.ask(7, name="while idle") == ["while receiving", "while idle"]


def test_unknown_publisher_is_not_answered_while_its_messages_may_still_come(asked: Asked) -> None:
    """After a break of the link a publisher that is not known has sent something that heartbeats bring soon."""
    asked.queue.idle = True
    asked.queue.unsettled_until = math.inf
    asked.ask(1)
    assert asked.put(raw(0, publisher="b")) == []
    assert asked.put(raw(0), raw(1)) == ["1"]
    asked.ask(7, publisher="c")
    asked.queue.unsettled_until = 0.0
    assert asked.put(raw(1, publisher="b")) == ["1", "7"]


def test_announced_loss_at_the_end_of_a_stream_is_answered(asked: Asked) -> None:
    """Recovery gave up the last messages, and nothing follows: the next question at the latest is answered."""
    asked.put(raw(0))
    asked.ask(3)
    asked.queue.announce_loss(miss(3))
    assert asked.ask(3, name="again") == ["3", "again"]


def test_end_of_the_queue_answers_all(asked: Asked) -> None:
    """Nobody reads any more, and no publisher waits for it: not with what it asked, nor with what it asks now."""
    asked.put(raw(0))
    asked.ask(0, read=True, name="read")
    asked.ask(9, name="arrived")
    assert asked.ask(0, publisher="b", name="unknown") == []
    asked.queue.end()
    assert asked.answered == ["read", "arrived", "unknown"]
    assert asked.ask(9, name="after")[3:] == ["after"]
