"""A remote publisher as one reader knows it: the next number, messages held back, the open request. Pure.

The name is that of RTPS, and so is the idea: all that a reader knows of one publisher lies in one object.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from nedbus.transport import MAX_ANSWERS

from .decoder import Arrival, Decoder, KeyState

NUMBERS: Final = 2**32
"""Zenoh's sequence numbers wrap here."""

MAX_GAP: Final = 2**30
"""A step of more messages is not a gap: the publisher started again, or the message is late."""

_LAST_NUMBER: Final = NUMBERS - 1  # across the wrap nothing is asked for
_MAX_REORDERED: Final = 2**16  # a number that is lower by less is late or a duplicate; by more it is a restart
RETRANSMIT_TIMEOUT: Final = 20.0  # s of requests after which what is missing is lost: publishers keep it as long
_RETRY_PAUSES: Final = (0.05, 0.1, 0.2, 0.4, 0.8)  # s before asking again; then the last one


@dataclass(slots=True, eq=False)
class Account:
    """The messages of all publishers of a reader that it did not receive.

    `dropped`: by a ring that overflowed. `held`: that wait for those before them. `discarded`: duplicates, and late.
    `requesting`: the publishers of which something is missing; the one that was asked last comes last.
    """

    lost: int = 0
    dropped: int = 0
    discarded: int = 0
    held: int = 0
    requesting: dict[WriterProxy, None] = field(default_factory=dict)


@dataclass(slots=True, eq=False)
class Request:
    """The retransmission request for what is missing of one publisher; times in monotonic seconds.

    `stop`: one more than the newest number that is known to be sent. `asked`: the numbers of the open query.
    `until`: when it is given up, unless something is delivered meanwhile. `kept_from`: the lowest number that was
    answered; a publisher keeps all from there on. `answered`: the last of the numbers was answered. `witness`: the
    number that it has to answer once more, to prove that `confirmed` is the lowest that it keeps.
    """

    stop: int
    due: float = 0.0
    until: float | None = None
    tries: int = 0
    asked: range | None = None
    kept_from: int | None = None
    answered: bool = False
    witness: int | None = None
    confirmed: int | None = None


