"""The questions for one hole, and what was answered so far. No I/O but to take what arrived."""

from __future__ import annotations

from dataclasses import dataclass, field

from nedbus.transport import MAX_ANSWERS, KeptAnswers, RawSample
from nedbus_msgs import PAYLOAD_LIMIT

from .publisher_sequence import Hole


@dataclass(slots=True, eq=False)
class Search:
    """The questions for one hole, for `patience` seconds from the first on; times in monotonic seconds."""

    hole: Hole
    patience: float
    until: float | None = None
    due: float = 0.0
    tries: int = 0
    answers: KeptAnswers | None = None
    found: dict[int, RawSample] = field(default_factory=dict)
    ended: bool = False

    @property
    def complete(self) -> bool:
        """Whether its publisher has answered: one that sends the last message has all that it still keeps."""
        return self.hole.stop - 1 in self.found or len(self.found) >= MAX_ANSWERS

    @property
    def numbers(self) -> range:
        """What to ask for: without what the last question brought before it ended."""
        first = next(number for number in range(self.hole.start, self.hole.stop + 1) if number not in self.found)
        return range(first, self.hole.stop)

    def take(self) -> bool:
        """Keep what was answered since the last call, and return whether the question has ended."""
        if self.answers is None:
            return True
        for number, sample in self.answers.take().items():
            if len(self.found) < MAX_ANSWERS and len(sample.payload) <= PAYLOAD_LIMIT and not self.ended:
                self.found[number] = sample
        return self.answers.ended
