"""The node of a source in ROS 2: received messages, and a subscription to each published topic."""

from __future__ import annotations

import os
import queue
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.sources.source import Rejection
from nedbus.transport import (
    LONGEST_TOKEN,
    PX4_TYPES,
    AliveTokens,
    Session,
    TopicKey,
    node_token,
    px4_publishers_key_expr,
    subscription_token,
    while_open,
)

_MAX_PENDING: Final = 4096  # samples that wait to be decoded
_MAX_PENDING_BYTES: Final = 4096  # of the payload of each
_RING_SIZE: Final = 16_384  # samples that arrive until the thread takes them
_MAX_SUBSCRIPTIONS: Final = 1000  # topics; a vehicle has a handful
_JOIN_TIMEOUT: Final = 3.0  # s
_TOO_FAST: Final = "queue", "messages arrive faster than they are decoded"
_TOO_LARGE: Final = "size", f"a payload of more than {_MAX_PENDING_BYTES} bytes, or a key that is too long"


class Px4ZenohNode:
    """Messages of all publishers in order in `pending`, and the `tokens` of these publishers; a context manager.

    Zenoh puts messages into a channel in Rust, which a thread of ours empties: a callback would wait for the
    interpreter's lock. Tokens of its own make ROS 2 list this source, and a publisher in ROS 2 see a subscriber.
    """

    def __init__(self, session: Session, *, domain: int | None) -> None:
        self.pending: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        self.tokens = AliveTokens(session, px4_publishers_key_expr(domain))
        self._session = session
        self._zid, self._node = str(session.info.zid()), f"nedbus_px4_zenoh_{os.getpid()}"
        self._nodes: dict[int, zenoh.LivelinessToken] = {}  # by domain
        self._subscriptions: dict[TopicKey, zenoh.LivelinessToken] = {}
        self._entities = 0
        self._dropped = Counter({_TOO_FAST: 0, _TOO_LARGE: 0})
        self._reported = Counter[tuple[str, str]]()
        key_expr = f"{'*' if domain is None else domain}/**/{PX4_TYPES}/*"
        with while_open():
            self._subscriber = session.declare_subscriber(key_expr, zenoh.handlers.RingChannel(_RING_SIZE))
        handler = self._subscriber.handler
        self._thread = threading.Thread(target=self._receive, args=[handler], name="nedbus-px4", daemon=True)
        self._thread.start()

    def dropped(self) -> Iterator[Rejection]:
        """Yield a rejection for the messages of each reason that were dropped since the last call."""
        new = self._dropped - self._reported
        for (where, reason), count in new.items():
            yield Rejection(where, reason, count=count)
        self._reported += new

    def subscribe(self, key: TopicKey) -> None:
        """Appear as a subscription to a topic."""
        if key in self._subscriptions or len(self._subscriptions) >= _MAX_SUBSCRIPTIONS:
            return
        if key.domain not in self._nodes:
            self._nodes[key.domain] = self._declare(node_token(key.domain, self._zid, self._node))
        self._entities += 1
        self._subscriptions[key] = self._declare(subscription_token(key, self._zid, self._node, self._entities))

    def unsubscribe(self, key: TopicKey) -> None:
        """Withdraw the subscription to a topic that has no publisher any more."""
        if key in self._subscriptions:
            with suppress(zenoh.ZError):  # its session may be closed already
                self._subscriptions.pop(key).undeclare()

    def __enter__(self) -> Px4ZenohNode:
        return self

    def __exit__(self, *exc: object) -> None:
        with suppress(zenoh.ZError):  # its session may be closed already
            for token in (*self._subscriptions.values(), *self._nodes.values()):
                token.undeclare()
            self.tokens.undeclare()
            self._subscriber.undeclare()
        self._thread.join(_JOIN_TIMEOUT)

    def _declare(self, text: str) -> zenoh.LivelinessToken:
        with while_open():
            return self._session.liveliness().declare_token(text)

    def _receive(self, handler: zenoh.Handler[zenoh.Sample]) -> None:
        with suppress(zenoh.ZError):  # undeclared
            while True:
                sample = handler.recv()
                if self.pending.qsize() >= _MAX_PENDING:
                    self._dropped[_TOO_FAST] += 1
                elif len(sample.payload) > _MAX_PENDING_BYTES or len(str(sample.key_expr)) > LONGEST_TOKEN:
                    self._dropped[_TOO_LARGE] += 1
                else:
                    self.pending.put(sample)
