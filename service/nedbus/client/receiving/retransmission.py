"""Retransmission requests of a subscription of mode `every`: to each publisher by its exact key, repeated for 20 s.

Zenoh's own recovery asks once, with the key expression of the subscription, which a router compares with the caches of
all publishers: the restart of a router with 1,000 of them became a storm in which requests went unanswered. Here at
most 64 requests are open, and only later messages of the same publisher wait for the answer.
"""

from __future__ import annotations

import logging
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.errors import NedbusError
from nedbus.log_event import about
from nedbus.transport import Heartbeats, RetransmitRequest, Session, follow_heartbeats, request_samples
from nedbus_msgs import PAYLOAD_LIMIT

from .pending_queue import CAPACITY, PendingQueue
from .writer_proxy import WriterProxy

_log = logging.getLogger(__name__)

_MAX_OPEN: Final = 64  # requests at a time,
_MAX_OPEN_UNCERTAIN: Final = 16  # and of these for what a publisher sent before it was heard
_MAX_OPEN_OF_KEY: Final = 4  # and for one key, whose publishers may leave them unanswered
_MAX_WAITING: Final = CAPACITY // 2  # messages to be read beyond which nothing is asked for: it would push out others
_REQUEST_TIMEOUT: Final = 3.0  # s until a request is given up
_POLL: Final = 0.1  # s between two polls of heartbeats, and of requests that are due
_ANSWER_POLL: Final = 0.005  # s between two polls for answers


class Retransmission:
    """Send the requests for a queue's publishers, and pass on their answers; a job of Housekeeping's thread."""

    def __init__(self, session: Session, key_expr: str, pending_queue: PendingQueue) -> None:
        self._session = session
        self._queue = pending_queue
        self._open: dict[WriterProxy, RetransmitRequest] = {}
        self._take_heartbeats, self._undeclare = follow_heartbeats(session, key_expr)
        self._heartbeats: Heartbeats = {}  # of the last poll
        self._next_heartbeat_poll = 0.0

    def turn(self, now: float, *, drained: bool) -> tuple[str, float]:
        """Do what is due; return a key of which something can be read now, or "", and seconds until the next turn.

        `drained`: all that had arrived before this turn is queued.
        """
        if drained and now >= self._next_heartbeat_poll:  # else what the last ones tell of may be in the ring still
            self._next_heartbeat_poll = now + _POLL
            for (key, publisher), number in self._heartbeats.items():
                self._queue.on_heartbeat(key, publisher, number)
            self._heartbeats = self._take_heartbeats()
        filled = ""
        for writer, answers in list(self._open.items()):
            filled = self._take(writer, answers, now) or filled
        if self._queue.waiting <= _MAX_WAITING:
            for writer in list(self._queue.account.requesting):  # a copy: other threads add to it
                if len(self._open) >= _MAX_OPEN:
                    break
                if writer not in self._open and self._has_room(writer):
                    self._ask(writer, now)
        return filled, _ANSWER_POLL if self._open else _POLL

    def close(self) -> None:
        """Drop all requests: a channel of answers that is not emptied would hold up the session."""
        self._open.clear()
        with suppress(zenoh.ZError):  # closed already with the session
            self._undeclare()

    def _take(self, writer: WriterProxy, answers: RetransmitRequest, now: float) -> str:
        found = {number: raw for number, raw in answers.take().items() if len(raw.payload) <= PAYLOAD_LIMIT}
        ended, key = answers.ended, writer.stream.heard
        if ended:
            del self._open[writer]
        elif not found:
            return ""
        try:
            recovered = self._queue.on_retransmission(writer, found, ended=ended, now=now)
        except Exception:  # noqa: BLE001 - what one sample causes must not keep all others from the reader
            _log.exception("%s: what was recovered is left out after an unexpected error", key, extra=about("bug"))
            self._open.pop(writer, None)
            recovered = self._queue.on_retransmission(writer, {}, ended=True, now=float("inf"))
        return key if recovered else ""

    def _has_room(self, writer: WriterProxy) -> bool:
        share = [each for each in self._open if bool(each.uncertain) == bool(writer.uncertain)]
        if writer.uncertain:
            return len(share) < _MAX_OPEN_UNCERTAIN
        return sum(each.stream is writer.stream for each in share) < _MAX_OPEN_OF_KEY

    def _ask(self, writer: WriterProxy, now: float) -> None:
        numbers = self._queue.next_request(writer, now)
        if numbers is None:
            return
        with suppress(NedbusError):  # the session is closed
            key = writer.stream.heard
            self._open[writer] = request_samples(self._session, key, writer.name, numbers, timeout=_REQUEST_TIMEOUT)
