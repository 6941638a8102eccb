"""The sequence of one publisher, and what is missing in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

LARGEST_GAP: Final = 2**30
"""A step of more messages is not a gap: the publisher started again."""


@dataclass(slots=True, eq=False)
class Hole:
    """Messages `start` to `stop` - 1 of a publisher, which may still be got from it.

    `exact`: all of them were sent for this reader. Of another hole what its publisher does not keep is not lost.
    """

    stream: str
    publisher: str
    start: int
    stop: int
    exact: bool


@dataclass(slots=True, eq=False)
class PublisherSequence:
    """The sequence of one publisher; `heard`: by a message, and not by heartbeats only.

    `expected` is the number that comes next. `announced` are losses that were announced before their gap.
    `stream` is the key on which it is heard, None if these are several: then nothing is asked for, so that nobody who
    publishes under another's name holds up what that one sends.
    """

    publisher: str
    stream: str | None
    expected: int
    announced: int = 0
    hole: Hole | None = None
    heard: bool = True


@dataclass(slots=True, eq=False)
class StreamRun:
    """One key: the publisher of its last message, and how many in a row came from it."""

    sequence: PublisherSequence
    run: int = 0
