"""Which messages of a publisher's sequence are absent: the one place where losses are counted. Pure, without I/O."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from itertools import islice
from typing import Final

from nedbus.transport import SourceInfo, entity_name

from .publisher_sequence import LARGEST_GAP, Hole, PublisherSequence, StreamRun

_NUMBERS: Final = 2**32  # Zenoh's sequence numbers wrap here
_REORDERED: Final = 2**16  # a number that is so much too low is late or a duplicate; more is a restart
_NEVER: Final = -1
_LOOKED_AT: Final = 100
_MAX_PUBLISHERS: Final = 10_000
SETTLED: Final = 1000
"""Messages of one publisher in a row after which a stream is followed by number alone."""

HELD: Final = -1
"""In place of a count of losses: the message comes after a hole, `SequenceTracker.hole`, and has to wait for it."""

LATE: Final = -2
"""In place of a count of losses: the message was here already, or was given up."""


class SequenceTracker:
    """Follow the sequence numbers of all publishers that a reader hears, and count what is absent.

    There are two sources of knowledge: gaps in the numbers that arrive, and announcements of Zenoh's miss listener,
    which come before the gap, or without one at the end of a stream. Each message is counted once.

    While `queue_drops` is set, a queue before this tracker has perhaps dropped what its reader was too slow for: then
    only announced losses are lost in transit, and the rest of a gap was dropped.

    While `recovering` is set, what is missing is not lost yet: with `asks`, each gap becomes a Hole in `dug`, and what
    comes after it is held until somebody fills it. Announcements then only tell how much of a gap was lost in transit,
    and without `counts_announced` those that no gap followed are never lost: what filled a hole settled them.
    `unsettled`: a publisher that is heard for the first time has perhaps sent something before, for this reader; with
    `thinned` only one that sends thinned, as a reader turns to a whole stream at any time.

    Memory is bounded: the least recently heard of more than `max_publishers` is forgotten, with what was announced for
    it counted as lost.
    Not thread-safe.
    """

    def __init__(self, *, queue_drops: bool = False, max_publishers: int = _MAX_PUBLISHERS) -> None:
        self.dropped = 0
        self.queue_drops = queue_drops
        self.recovering = self.asks = self.unsettled = False
        self.counts_announced = True
        self.thinned = False
        self.hole: Hole | None = None
        self.dug: list[Hole] = []
        self._max = max_publishers
        self._lost = 0
        self._announced = 0  # the sum of what is announced and not yet seen as a gap
        self._publishers: OrderedDict[str, PublisherSequence] = OrderedDict()  # the most recently heard last
        self._streams: dict[str, StreamRun] = {}  # by key

    @property
    def lost(self) -> int:
        """Messages that were lost in transit, all publishers together."""
        return self._lost + self._announced if self.counts_announced else self._lost

    def announce(self, publisher: str, count: int) -> None:
        """Note that messages of a publisher are lost; the gap in its sequence may follow."""
        sequence = self._publishers.get(publisher)
        if sequence is None:
            self._lost += 0 if self.recovering else count
        else:
            sequence.announced += count
            self._announced += count

    def arrived(self, stream: str, info: SourceInfo) -> int:
        """Note a message of a stream; return how many of its publisher were lost just before it, or HELD, or LATE.

        The publisher's name costs more than all the rest: a stream of which 1,000 messages in a row came from one
        publisher is followed without it, for as long as each number is the expected one.
        """
        number = info.source_sn
        known = self._streams.get(stream)
        if known is None or known.run < SETTLED or number != known.sequence.expected:
            return self._identify(stream, number, entity_name(info.source_id))
        sequence = known.sequence
        sequence.expected = (number + 1) % _NUMBERS
        if sequence.publisher in self._publishers:
            self._publishers.move_to_end(sequence.publisher)
        return 0

    def arrived_in_order(self, stream: str, numbers: Sequence[int]) -> bool:
        """Note many messages of a stream if nothing is absent among them; return False if each has to be looked at."""
        known = self._streams.get(stream)
        if known is None or known.run < SETTLED or known.sequence.publisher not in self._publishers:
            return False
        first = known.sequence.expected
        if first + len(numbers) >= _NUMBERS or numbers != list(range(first, first + len(numbers))):
            return False
        known.sequence.expected = first + len(numbers)
        self._publishers.move_to_end(known.sequence.publisher)
        return True

    def has(self, publisher: str, number: int) -> bool | None:
        """Return whether this message arrived or is known to be lost; None if the publisher is not known."""
        sequence = self._publishers.get(publisher)
        if sequence is None:
            return None
        announced = 0 if self.recovering else sequence.announced
        return (sequence.expected + announced - 1 - number) % _NUMBERS <= LARGEST_GAP

    def beat(self, stream: str, publisher: str, number: int, *, begins: bool) -> None:
        """Note that a publisher has sent a message, `number`, that should have arrived by now.

        `begins`: of a publisher that is new here this one is missing.
        """
        sequence = self._publishers.get(publisher)
        if sequence is None:
            began = self._may_have_begun(stream)
            if len(self._publishers) >= self._max or not (began or begins):
                return  # nobody is forgotten for who has sent nothing
            first = 0 if began else number
            sequence = self._remember(publisher, stream, first)
            sequence.heard = False
            sequence.hole = Hole(stream, publisher, first, number + 1, exact=False)
            self.dug.append(sequence.hole)
        elif (number - sequence.expected) % _NUMBERS <= LARGEST_GAP:
            self._dig(sequence, stream, number + 1)

    def fill(self, hole: Hole, first: int) -> bool:
        """Hold no more for a hole of which, from number `first` on, something is here; its stop if nothing is.

        Returns False if its publisher was forgotten meanwhile.
        """
        sequence = self._publishers.get(hole.publisher)
        if sequence is None or sequence.hole is not hole:
            return False
        sequence.hole = None
        if not hole.exact and sequence.expected == hole.start:  # else some came by themselves
            sequence.expected = first
        return True

    def lose(self, count: int) -> None:
        """Count messages of a publisher that was forgotten."""
        self._lost += count

    def skip(self, hole: Hole) -> int:
        """Give up what is still missing before the stop of a hole; return how many messages are lost by that."""
        sequence = self._publishers.get(hole.publisher)
        step = 0 if sequence is None else (hole.stop - sequence.expected) % _NUMBERS
        if sequence is None or step > LARGEST_GAP:
            return 0
        sequence.expected = hole.stop % _NUMBERS
        return self._close_gap(sequence, step)

    def _identify(self, stream: str, number: int, publisher: str) -> int:
        sequence = self._publishers.get(publisher)
        if sequence is not None and not sequence.heard:
            if sequence.stream != stream:  # whoever sent those heartbeats was not this publisher
                sequence = None
            else:
                sequence.heard = True
        if sequence is None:
            late = self.asks and self._may_have_begun(stream)
            sequence = self._remember(publisher, stream, 0 if late else number)
            if late and number:
                sequence.hole = Hole(stream, publisher, 0, number, exact=False)
                self.dug.append(sequence.hole)
        elif sequence.stream != stream:
            sequence.stream = None
        self._publishers.move_to_end(publisher)
        known = self._streams.get(stream)
        if known is None:
            known = self._streams[stream] = StreamRun(sequence)
            if len(self._streams) > self._max:
                del self._streams[next(iter(self._streams))]
        step = (number - sequence.expected) % _NUMBERS
        expected = known.sequence is sequence and step == 0
        known.sequence, known.run = sequence, known.run + 1 if expected else 0
        if step and self._dig(sequence, stream, number):
            return HELD
        if step <= LARGEST_GAP:
            sequence.expected = (number + 1) % _NUMBERS
            return self._close_gap(sequence, step)
        if _NUMBERS - step > _REORDERED:
            sequence.expected = (number + 1) % _NUMBERS
            return 0
        return LATE if self.recovering and sequence.stream == stream else 0

    def _may_have_begun(self, stream: str) -> bool:
        return self.unsettled and (not self.thinned or "/@" in stream)

    def _remember(self, publisher: str, stream: str, expected: int) -> PublisherSequence:
        sequence = self._publishers[publisher] = PublisherSequence(publisher, stream, expected)
        if len(self._publishers) > self._max:
            self._forget_oldest(publisher)
        return sequence

    def _dig(self, sequence: PublisherSequence, stream: str, stop: int) -> bool:
        """Return whether what is from number `stop` on has to wait for a hole before it."""
        if sequence.stream != stream:
            return False
        if sequence.hole is None:
            # Across the wrap no question can ask.
            if not self.asks or not 0 < stop - sequence.expected <= LARGEST_GAP:
                return False
            self._close_announced(sequence, stop - sequence.expected)
            sequence.hole = Hole(stream, sequence.publisher, sequence.expected, stop, exact=True)
            self.dug.append(sequence.hole)
        self.hole = sequence.hole
        return True

    def _close_gap(self, sequence: PublisherSequence, gap: int) -> int:
        announced = self._close_announced(sequence, gap)
        lost = announced if self.queue_drops else gap
        self._lost += lost
        self.dropped += gap - lost
        return lost

    def _close_announced(self, sequence: PublisherSequence, gap: int) -> int:
        announced = min(gap, sequence.announced)
        sequence.announced -= announced
        self._announced -= announced
        return announced

    def _forget_oldest(self, newest: str) -> None:
        # One that something waits for is forgotten only where there are many of them.
        names = islice(self._publishers, _LOOKED_AT)
        free = (each for each in names if self._publishers[each].hole is None and each != newest)
        name = next(free, next(iter(self._publishers)))
        oldest = self._publishers.pop(name)
        oldest.expected = _NEVER  # a settled stream goes on with it, else
        self._lost += 0 if self.recovering else oldest.announced
        self._announced -= oldest.announced
