"""Losses between numbered packets; no I/O, callers pass monotonic time [s]."""

from dataclasses import dataclass, field
from typing import Final

_MODULUS: Final = 256  # of MAVLink's sequence
# times the usual rate; a faster jump of the sequence is a restart of the sender's counter
_FACTOR: Final = 4.0
_MARGIN: Final = 20  # packets that may be lost at once, whatever the rate
_OVERTAKEN: Final = 8  # packets that one packet of the same link may overtake
_SILENCE: Final = 3.0  # s after which the sequence has no relation to the earlier one
_WINDOW: Final = 10.0  # s over which the rate is measured

REPEATED: Final = -1
"""In place of the number of a link: this packet came before."""


class PacketRate:
    """Mean rate at which a sender's packets arrive, over the last 5 to 10 s."""

    def __init__(self) -> None:
        self._count = 0.0
        self._first = 0.0
        self._last = 0.0

    def add(self, now: float) -> None:
        """Add a packet; lost ones would let wrong losses explain further ones."""
        if not self._count:
            self._first = now
        self._count += 1
        self._last = now
        if now - self._first > _WINDOW:
            self._count /= 2
            self._first = (self._first + now) / 2

    def expected(self, now: float) -> float:
        """Return the number of packets that usually arrive in the time since the last one."""
        seconds = self._last - self._first
        if seconds <= 0:
            return 0.0
        return self._count / seconds * max(0.0, now - self._last)

    def explains(self, lost: int, now: float, *, margin: int = _MARGIN) -> bool:
        """Return whether this number of packets can be lost since the last one; if not, the sender restarted.

        Before the first packet nothing is known, as in a stream that continues that of an earlier process.
        """
        return not self._count or lost <= margin + _FACTOR * self.expected(now)


@dataclass(slots=True)
class _Link:
    """The packets that one sender numbered for one link; `last`: the number of the last one, which came at `time`.

    A second link may be the main one, some of whose packets were overtaken: `first` is then the number of its first
    packet, and `skipped` has the numbers that it skipped since.
    """

    number: int
    last: int
    time: float
    first: int | None = None
    skipped: set[int] = field(default_factory=set)

    def step_to(self, sequence: int) -> int:
        """Return the number of packets from the last one to one with this sequence number."""
        return (sequence - self.last) % _MODULUS

    def go_on(self, sequence: int, now: float) -> None:
        """Note the last packet."""
        self.last = sequence
        self.time = now


@dataclass(slots=True)
class _Gap:
    """The last gap of the main link. `before`: that link as it was, because it may go on.

    `end`: the packet behind the gap; None if the sender restarted, and no packets were counted as lost.
    """

    before: _Link
    end: int | None = None
    is_late: bool = False  # the last packet was in the gap


