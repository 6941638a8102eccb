"""Subscriptions that drop chosen messages, because loopback loses none, and record retransmission requests."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial
from types import SimpleNamespace

import nedbus
from nedbus.client.receiving import Decoder, Inbox, LayoutLookup, Receiver
from nedbus.transport import RawSample, RetransmitRequest, Session

from .numbered import publish, receive_timestamps


class LossyQueue(Inbox):
    """A queue that loses the messages whose sequence numbers are in `missing`."""

    def __init__(self, key_expr: str, *, limit: int | None = None) -> None:
        decoder = Decoder(LayoutLookup(lambda _: {}), prefix="nedbus")
        super().__init__("every", decoder, key_exprs=[key_expr], limit=limit)
        self.missing: Collection[int] = ()
        self.polls = 0  # how often the I/O thread has asked whether it may request

    @property
    def may_recover(self) -> bool:
        self.polls += 1
        return super().may_recover

    def put(self, batch: Sequence[RawSample], *, overflowed: bool = False) -> None:
        rest = [
            raw
            for raw in batch
            if raw.source_info is None or raw.source_info.source_sn not in self.missing
        ]
        super().put(rest, overflowed=overflowed)


class Lossy:
    """A subscription with a lossy queue. `requests`: retransmission requests; the first `unanswered` get no reply."""

    def __init__(
        self, session: Session, queue: LossyQueue, receiver: Receiver, publisher: nedbus.Publisher
    ) -> None:
        self.session = session
        self.publish = partial(publish, publisher)
        self.queue = queue
        self.subscription = nedbus.Subscription(receiver, queue, owner=None)
        self.receive = partial(receive_timestamps, self.subscription)
        self.requests: list[tuple[str, int, int]] = []
        self.unanswered = 0
        self.open = self.max_open = 0

    def request(
        self, session: Session, key: str, publisher: str, numbers: range, *, timeout: float
    ) -> object:
        self.requests.append((key, numbers.start, numbers.stop))
        if len(self.requests) <= self.unanswered:
            return SimpleNamespace(ended=True, poll=dict)
        self.open += 1
        self.max_open = max(self.max_open, self.open)
        return CountedRequest(
            RetransmitRequest(session, key, publisher, numbers, timeout=timeout), self
        )


class CountedRequest:
    """A retransmission request that counts as open until its last reply."""

    def __init__(self, answers: RetransmitRequest, lossy: Lossy) -> None:
        self._answers = answers
        self._lossy = lossy

    def poll(self) -> dict[int, RawSample]:
        had_ended, taken = self._answers.ended, self._answers.poll()
        self._lossy.open -= self._answers.ended and not had_ended
        return taken

    @property
    def ended(self) -> bool:
        return self._answers.ended
