"""Retransmission requests in mode `every`, sent to each publisher by its exact key and repeated for 20 s.

The reasons for not using Zenoh's own recovery are in docs/explanation/decisions/03-own-recovery.md.
"""

import logging
import math
from contextlib import suppress
from typing import Final

import zenoh

from nedbus import limits
from nedbus.client.io_thread import TICK
from nedbus.errors import NedbusError
from nedbus.log_event import UnexpectedErrors
from nedbus.transport import Heartbeats, RetransmitRequest, Session, follow_heartbeats
from nedbus_msgs import PAYLOAD_LIMIT

from .inbox import Inbox
from .writer_proxy import WriterProxy

_log = logging.getLogger(__name__)

_TIMEOUT: Final = 3.0  # s
_POLL: Final = 2 * TICK  # s between polls of heartbeats and due requests
_ANSWER_POLL: Final = 0.005  # s between polls for answers


class Retransmission:
    """Send a queue's retransmission requests and collect the answers; a job of the I/O thread."""

    def __init__(self, session: Session, inbox: Inbox) -> None:
        self._session = session
        self._inbox = inbox
        text = "%s: unexpected error, recovered messages discarded (logged once)"
        self._errors = UnexpectedErrors(_log, text, inbox.name)
        self._open: dict[WriterProxy, RetransmitRequest] = {}
        self._followed = [follow_heartbeats(session, key_expr) for key_expr in inbox.key_exprs]
        self._heartbeats: Heartbeats = {}  # from the previous poll
        self._next_heartbeat_poll = 0.0

    def poll(self, now: float, *, drained: bool) -> tuple[str, float]:
        """Poll heartbeats and answers, and send due requests.

        Return a key with newly readable messages, or "", and the seconds until the next poll.
        `drained`: the queue holds everything that had arrived before this call.
        """
        # Unless the ring was drained, messages that heartbeats announce may still be in it.
        if drained and now >= self._next_heartbeat_poll:
            self._next_heartbeat_poll = now + _POLL
            self._poll_heartbeats()
        recovered_key = ""
        for writer, answers in list(self._open.items()):
            if self._take_answers(writer, answers, now):
                recovered_key = writer.stream.wire_key
        if self._inbox.may_recover:
            for writer in list(self._inbox.gaps.requesting):  # copied: other threads add to it
                if self._may_open(writer):
                    self._request(writer, now)
        if self._open:
            pause = _ANSWER_POLL
        else:
            pause = _POLL
        return recovered_key, pause

    def _poll_heartbeats(self) -> None:
        """Handle the heartbeats of the previous poll, whose messages have arrived by now, and take new ones."""
        for (key, publisher), number in self._heartbeats.items():
            self._inbox.on_heartbeat(key, publisher, number)
        self._heartbeats = {}
        for take, _ in self._followed:
            self._heartbeats.update(take())

    def _request(self, writer: WriterProxy, now: float) -> None:
        numbers = self._inbox.next_request(writer, now)
        if numbers is None:
            return
        key = writer.stream.wire_key
        with suppress(NedbusError):  # the session is closed
            self._open[writer] = RetransmitRequest(
                self._session, key, writer.name, numbers, timeout=_TIMEOUT
            )

    def close(self) -> None:
        """Drop all requests: an answer channel left full would block the session."""
        self._open.clear()
        for _, undeclare in self._followed:
            with suppress(zenoh.ZError):  # the session is already closed
                undeclare()

    def _take_answers(self, writer: WriterProxy, answers: RetransmitRequest, now: float) -> bool:
        """Put the answers to a request into the inbox; return True if messages became readable."""
        samples = {
            number: raw
            for number, raw in answers.poll().items()
            if len(raw.payload) <= PAYLOAD_LIMIT
        }
        ended = answers.ended
        if ended:
            del self._open[writer]
        elif not samples:
            return False
        with self._errors:
            return self._inbox.on_retransmission(writer, samples, ended=ended, now=now)
        # after an unexpected error
        self._open.pop(writer, None)
        return self._inbox.on_retransmission(writer, {}, ended=True, now=math.inf)

    def _may_open(self, writer: WriterProxy) -> bool:
        """Return True if a further request is allowed: of all publishers, of its kind, and of its key."""
        if writer in self._open or len(self._open) >= limits.REQUESTS:
            return False
        if writer.history_end:
            histories = [other for other in self._open if other.history_end]
            return len(histories) < limits.HISTORY_REQUESTS
        of_key = [
            other for other in self._open if other.stream is writer.stream and not other.history_end
        ]
        return len(of_key) < limits.REQUESTS_OF_KEY
