"""Liveliness tokens: a snapshot by query, and a subscription to changes."""

import logging
import math
import re
import time
from collections.abc import Iterable
from contextlib import suppress
from itertools import islice
from typing import Final

import zenoh

from nedbus import limits
from nedbus.log_event import about
from nedbus.timings import TIMINGS

from .queries import Replies, wait_for_replies, zenoh_timeout
from .session import Session, translate_zenoh_errors

_log = logging.getLogger(__name__)

_LONGEST_KEY: Final = limits.QUERY_BYTES // limits.REPLIES
_LEAST_CHANGES: Final = 256  # that each of many subscribers queues
_PROBE_TIMEOUT: Final = 60.0  # s for a router to list its tokens, before the probe is repeated


def token_keys(session: Session, key_expr: str, *, timeout: float) -> list[str]:
    """Return the keys of matching liveliness tokens, unique and sorted, at most 10,000."""
    replies = wait_for_replies([query_tokens(session, key_expr, timeout=timeout)])
    keys = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
    return sorted(keys)[: limits.REPLIES]


class LivelinessTokens:
    """The liveliness tokens that match any of some key expressions. Not thread-safe.

    `known`: the keys listed before by another instance; `poll` then returns the differences from them.

    A router sends a new subscriber all tokens at once, then each change. Listing takes time quadratic in the number of
    tokens, about one second for 4,000. The reply to a query on a key without a token (the probe) follows all tokens,
    and so marks the end of the list. If the queue of changes overflows, the subscription is declared again. At most
    10,000 tokens are stored; a warning is logged if there are more.
    """

    def __init__(self, session: Session, *key_exprs: str, known: Iterable[str] = ()) -> None:
        self._session = session
        self._key_exprs = key_exprs
        # Access rules that allow the key expression allow this key.
        self._probe_key = re.sub(r"\*\*|\$?\*", "-", key_exprs[-1])
        self._keys = set(known)
        # tokens of the previous subscription that the current one has not listed yet
        self._unseen: set[str] = set()
        # monotonic time of the next attempt to list tokens beyond the limit [s]
        self._retry = math.inf
        self._probe: Replies | None = None
        self._subscribe()

    @property
    def complete(self) -> bool:
        """True if all matching tokens are known."""
        return not self.is_listing and self._retry == math.inf

    @property
    def is_listing(self) -> bool:
        """True until the router has listed all tokens."""
        return self._probe is not None

    def undeclare(self) -> None:
        """End the subscription."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        # Zenoh frees neither until something else on it is undeclared
        for key in (*self._key_exprs, self._probe_key):
            self._session.undeclare(self._session.declare_keyexpr(key))

    def poll(self) -> list[tuple[str, bool]]:
        """Return the changes since the last call, in order: the key of a token, and True if it was declared."""
        is_listed = self._poll_probe()  # before the changes, because its reply follows all tokens
        changes = self._receive()
        is_retry_due = len(self._keys) < limits.REPLIES and time.monotonic() >= self._retry
        if changes is None or is_retry_due:
            self.undeclare()
            self._subscribe()
            return []
        self._unseen.difference_update(key for key, _ in changes)
        if is_listed:
            changes += [(key, False) for key in self._unseen]
        return [change for change in changes if self._apply(*change)]

    def _poll_probe(self) -> bool:
        """Return whether the probe has just ended, and so all tokens are listed; repeat it if it failed."""
        if self._probe is None:
            return False
        self._probe.poll()
        if not self._probe.ended:
            return False
        if self._probe.failed:
            self._probe = self._send_probe()
            return False
        self._probe = None
        return True

    def _receive(self) -> list[tuple[str, bool]] | None:
        """Return the queued changes; None if a queue is full, which may have dropped some."""
        changes: list[tuple[str, bool]] = []
        with suppress(zenoh.ZError):  # the session is closed
            for subscriber in self._subscribers:
                samples = list(islice(iter(subscriber.handler.try_recv, None), self._capacity))
                if len(samples) == self._capacity:
                    return None
                for sample in samples:
                    is_declared = sample.kind == zenoh.SampleKind.PUT
                    changes.append((str(sample.key_expr), is_declared))
        return changes

    def _subscribe(self) -> None:
        share = limits.TOKEN_CHANGES // len(self._key_exprs)
        self._capacity = max(share, min(limits.TOKEN_CHANGES, _LEAST_CHANGES))
        with translate_zenoh_errors():
            declare = self._session.liveliness().declare_subscriber
            self._subscribers = [
                declare(key_expr, zenoh.handlers.RingChannel(self._capacity), history=True)
                for key_expr in self._key_exprs
            ]
        self._probe = self._send_probe()
        self._unseen = self._keys.copy()
        self._retry = math.inf

    def _send_probe(self) -> Replies:
        return query_tokens(self._session, self._probe_key, timeout=_PROBE_TIMEOUT)

    def _apply(self, key: str, alive: bool) -> bool:
        """Apply a change; return False if it has no effect."""
        if (key in self._keys) == alive or len(key) > _LONGEST_KEY:
            return False
        if not alive:
            self._keys.remove(key)
            return True
        if len(self._keys) < limits.REPLIES:
            self._keys.add(key)
            return True
        if self._retry == math.inf:
            text = "%s: more than %d liveliness tokens, so some streams are missing"
            _log.warning(text, self._key_exprs[0], limits.REPLIES, extra=about("incomplete"))
        self._retry = time.monotonic() + TIMINGS.tokens_retry
        return False


def query_tokens(session: Session, key_expr: str, *, timeout: float) -> Replies:
    """Query matching tokens without waiting; each successful reply is one token."""
    timeout = zenoh_timeout(timeout)
    with translate_zenoh_errors():
        replies = session.liveliness().get(
            key_expr, zenoh.handlers.FifoChannel(limits.LISTED_TOKENS), timeout=timeout
        )
    return Replies(replies, timeout=timeout)
