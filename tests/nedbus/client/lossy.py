"""Subscriptions that miss messages, and their retransmission requests; loopback itself is lossless."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial
from types import SimpleNamespace

import nedbus
from nedbus.client.receiving import Decoder, LayoutLookup, PendingQueue, Receiver
from nedbus.transport import RawSample, RetransmitRequest, Session

from .numbered import publish, take


class LossyQueue(PendingQueue):
    """A queue that does not receive the messages `missing`, by sequence number."""

    def __init__(self, key_expr: str) -> None:
        super().__init__("every", Decoder(LayoutLookup(lambda _: {}), prefix="nedbus"), name=key_expr)
        self.missing: Collection[int] = ()

    def put(self, batch: Sequence[RawSample], *, overflowed: bool = False) -> None:
        left = [raw for raw in batch if raw.source_info is None or raw.source_info.source_sn not in self.missing]
        super().put(left, overflowed=overflowed)


class Lossy:
    """A subscription with a lossy queue, and its requests; the first `unanswered` get no reply."""

    def __init__(self, session: Session, queue: LossyQueue, receiver: Receiver, publisher: nedbus.Publisher) -> None:
        self.session = session
        self.publish = partial(publish, publisher)
        self.queue = queue
        self.subscription = nedbus.Subscription(receiver, queue, owner=None)
        self.receive = partial(take, self.subscription)
        self.asked: list[tuple[str, int, int]] = []
        self.unanswered = 0
        self.open = self.most = 0

    def ask(self, session: Session, key: str, publisher: str, numbers: range, *, timeout: float) -> object:
        self.asked.append((key, numbers.start, numbers.stop))
        if len(self.asked) <= self.unanswered:
            return SimpleNamespace(ended=True, poll=dict)
        self.open += 1
        self.most = max(self.most, self.open)
        return Counted(RetransmitRequest(session, key, publisher, numbers, timeout=timeout), self)


class Counted:
    """The replies to a request, which counts as open until they have ended."""

    def __init__(self, answers: RetransmitRequest, lossy: Lossy) -> None:
        self._answers = answers
        self._lossy = lossy

    def poll(self) -> dict[int, RawSample]:
        was, taken = self._answers.ended, self._answers.poll()
        self._lossy.open -= self._answers.ended and not was
        return taken

    @property
    def ended(self) -> bool:
        return self._answers.ended
