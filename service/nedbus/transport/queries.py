"""Zenoh queries and their replies.

Replies are queued in Rust channels until a nedbus thread polls them. A Python callback, or its destructor, would
wait for the GIL on a Zenoh thread. During a liveliness query that thread holds the session lock, and so would deadlock
with any thread that holds the GIL while it waits for this lock.
"""

import logging
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Any, Final

import zenoh

from nedbus import limits
from nedbus.log_event import about

from .session import RawSample, Session, translate_zenoh_errors

_log = logging.getLogger(__name__)

_GRACE: Final = 1.0  # s beyond the timeout for Zenoh to report the end of a query
# s between polls for replies
_FIRST_PAUSE: Final = 0.0005
_LONGEST_PAUSE: Final = 0.01


class Replies:
    """The replies to one query. Not thread-safe."""

    def __init__(self, handler: zenoh.Handler[zenoh.Reply], *, timeout: float) -> None:
        # no more replies: all queryables have replied, or the timeout has passed
        self.ended = False
        self.failed = False  # at least one reply was an error, such as a timeout
        self._handler = handler
        self._end = time.monotonic() + timeout + _GRACE

    def poll(self) -> list[zenoh.Reply]:
        """Return the replies received since the last call."""
        received: list[zenoh.Reply] = []
        try:
            for reply in islice(iter(self._handler.try_recv, None), limits.REPLIES):
                received.append(reply)
                if reply.ok is None:
                    self.failed = True
        except zenoh.ZError:  # empty and closed
            self.ended = True
            return received
        if time.monotonic() > self._end:
            self.ended = True
            self.failed = True
        return received


def send_query(
    session: Session, selector: str, *, timeout: float, capacity: int = 1024, **options: Any
) -> Replies:
    """Query all matching queryables without waiting; the session blocks while `capacity` replies are pending.

    `options`: other arguments of `zenoh.Session.get`, such as `priority`.
    """
    timeout = zenoh_timeout(timeout)
    with translate_zenoh_errors():
        replies = session.get(
            selector,
            zenoh.handlers.FifoChannel(capacity),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
            **options,
        )
    return Replies(replies, timeout=timeout)


def query(
    session: Session, *selectors: str, timeout: float, group_of: Callable[[str], str] = lambda _: ""
) -> list[RawSample]:
    """Return the replies to all selectors received within `timeout` seconds, possibly several per key.

    At most 10,000 replies and 64 MB in total are accepted; the number of replies beyond that is logged.
    `group_of`: return the group of a key. Beyond the limits, the group that uses most of them loses replies first. The
    replies of the groups that use least come first, so the same holds for a limit of the caller.
    """
    accepted = _Accepted()
    queries = [send_query(session, selector, timeout=timeout) for selector in selectors]
    for reply in wait_for_replies(queries):
        if reply.ok is not None:
            accepted.add(group_of(str(reply.ok.key_expr)), reply.ok)
    if accepted.dropped:
        text = (
            "%s: dropped %d of %d replies beyond the limits of a query, so the result is incomplete"
        )
        names = ", ".join(selectors)
        total = accepted.count + accepted.dropped
        _log.warning(text, names, accepted.dropped, total, extra=about("incomplete"))
    return accepted.samples()


class _Accepted:
    """The replies within the limits of a query, by group."""

    def __init__(self) -> None:
        self.groups: defaultdict[str, list[RawSample]] = defaultdict(list)
        self.count = 0
        self.dropped = 0
        self._size = 0  # bytes
        self._used = Counter[str]()  # bytes by group, with the share of each reply
        self._largest = ""

    def add(self, group: str, sample: RawSample) -> None:
        """Add a reply, then drop replies of the largest group until the limits hold."""
        self.groups[group].append(sample)
        self._count(group, sample, 1)
        if self._used[group] >= self._used[self._largest]:
            self._largest = group
        while self._size > limits.QUERY_BYTES or self.count > limits.REPLIES:
            self._count(self._largest, self.groups[self._largest].pop(), -1)
            self.dropped += 1
            if self._largest != group:  # else the next reply of a flood needs no search
                self._largest = max(self._used, key=self._used.__getitem__)

    def samples(self) -> list[RawSample]:
        """Return the accepted replies, those of the smallest group first."""
        ordered = sorted(self.groups, key=self._used.__getitem__)
        return [sample for group in ordered for sample in self.groups[group]]

    def _count(self, group: str, sample: RawSample, sign: int) -> None:
        size = len(sample.payload) + len(str(sample.key_expr))
        self.count += sign
        self._size += sign * size
        share = limits.QUERY_BYTES // limits.REPLIES
        self._used[group] += sign * (size + share)


def wait_for_replies(queries: Sequence[Replies]) -> Iterator[zenoh.Reply]:
    """Yield replies as they arrive, until all queries have ended."""
    pause = _FIRST_PAUSE
    while pending := [replies for replies in queries if not replies.ended]:
        received = [reply for replies in pending for reply in replies.poll()]
        yield from received
        if not received:
            time.sleep(pause)
            pause = min(1.25 * pause, _LONGEST_PAUSE)


def zenoh_timeout(timeout: float) -> float:
    """Clamp a timeout to the range that Zenoh accepts: neither 0 nor infinity."""
    return min(max(timeout, 0.001), 86_400.0)
