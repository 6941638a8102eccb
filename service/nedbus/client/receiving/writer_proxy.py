"""Writer proxy: expected number, reorder buffer and open request of one remote publisher; no I/O.

Name and design are those of RTPS: one object holds the state that a reader keeps about one publisher.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import zenoh

from nedbus import limits
from nedbus.timings import TIMINGS

from .arrival import Arrival, Stream, detach

NUMBERS: Final = 2**32  # Zenoh's sequence numbers wrap here
# a larger step means that the publisher restarted or the message is late
LARGEST_GAP: Final = 2**30

_LAST_NUMBER: Final = NUMBERS - 1  # no retransmission across the wrap
# a step back up to this size is a late message or a duplicate; a larger one is a restart
_REORDERED: Final = 2**16
_RETRY_PAUSES: Final = (0.05, 0.1, 0.2, 0.4, 0.8)  # s between attempts; the last one repeats


@dataclass(slots=True, eq=False)
class LossCounters:
    """Message counts of a subscription, as in Counts."""

    received: int = 0
    lost: int = 0
    dropped: int = 0
    discarded: int = 0
    forgotten: int = 0


@dataclass(slots=True, eq=False)
class Gaps:
    """Open gaps of a subscription."""

    held: int = 0  # messages held back behind gaps
    opened: int = 0  # gaps so far
    # proxies with a gap, oldest request first
    requesting: dict[WriterProxy, None] = field(default_factory=dict)


@dataclass(slots=True, eq=False)
class Request:
    """Retransmission request to one publisher; times in monotonic seconds."""

    stop: int  # one past the highest number known to be sent
    retry_at: float = 0.0
    deadline: float | None = None  # when the gap counts as lost; each delivery resets it
    attempts: int = 0
    requested: range | None = None  # numbers of the open query
    # lowest number answered; the publisher caches everything from this one on
    first_available: int | None = None
    last_answered: bool = False  # the highest requested number was answered
    # number requested again; an answer proves that `candidate` is the lowest in the cache
    probe: int | None = None
    candidate: int | None = None


@dataclass(slots=True, eq=False)
class WriterProxy:
    """One publisher on one key; not thread-safe."""

    stream: Stream
    name: str  # `zid` and `eid` combined
    expected: int  # the next number
    counters: LossCounters
    gaps: Gaps
    zid: object = None  # `zid` and `eid` are set by the first message
    eid: int | None = None
    # lower numbers may predate the subscription, and are not lost; 0 after the first delivery
    history_end: int = 0
    unresponsive: bool = False  # it left a request unanswered; later gaps get a single attempt
    request: Request | None = None
    held: dict[int, Arrival] = field(default_factory=dict)

    def on_sample(
        self, number: int, arrival: Arrival, *, recovers: bool, overflowed: bool = False
    ) -> list[Arrival]:
        """Accept a message, and return what is in order now.

        With `recovers`, messages behind a gap are held back until it is filled.
        With `overflowed`, the ring was full, and the gap counts as dropped.
        """
        step = (number - self.expected) % NUMBERS
        released: list[Arrival] = []
        if step > LARGEST_GAP:
            if NUMBERS - step <= _REORDERED:
                self.counters.discarded += 1
                return []
            released = self.give_up()
            self.expected = number
        elif (
            step and (self.request is not None or recovers) and self.expected + step < _LAST_NUMBER
        ):
            self._hold(number, arrival)
            self._extend_request(number + 1)
            return []
        else:
            if step:
                released = self.give_up()
            self._count_gap(number, overflowed=overflowed)
        return released + self._deliver(arrival) + self._release()

    def is_sender(self, info: zenoh.SourceInfo | None) -> bool:
        """Return True for the source info of this writer; comparing the parts of an id is cheaper than its name."""
        source = info and info.source_id
        return source is not None and source.eid == self.eid and source.zid == self.zid

    def on_heartbeat(self, number: int) -> None:
        """Open a gap up to a message that should have arrived by now."""
        if self.expected <= number < min(self.expected + LARGEST_GAP, _LAST_NUMBER):
            self._extend_request(number + 1)

    def next_request(self, now: float) -> range | None:
        """Return the numbers to request now, up to the end of the last gap; None if no request is due."""
        request = self.request
        if request is None or request.requested is not None or now < request.retry_at:
            return None
        if request.first_available is not None and request.first_available < self.expected:
            request.first_available = request.probe = request.candidate = None
        if request.probe is None:
            last = request.stop - 1
        else:
            last = request.probe
        while request.probe is None and last in self.held:
            last -= 1
        if request.deadline is None:
            if self.unresponsive:
                request.deadline = now
            else:
                request.deadline = now + TIMINGS.retransmit_timeout
        request.attempts += 1
        self.gaps.requesting[self] = self.gaps.requesting.pop(self)
        request.requested = range(max(self.expected, last - limits.REPLIES + 1), last + 1)
        return request.requested

    def on_retransmission(
        self, answers: Mapping[int, Arrival], *, ended: bool, now: float
    ) -> list[Arrival]:
        """Accept answers to the open request, and return what is in order now; `ended`: no more answers follow."""
        request = self.request
        if request is None:
            return []
        for number, arrival in answers.items():
            if self.expected <= number < request.stop and number not in self.held:
                self._hold(number, arrival)
        if answers:
            self.unresponsive = False
            lowest = request.first_available
            if lowest is None:
                request.first_available = min(answers)
            else:
                request.first_available = min(lowest, *answers)
            request.last_answered |= (
                request.requested is not None and request.requested[-1] in answers
            )
        released: list[Arrival] = []
        # else wait for the end, which reveals the lowest number available
        if self.history_end <= self.expected:
            released = self._release()
        if ended and request.requested is not None:
            released += self._end_request(request, request.requested[-1], now)
        return released

    def _end_request(self, request: Request, last: int, now: float) -> list[Arrival]:
        """Handle the end of the answers up to number `last`, and return what is in order now."""
        released: list[Arrival] = []
        request.requested = None
        expired = request.deadline is not None and now >= request.deadline
        if request.last_answered:
            released = self._confirm_lowest(request, expired=expired)
        elif request.probe is not None:
            request.probe = request.stop - 1  # the probe may have left the cache
        released += self._release()
        if expired:
            self.unresponsive = request.first_available is None
            released += self.give_up(last)
        request.last_answered = False
        request.retry_at = now + _RETRY_PAUSES[min(request.attempts, len(_RETRY_PAUSES) - 1)]
        return released

    def give_up(self, last: int = NUMBERS) -> list[Arrival]:
        """Count gaps up to number `last` as lost, and return the messages held back behind them."""
        released: list[Arrival] = []
        while self.request is not None and self.expected <= last:
            self._count_gap(min(self.held, default=self.request.stop))
            released += self._release()
        return released

    def is_settled(self, number: int) -> bool:
        """Return True if this message has arrived or counts as lost."""
        return (self.expected - 1 - number) % NUMBERS <= LARGEST_GAP

    def _confirm_lowest(self, request: Request, *, expired: bool) -> list[Arrival]:
        """Count numbers below the lowest answered one as lost, once a probe has shown that no lower answer was lost."""
        lowest = request.first_available
        if lowest is None or lowest <= self.expected:
            return []
        if lowest != request.candidate and not expired:
            request.probe = request.candidate = lowest
            return []
        request.probe = None
        return self.give_up(lowest - 1)

    def _hold(self, number: int, arrival: Arrival) -> None:
        if number in self.held:
            self.counters.discarded += 1
        else:
            self.held[number] = detach(arrival)
            self.gaps.held += 1

    def _extend_request(self, stop: int) -> None:
        if self.request is None:
            self.request = Request(stop)
            self.gaps.requesting[self] = None
            self.gaps.opened += 1
        self.request.stop = max(self.request.stop, stop)

    def _count_gap(self, number: int, *, overflowed: bool = False) -> None:
        certain = max(self.expected, min(self.history_end, number))
        lost = (number - certain) % NUMBERS
        if overflowed:
            self.counters.dropped += lost
        else:
            self.counters.lost += lost
            self.stream.gap += lost
        self.expected = number

    def _deliver(self, arrival: Arrival) -> list[Arrival]:
        """Advance to the next number; return the message with the losses before it, or nothing if it was rejected."""
        self.expected = (self.expected + 1) % NUMBERS
        self.history_end = 0
        if not arrival.payload:
            return []
        if self.stream.gap:
            arrival = arrival._replace(lost=self.stream.gap)
            self.stream.gap = 0
        return [arrival]

    def _release(self) -> list[Arrival]:
        """Return the held messages that are in order now, and end the request if none is missing."""
        request = self.request
        released: list[Arrival] = []
        if request is None:
            return released
        while (arrival := self.held.pop(self.expected, None)) is not None:
            self.gaps.held -= 1
            released += self._deliver(arrival)
            request.deadline = None
            request.attempts = 0
        if self.expected >= request.stop:
            self.request = None
            del self.gaps.requesting[self]
        return released
