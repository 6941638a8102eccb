"""The node as which a source appears in ROS 2, with a subscription to each topic that somebody publishes."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.transport import PublisherToken, Session, TopicKey, node_token, subscription_token, while_open

_MAX_SUBSCRIPTIONS: Final = 1000  # topics; a vehicle has a handful
_NAME: Final = "nedbus_px4_zenoh"


class Px4ZenohNode:
    """Declare liveliness tokens, so that ROS 2 lists this source, and a publisher in ROS 2 sees a subscriber."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._zid = str(session.info.zid())
        self._name = f"{_NAME}_{os.getpid()}"
        self._nodes: dict[int, zenoh.LivelinessToken] = {}  # by domain
        self._subscriptions: dict[TopicKey, zenoh.LivelinessToken] = {}
        self._publishers: dict[TopicKey, set[str]] = {}
        self._entities = 0

    def subscribe(self, publisher: PublisherToken) -> None:
        """Appear as a subscription to the topic of this publisher, unless it is one of nedbus."""
        key = publisher.key
        if publisher.node.startswith("nedbus_"):
            return
        if key not in self._subscriptions:
            if len(self._subscriptions) >= _MAX_SUBSCRIPTIONS:
                return
            if key.domain not in self._nodes:
                self._nodes[key.domain] = self._declare(node_token(key.domain, self._zid, self._name))
            self._entities += 1
            self._subscriptions[key] = self._declare(subscription_token(key, self._zid, self._name, self._entities))
        self._publishers.setdefault(key, set()).add(publisher.text)

    def unsubscribe(self, publisher: PublisherToken) -> None:
        """Take note that a publisher is gone: the subscription goes with the last one of its topic."""
        key = publisher.key
        publishers = self._publishers.get(key, set())
        publishers.discard(publisher.text)
        if not publishers and key in self._subscriptions:
            _undeclare(self._subscriptions.pop(key))
            del self._publishers[key]

    def close(self) -> None:
        """Withdraw all of it."""
        for token in [*self._subscriptions.values(), *self._nodes.values()]:
            _undeclare(token)
        self._subscriptions.clear()
        self._nodes.clear()

    def _declare(self, text: str) -> zenoh.LivelinessToken:
        with while_open():
            return self._session.liveliness().declare_token(text)


def _undeclare(token: zenoh.LivelinessToken) -> None:
    with suppress(zenoh.ZError):  # its session may be closed already
        token.undeclare()
