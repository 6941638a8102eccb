"""Follow what arrives: what was lost before each message, and what has to wait for those before it. No I/O."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable
from operator import itemgetter
from typing import TYPE_CHECKING, Final

from nedbus.transport import entity_name

from .decoder import MAX_KEYS, Arrival, Decoder
from .publisher_sequence import LARGEST_GAP, Hole
from .sequence_tracker import HELD, LATE, SequenceTracker

if TYPE_CHECKING:
    from zenoh.ext import Miss

_PAYLOAD: Final = itemgetter(1)
_MANY: Final = 8  # samples of one key for which a look at all of them together pays


class Follower:
    """Note in arrivals what was lost before them, and hold those that come after a hole until it is filled.

    `unreported` are losses before a sample that was invalid or dropped, by the key of the stream. `held` counts the
    arrivals that wait, `discarded` those that came twice or too late. Not thread-safe, but for `announce`.
    """

    def __init__(self, decoder: Decoder) -> None:
        self.tracker = SequenceTracker()
        self.held = self.discarded = 0
        self.unreported: dict[str, int] = {}
        self._keep = decoder.keep
        self._announcements: deque[Miss] = deque()
        self._waiting: dict[Hole, list[Arrival]] = {}
        self._given_up: dict[str, int] = {}  # what was lost before the next message on a key
        self._on_hole: Callable[[Hole], object] | None = None

    @property
    def incomplete(self) -> bool:
        """Whether there are holes."""
        return bool(self._waiting)

    def excess(self, total: int, of_key: int) -> list[Hole]:
        """Return the holes to give up so that no more than `total` arrivals wait, and `of_key` of one key.

        Those for which most arrivals wait come first.
        """
        held, by_key, found = self.held, Counter[str](), list[Hole]()
        if held <= min(total, of_key):
            return found
        for hole, waiting in self._waiting.items():
            by_key[hole.stream] += len(waiting)
        for hole in sorted(self._waiting, key=lambda hole: -len(self._waiting[hole])):
            if held > total or by_key[hole.stream] > of_key:
                found.append(hole)
                held -= len(self._waiting[hole])
                by_key[hole.stream] -= len(self._waiting[hole])
        return found

    def recover(self, on_hole: Callable[[Hole], object] | None) -> None:
        """Call `on_hole` with each hole from now on; it must not wait, and `fill` must follow. None: dig no more."""
        self._on_hole = on_hole
        self.tracker.recovering = on_hole is not None
        self.tracker.counts_announced &= on_hole is None

    def announce(self, miss: Miss) -> None:
        """Note that messages are missing, or lost if nobody recovers them; from any thread."""
        self._announcements.append(miss)

    def apply_announcements(self) -> None:
        """Count what was announced."""
        while self._announcements:
            miss = self._announcements.popleft()
            self.tracker.announce(entity_name(miss.source), miss.nb)

    def follow(self, arrivals: list[Arrival], *, overflowed: bool, unsettled: bool) -> None:
        """Note losses, and take out what has to wait or was rejected.

        `overflowed`: they come from a channel that was full, and perhaps dropped something: nothing is asked for.
        `unsettled`: a publisher that is new may have sent something before.
        """
        self.apply_announcements()
        tracker = self.tracker
        tracker.queue_drops, tracker.unsettled = overflowed, unsettled
        tracker.asks = tracker.recovering and not overflowed
        self._note(arrivals)

    def beat(self, stream: str, publisher: str, number: int, *, begins: bool, unsettled: bool) -> None:
        """Note that a publisher has sent a message that should have arrived by now.

        `begins`: of a publisher that is new here this one is asked for.
        """
        self.tracker.unsettled, self.tracker.asks = unsettled, self.tracker.recovering
        if not self.tracker.asks or len(self._waiting) >= MAX_KEYS:
            return
        self.tracker.beat(stream, publisher, number, begins=begins)
        self._announce_holes()

    def fill(self, hole: Hole, found: Iterable[Arrival]) -> list[Arrival]:
        """Return what was found of a hole, and what waited for it, in order; what is still missing is lost."""
        waiting = self._waiting.pop(hole, None)
        if waiting is None:
            return []  # filled already
        self.held -= len(waiting)
        here, later = {_number(arrival): arrival for arrival in found}, list[Arrival]()
        for arrival in waiting:  # some may have been on their way
            if (hole.start if hole.exact else 0) <= _number(arrival) < hole.stop:
                here[_number(arrival)] = arrival
            else:
                later.append(arrival)
        tracker, arrivals = self.tracker, [here[number] for number in sorted(here)]
        tracker.queue_drops = tracker.asks = False
        if not tracker.fill(hole, min(here, default=hole.stop)):
            tracker.lose(len({_number(arrival) for arrival in later}) + (hole.stop - hole.start if hole.exact else 0))
            return []
        self._note(arrivals)
        lost = tracker.skip(hole)
        if lost and len(self._given_up) < MAX_KEYS:
            self._given_up[hole.stream] = self._given_up.get(hole.stream, 0) + lost
        tracker.asks = tracker.recovering
        self._note(later)
        return arrivals + later

    def report_later(self, key: str, lost: int) -> None:
        """Report losses with the next sample of this key that is read."""
        if lost and len(self.unreported) < MAX_KEYS:
            self.unreported[key] = self.unreported.get(key, 0) + lost

    def _note(self, arrivals: list[Arrival]) -> None:
        if not self._in_order(arrivals):
            gone: set[int] = set()
            for index, (stream, payload, raw, _) in enumerate(arrivals):
                info = raw.source_info
                lost = self.tracker.arrived(stream.heard, info) if info is not None else 0
                if self._given_up and lost >= 0:
                    lost += self._given_up.pop(stream.heard, 0)
                if lost > 0 and payload:
                    arrivals[index] = stream, payload, raw, lost
                elif lost or not payload:
                    gone.add(index)
                    self._leave_out(arrivals[index], lost)
            if gone:
                arrivals[:] = [arrival for index, arrival in enumerate(arrivals) if index not in gone]
        self._announce_holes()

    def _in_order(self, arrivals: list[Arrival]) -> bool:
        """Return whether these follow each other, of one stream, and are noted by that."""
        if self._given_up or len(arrivals) < _MANY or len({stream for stream, _, _, _ in arrivals}) > 1:
            return False
        if not all(map(_PAYLOAD, arrivals)):
            return False
        infos = [raw.source_info for _, _, raw, _ in arrivals]
        numbers = [info.source_sn for info in infos if info is not None]
        return len(numbers) == len(arrivals) and self.tracker.arrived_in_order(arrivals[0][0].heard, numbers)

    def _leave_out(self, arrival: Arrival, lost: int) -> None:
        hole = self.tracker.hole
        if lost == HELD and hole is not None:
            self._waiting.setdefault(hole, []).append(self._keep(arrival))
            self.held += 1
        elif lost > 0:
            self.report_later(arrival[0].key, lost)
        else:
            self.discarded += lost == LATE

    def _announce_holes(self) -> None:
        dug, self.tracker.dug = self.tracker.dug, []
        for hole in dug:
            numbers = set(map(_number, self._waiting.setdefault(hole, [])))
            numbers = {number for number in numbers if 0 <= number - hole.start <= LARGEST_GAP}
            # What waits already may have gaps of its own: one question for all of them.
            hole.stop = max([hole.stop, *(number for number in numbers if number - 1 not in numbers)])
            if self._on_hole is not None:
                self._on_hole(hole)


def _number(arrival: Arrival) -> int:
    info = arrival[2].source_info
    return -1 if info is None else info.source_sn