class SequenceCounter:
    """Count the MAVLink messages of one sender that were lost, and tell its links apart.

    Two modems number their packets on their own, and those of a slower link arrive late. A packet that follows no
    other one is of a second link if the main one goes on, and else the first one of a sender that restarted. Losses
    are those of the main link. Packets of one link that overtake others have numbers that no other packet had: a second
    link a few packets ahead has a number of its own once the main one sends a sequence number of it again.

    `link`: number of the link of the last packet, from 0; `REPEATED` if the packet came before.
    """

    def __init__(self) -> None:
        self.link = 0
        self._links = 0  # number of links so far
        self._main: _Link | None = None
        self._second: _Link | None = None
        self._gap: _Gap | None = None
        self._early: set[int] = set()  # packets of a gap that overtook others of it
        self._is_numbered = False  # two packets of the main link followed each other
        self._missing: set[int] = set()  # sequence numbers that the main link skipped
        self._rate = PacketRate()

    def add(self, sequence: int, now: float) -> int:
        """Return the number of messages lost before this one.

        A number below 0 corrects an earlier count: that many messages arrived after all.
        """
        main = self._main_at(now)
        if main is None:
            self._rate = PacketRate()
            self._main = main = self._new_link((sequence - 1) % _MODULUS, now)
            self._is_numbered = False
            self.link = main.number
            return self._go_on(main, sequence, now)
        self.link = main.number
        step = main.step_to(sequence)
        if step == 1:
            self._is_numbered = True
            self._tell_apart(main, sequence)
            return self._go_on(main, sequence, now)
        second = self._second
        if second is not None and second.step_to(sequence) == 1:
            return self._add_to_second(main, second, sequence, now)
        gap = self._gap
        if gap is not None and gap.before.step_to(sequence) == 1:
            return self._add_to_earlier(main, gap, sequence, now)
        if step == 0:
            return self._add_late(sequence)
        return self._add_after_gap(main, sequence, now)

    def _main_at(self, now: float) -> _Link | None:
        """Return the main link; the second one replaces it after a silence."""
        main = self._main
        if main is None or now - main.time <= _SILENCE:
            return main
        second = self._second
        self._main = None
        self._second = None
        self._gap = None
        if second is not None and now - second.time <= _SILENCE:
            second.first = None
            self._main = second
        return self._main

    def _new_number(self) -> int:
        self._links += 1
        return self._links - 1

    def _new_link(self, sequence: int, now: float) -> _Link:
        return _Link(self._new_number(), sequence, now)

    def _tell_apart(self, main: _Link, sequence: int) -> None:
        """Give the second link a number of its own if the main one, with this packet, sends a number of it again."""
        second = self._second
        if second is None or second.first is None:
            return
        if main.step_to(second.first) <= main.step_to(sequence):
            second.first = None
            second.number = self._new_number()

    def _go_on(self, main: _Link, sequence: int, now: float) -> int:
        lost = 0
        if main.step_to(sequence) > 1:
            skipped = _between(main.last, sequence) - self._early
            self._missing |= skipped
            lost = len(skipped)
        self._missing.discard(sequence)
        main.go_on(sequence, now)
        self._rate.add(now)
        return lost

    def _add_late(self, sequence: int) -> int:
        """Add a packet that others have overtaken, or that came before."""
        if sequence in self._missing:
            self._missing.discard(sequence)
            return -1
        if self._is_numbered:
            self.link = REPEATED
        return 0

    def _add_to_second(self, main: _Link, second: _Link, sequence: int, now: float) -> int:
        """Add a packet of the second link, which replaces the main one once it shows that they are one."""
        self.link = second.number
        skipped = _between(second.last, sequence)
        second.go_on(sequence, now)
        if second.first is None:
            return 0
        second.skipped |= skipped
        overtaken = self._missing & _between(main.last, second.first)
        ahead = (sequence - second.first) % _MODULUS
        is_main_silent = ahead > _MODULUS // 2  # the rest of the overtaken packets was lost
        if overtaken and not is_main_silent:
            return 0
        lost = overtaken | second.skipped
        self._missing |= lost
        second.first = None
        self._main = second
        self._second = None
        self._rate.add(now)
        return len(lost)

    def _add_to_earlier(self, main: _Link, gap: _Gap, sequence: int, now: float) -> int:
        """Add a packet that follows the main link from before the last gap.

        One packet may have been overtaken. If the next one follows too, there was no gap: the link went on, and the
        packets behind the gap have overtaken several, or are those of another link.
        """
        earlier = gap.before
        self.link = earlier.number
        earlier.go_on(sequence, now)
        if gap.end is not None and not gap.is_late:
            gap.is_late = True
            return self._add_late(sequence)
        self._main = earlier
        self._second = main
        self._gap = None
        if gap.end is None:  # another link, which counted no losses
            return 0
        inside = _between(sequence, gap.end)
        self._early = inside - self._missing
        main.first = gap.end
        main.skipped = set()
        not_lost = inside & self._missing
        if sequence in self._missing:
            self._missing.discard(sequence)
            not_lost.add(sequence)
        return -len(not_lost)

    def _add_after_gap(self, main: _Link, sequence: int, now: float) -> int:
        """Add a packet that follows none: after a loss, late, the first one of another link, or after a restart."""
        ahead = main.step_to(sequence)
        behind = _MODULUS - ahead
        second = self._second
        if second is not None:
            if second.first is not None and sequence in second.skipped:
                second.skipped.discard(sequence)
                self.link = second.number
                return 0
            ahead_of_second = second.step_to(sequence)
            nearest = min(ahead_of_second, _MODULUS - ahead_of_second)
            if nearest <= _MARGIN and nearest < min(ahead, behind):
                if nearest == ahead_of_second and nearest:
                    return self._add_to_second(main, second, sequence, now)
                self.link = second.number
                return 0
        if self._is_loss(ahead, now):
            if second is None:
                self._gap = _Gap(_Link(main.number, main.last, main.time), sequence)
                self._early = set()
            self._tell_apart(main, sequence)
            return self._go_on(main, sequence, now)
        is_missing = behind <= _MARGIN and sequence in self._missing
        if is_missing or behind <= _OVERTAKEN:
            return self._add_late(sequence)
        self._gap = _Gap(main)
        self._is_numbered = False
        self._main = self._new_link(sequence, now)
        self.link = self._main.number
        self._rate.add(now)
        return 0

    def _is_loss(self, ahead: int, now: float) -> bool:
        """Return whether the packets between the last one and one so far ahead can be lost."""
        margin = _MARGIN if self._is_numbered else _OVERTAKEN
        return ahead <= _MODULUS // 2 and self._rate.explains(ahead - 1, now, margin=margin)


def _between(first: int, last: int) -> set[int]:
    """Return the sequence numbers between two."""
    return {(first + step) % _MODULUS for step in range(1, (last - first) % _MODULUS)}
