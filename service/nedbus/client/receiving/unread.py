"""Unread: the messages that a subscription has received and its reader has not read; no I/O."""

from __future__ import annotations

from collections import deque
from operator import attrgetter
from typing import Final

from nedbus import limits
from nedbus_msgs import identity_of

from .arrival import Arrival, detach, encoding_of
from .writer_proxy import LossCounters

_PAYLOAD: Final = attrgetter("payload")


class Unread:
    """Unread messages in order of arrival, with `newest_only` the newest of each key; drops the oldest at its limits.

    `limit`: messages. Not thread-safe.
    """

    def __init__(self, counters: LossCounters, *, newest_only: bool, limit: int) -> None:
        self.newest_only = newest_only
        self.arrived = 0
        self._counters = counters
        self._limit = limit
        self._bytes = 0
        self._every: deque[Arrival] = deque()
        self._newest: dict[str, Arrival] = {}

    def __len__(self) -> int:
        return len(self._every) or len(self._newest)

    def add(self, arrivals: list[Arrival]) -> int:
        """Add messages; drop superseded ones and, above a limit, the oldest; return how many the limits dropped."""
        every = self._every
        newest = self._newest
        self.arrived += len(arrivals)
        self._bytes += sum(map(len, map(_PAYLOAD, arrivals)))
        if self.newest_only:
            for arrival in arrivals:
                key = arrival.stream.key
                waiting = newest.get(key)
                if waiting is not None:
                    self._counters.dropped += 1
                    self._bytes -= len(waiting.payload)
                    newest[key] = arrival._replace(lost=arrival.lost + waiting.lost)
                else:
                    newest[key] = arrival
        else:
            every.extend(
                map(detach, arrivals) if len(every) > limits.BUFFERED_MESSAGES else arrivals
            )
        excess = 0
        while (
            len(every) > self._limit
            or len(newest) > self._limit
            or self._bytes > limits.UNREAD_BYTES
        ):
            self._drop_oldest()
            excess += 1
        return excess

    def pop(self) -> Arrival | None:
        """Remove and return the oldest message; None if there is none."""
        if self._every:
            arrival = self._every.popleft()
        elif self._newest:
            arrival = self._newest.pop(next(iter(self._newest)))
        else:
            return None
        self._bytes -= len(arrival.payload)
        return arrival

    def pop_batch(self, max_messages: int | None) -> list[Arrival]:
        """Remove and return the messages of the same type as the oldest; the others stay in order."""
        every = self._every
        newest = self._newest
        count = min(
            len(self), max_messages or (len(newest) if self.newest_only else limits.BATCH_MESSAGES)
        )
        taken = list(newest.values())[:count] or [every.popleft() for _ in range(count)]
        if len({arrival.stream.codec for arrival in taken}) > 1 or taken[0].stream.codec is None:
            kinds = [
                arrival.codec if arrival.stream.codec else _identity(arrival) for arrival in taken
            ]
            others = [
                arrival for arrival, kind in zip(taken, kinds, strict=True) if kind != kinds[0]
            ]
            taken = [
                arrival for arrival, kind in zip(taken, kinds, strict=True) if kind == kinds[0]
            ]
            if not self.newest_only:
                every.extendleft(reversed(others))
        for arrival in taken if self.newest_only else ():
            del newest[arrival.stream.key]
        self._bytes -= sum(map(len, map(_PAYLOAD, taken)))
        return taken

    def discard(self) -> None:
        """Drop all messages."""
        while len(self):
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        arrival = self.pop()
        if arrival:
            arrival.stream.unreported += arrival.lost
            self._counters.dropped += 1


def _identity(arrival: Arrival) -> tuple[str, str] | None:
    return identity_of(encoding_of(arrival.stream, arrival.raw))
