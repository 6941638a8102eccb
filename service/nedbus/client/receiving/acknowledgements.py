"""Acknowledgement requests of lossless publishers, kept by a reader of mode `every` until it can answer. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from .stateful_reader import StatefulReader

MAX_PENDING: Final = 1000
"""Requests that wait for an answer; an honest publisher has one for each key at a time."""


@dataclass(slots=True, eq=False)
class AckRequest:
    """A publisher's question whether its message `number` has arrived or, with `read`, was taken by the script.

    `reply` answers it, and is called once. `until` is how many samples must have been read: it is known once the
    message has arrived.
    """

    key: str
    publisher: str
    number: int
    read: bool
    reply: Callable[[], object]
    until: int | None = None


class Acknowledgements:
    """Keep requests until they can be answered. Not thread-safe."""

    def __init__(self, reader: StatefulReader) -> None:
        self._reader = reader
        self.pending: deque[AckRequest] = deque(maxlen=MAX_PENDING)  # of too many the oldest is not answered

    def add(self, request: AckRequest) -> None:
        """Keep a request."""
        self.pending.append(request)

    def settle(self, *, arrived: int, taken: int, drained: bool) -> list[AckRequest]:
        """Return the requests that can be answered now, and forget them.

        `arrived` and `taken` count the samples that were queued and read so far. `drained`: all that came before the
        requests is queued by now, so that a publisher that is unknown has sent nothing to this reader.
        """
        drained = drained and not self._reader.unsettled
        ready: list[AckRequest] = []
        for request in self.pending:
            if request.until is None:
                has = self._reader.has(request.key, request.publisher, request.number)
                if has or (has is None and drained):
                    request.until = arrived if request.read else 0
            if request.until is not None and taken >= request.until:
                ready.append(request)
        if ready:
            self.pending = deque((each for each in self.pending if each not in ready), MAX_PENDING)
        return ready

    def take_all(self) -> list[AckRequest]:
        """Return all requests, and forget them."""
        pending, self.pending = list(self.pending), deque(maxlen=MAX_PENDING)
        return pending