@dataclass(slots=True, eq=False)
class WriterProxy:
    """One publisher on one key. Each `on_` method returns what can be delivered now, in order.

    `name`: `zid` and `eid` in one, which are known from its first message on. `expected`: the next number.
    `uncertain`: until one is delivered, numbers below this were perhaps sent before this reader subscribed. `silent`:
    it has not answered a request; it is asked only once from then on. Not thread-safe.
    """

    stream: KeyState
    name: str
    expected: int
    account: Account
    zid: object = None
    eid: int | None = None
    uncertain: int = 0
    silent: bool = False
    request: Request | None = None
    held: dict[int, Arrival] = field(default_factory=dict)

    def on_sample(self, number: int, arrival: Arrival, *, recovers: bool, overflowed: bool = False) -> list[Arrival]:
        """Take a message; with `recovers` those that come after a gap are held back until it is filled.

        `overflowed`: it comes from a ring that was full: what is absent was dropped there.
        """
        step = (number - self.expected) % NUMBERS
        if step > MAX_GAP:
            if NUMBERS - step <= _MAX_REORDERED:
                self.account.discarded += 1
                return []
            delivered = self.give_up()
            self.expected = number
        elif step and (self.request is not None or recovers) and self.expected + step < _LAST_NUMBER:
            self._hold(number, arrival)
            self._extend_request(number + 1)
            return []
        else:
            delivered = self.give_up() if step and self.request is not None else []
            self._count_missing(number, overflowed=overflowed)
        self._deliver(arrival, delivered)
        return self._release(delivered)

    def on_heartbeat(self, number: int) -> None:
        """Note that a message was sent that should have arrived by now."""
        if self.expected <= number < min(self.expected + MAX_GAP, _LAST_NUMBER):
            self._extend_request(number + 1)

    def next_request(self, now: float) -> range | None:
        """Return the numbers to ask for now, None if nothing is due: all that is missing, up to the last of it."""
        request = self.request
        if request is None or request.asked is not None or now < request.due:
            return None
        if request.kept_from is not None and request.kept_from < self.expected:
            request.kept_from = request.witness = request.confirmed = None
        last = request.stop - 1 if request.witness is None else request.witness
        while request.witness is None and last in self.held:
            last -= 1
        if request.until is None:
            request.until = now if self.silent else now + RETRANSMIT_TIMEOUT
        request.tries += 1
        self.account.requesting[self] = self.account.requesting.pop(self)
        request.asked = range(max(self.expected, last - MAX_ANSWERS + 1), last + 1)
        return request.asked

    def on_retransmission(self, found: Mapping[int, Arrival], *, ended: bool, now: float) -> list[Arrival]:
        """Take what was answered to the request that is open; `ended`: nothing more will be."""
        request, delivered = self.request, list[Arrival]()
        if request is None:
            return delivered
        for number, arrival in found.items():
            if self.expected <= number < request.stop and number not in self.held:
                self._hold(number, arrival)
            request.kept_from = number if request.kept_from is None else min(number, request.kept_from)
            request.answered |= request.asked is not None and number == request.asked[-1]
        if self.uncertain <= self.expected:  # else the lowest that is kept comes first, and is known at the end
            self._release(delivered)
        if ended and request.asked is not None:
            last, request.asked, over = request.asked[-1], None, request.until is not None and now >= request.until
            if request.answered:
                self.silent = False
                self._confirm_lowest(request, delivered, over=over)
            elif request.witness is not None:
                request.witness = request.stop - 1  # the other one is perhaps not kept any more
            self._release(delivered)
            if over:
                self.silent = request.kept_from is None
                self._give_up(last, delivered)
            request.answered = False
            request.due = now + _RETRY_PAUSES[min(request.tries, len(_RETRY_PAUSES) - 1)]
        return delivered

    def give_up(self) -> list[Arrival]:
        """Return all that is held back: what is still missing is lost."""
        return [] if self.request is None else self._give_up(self.request.stop, [])

    def has(self, number: int) -> bool:
        """Return whether this message has arrived, or is known to be lost."""
        return (self.expected - 1 - number) % NUMBERS <= MAX_GAP

    def _confirm_lowest(self, request: Request, delivered: list[Arrival], *, over: bool) -> None:
        """Give up numbers below the lowest that was answered, once it is confirmed: answers may be lost too."""
        lowest = request.kept_from
        if lowest is None or lowest <= self.expected:
            return
        if lowest != request.confirmed and not over:
            request.witness = request.confirmed = lowest
        else:
            request.witness = None
            self._give_up(lowest - 1, delivered)

    def _hold(self, number: int, arrival: Arrival) -> None:
        if number in self.held:
            self.account.discarded += 1
        else:
            self.held[number] = Decoder.keep(arrival)
            self.account.held += 1

    def _extend_request(self, stop: int) -> None:
        if self.request is None:
            self.request = Request(stop)
            self.account.requesting[self] = None
        self.request.stop = max(self.request.stop, stop)

    def _count_missing(self, number: int, *, overflowed: bool = False) -> None:
        """Count the gap before a number, which comes next."""
        certain = max(self.expected, min(self.uncertain, number))
        lost = (number - certain) % NUMBERS
        if overflowed:
            self.account.dropped += lost
        else:
            self.account.lost += lost
            self.stream.gap += lost
        self.expected = number

    def _give_up(self, last: int, delivered: list[Arrival]) -> list[Arrival]:
        while self.request is not None and self.expected <= last:
            self._count_missing(min(self.held, default=self.request.stop))
            self._release(delivered)
        return delivered

    def _deliver(self, arrival: Arrival, delivered: list[Arrival]) -> None:
        self.expected = (self.expected + 1) % NUMBERS
        self.uncertain = 0
        stream, payload, raw, _ = arrival
        if payload:
            delivered.append((stream, payload, raw, stream.gap))
            stream.gap = 0

    def _release(self, delivered: list[Arrival]) -> list[Arrival]:
        """Deliver messages that were held back, up to the next gap."""
        request = self.request
        if request is None:
            return delivered
        while (arrival := self.held.pop(self.expected, None)) is not None:
            self.account.held -= 1
            self._deliver(arrival, delivered)
            request.until, request.tries = None, 0
        if self.expected >= request.stop:
            self.request = None
            del self.account.requesting[self]
        return delivered
