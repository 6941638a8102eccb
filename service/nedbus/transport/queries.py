"""Zenoh queries and their replies.

Replies are queued in Rust channels until a nedbus thread polls them. A Python callback, or its destructor, would
wait for the GIL on a Zenoh thread. During a liveliness query that thread holds the session lock, and so would deadlock
with any thread that holds the GIL while it waits for this lock.
"""

import logging
import time
from collections.abc import Iterator, Sequence
from typing import Any, Final

import zenoh

from nedbus.log_event import about

from .session import RawSample, Session, translate_zenoh_errors

_log = logging.getLogger(__name__)

MAX_REPLIES: Final = 10_000
"""Replies accepted per query; well-behaved peers send fewer."""

MAX_QUERY_BYTES: Final = 2**26
"""Payload and key bytes accepted per query."""

_GRACE: Final = 1.0  # s beyond the timeout for Zenoh to report the end of a query
_PAUSES: Final = (0.0005, 0.01)  # s between polls for replies: first and longest pause


class Replies:
    """The replies to one query. Not thread-safe."""

    def __init__(self, handler: zenoh.Handler[zenoh.Reply], *, timeout: float) -> None:
        self.ended = False  # no more replies: all queryables have replied, or the timeout has passed
        self.failed = False  # at least one reply was an error, such as a timeout
        self._handler = handler
        self._end = time.monotonic() + timeout + _GRACE

    def poll(self) -> list[zenoh.Reply]:
        """Return the replies received since the last call."""
        received: list[zenoh.Reply] = []
        try:
            while len(received) < MAX_REPLIES and (reply := self._handler.try_recv()) is not None:
                received.append(reply)
                self.failed |= reply.ok is None
            if time.monotonic() > self._end:
                self.ended = self.failed = True
        except zenoh.ZError:  # empty and closed
            self.ended = True
        return received


def send_query(session: Session, selector: str, *, timeout: float, capacity: int = 1024, **options: Any) -> Replies:
    """Query all matching queryables without waiting; the session blocks while `capacity` replies are pending.

    `options`: other arguments of `zenoh.Session.get`, such as `priority`.
    """
    timeout = zenoh_timeout(timeout)
    options |= {"target": zenoh.QueryTarget.ALL, "consolidation": zenoh.ConsolidationMode.NONE}
    with translate_zenoh_errors():
        replies = session.get(selector, zenoh.handlers.FifoChannel(capacity), timeout=timeout, **options)
    return Replies(replies, timeout=timeout)


def query(session: Session, selector: str, *, timeout: float) -> list[RawSample]:
    """Return the replies received within `timeout` seconds, possibly several per key.

    At most 10,000 replies and 64 MB in total are accepted; the number of replies beyond that is logged.
    """
    accepted: list[RawSample] = []
    size = dropped = 0
    replies = wait_for_replies([send_query(session, selector, timeout=timeout)])
    for sample in filter(None, (reply.ok for reply in replies)):
        size += len(sample.payload) + len(str(sample.key_expr))
        if size > MAX_QUERY_BYTES or len(accepted) >= MAX_REPLIES:
            dropped += 1
        else:
            accepted.append(sample)
    if dropped:
        text = "%s: dropped %d of %d replies beyond the limits of a query, so the result is incomplete"
        _log.warning(text, selector, dropped, len(accepted) + dropped, extra=about("incomplete"))
    return accepted


def wait_for_replies(queries: Sequence[Replies]) -> Iterator[zenoh.Reply]:
    """Yield replies as they arrive, until all queries have ended."""
    pause, longest = _PAUSES
    while pending := [replies for replies in queries if not replies.ended]:
        received = [reply for replies in pending for reply in replies.poll()]
        yield from received
        if not received:
            time.sleep(pause)
            pause = min(2 * pause, longest)


def zenoh_timeout(timeout: float) -> float:
    """Clamp a timeout to the range that Zenoh accepts: neither 0 nor infinity."""
    return min(max(timeout, 0.001), 86_400.0)
