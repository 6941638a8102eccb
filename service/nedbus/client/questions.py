"""What publishers ask a reader of mode `every`: whether it has, or has read, what they sent. Pure, without I/O.

The query is `<key>/@ack?publisher=<id>;number=<sequence number>;read=<0 or 1>`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from .sequence_tracker import SequenceTracker

MAX_PENDING: Final = 1000
"""Questions that wait for an answer; an honest publisher has one for each key at a time."""

CLOSED: Final = b"closed"
"""The answer of a reader that is closed; that of any other is empty."""

_MAX_DIGITS: Final = 10  # of a sequence number


@dataclass(slots=True, eq=False)
class Question:
    """A publisher's question whether its message `number` has arrived or, with `read`, was taken by the script.

    `reply` answers it, and is called once. `until` is how many samples must have been read: it is known once the
    message has arrived.
    """

    publisher: str
    number: int
    read: bool
    reply: Callable[[], object]
    until: int | None = None


def write_parameters(publisher: str, number: int, *, read: bool) -> str:
    """Return the parameters of the query that asks a question."""
    return f"publisher={publisher};number={number};read={read:d}"


def read_parameters(get: Callable[[str], str | None]) -> tuple[str, int, bool] | None:
    """Return publisher, number and `read` of a query; `get` returns its parameters by name. None for others."""
    publisher, number = get("publisher"), get("number") or ""
    if publisher is None or not number.isdecimal() or len(number) > _MAX_DIGITS:
        return None
    return publisher, int(number), get("read") == "1"


class Questions:
    """Keep questions until they can be answered. Not thread-safe."""

    def __init__(self, tracker: SequenceTracker) -> None:
        self._tracker = tracker
        self._pending: deque[Question] = deque()

    def __bool__(self) -> bool:
        return bool(self._pending)

    def add(self, question: Question) -> None:
        """Keep a question; of too many the oldest is not answered."""
        if len(self._pending) >= MAX_PENDING:
            self._pending.popleft()
        self._pending.append(question)

    def settle(self, *, arrived: int, taken: int, drained: bool) -> list[Question]:
        """Return the questions that can be answered now, and forget them.

        `arrived` and `taken` count the samples that were queued and read so far. `drained`: all that came before the
        questions is queued by now, so that a publisher that is unknown has sent nothing to this reader.
        """
        ready: list[Question] = []
        for question in list(self._pending):
            if question.until is None:
                has = self._tracker.has(question.publisher, question.number)
                if has or (has is None and drained):
                    question.until = arrived if question.read else 0
            if question.until is not None and taken >= question.until:
                ready.append(question)
        if ready:
            self._pending = deque(each for each in self._pending if each not in ready)
        return ready

    def take_all(self) -> list[Question]:
        """Return all questions, and forget them."""
        pending, self._pending = list(self._pending), deque()
        return pending
