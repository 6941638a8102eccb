"""The publishers that are announced by liveliness tokens, and what arrives of them; no I/O, no clock.

Times are monotonic seconds of the caller's clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from nedbus.sources.source import Absence
from nedbus.transport import PublisherToken, TopicKey
from nedbus_msgs import Address, get_topic

_MAX_PUBLISHERS: Final = 64  # of a key that are followed
_SETTLE_TIME: Final = 1.0  # s in which messages may still arrive from a publisher whose token is gone
_SILENCE: Final = 5.0  # s, or messages at the nominal rate if that is slower, of which none came
_NODE_TIMEOUT: Final = 3.0  # s for which a node sends after a message of it: a link that is down silences no topic
_MAX_NAMES: Final = 100  # in a report


@dataclass(slots=True, eq=False)
class _AnnouncedKey:
    """A key with at least one publisher: its address, or the message that is not carried.

    `alike_until`: until then two of its publishers may not be told apart.
    """

    what: Address | str
    since: float
    heard: float = -math.inf
    alike_until: float = -math.inf
    tokens: dict[str, PublisherToken] = field(default_factory=dict)

    def has_alike(self) -> bool:
        """Return whether publishers of several sessions have the same gid."""
        sessions = {(token.gid, token.session) for token in self.tokens.values() if token.gid is not None}
        return len({gid for gid, _ in sessions}) < len(sessions)

    def nodes(self) -> set[tuple[str, str]]:
        """Return the nodes that publish on it; those of nedbus are bridges of several vehicles."""
        every = {(token.session, token.node) for token in self.tokens.values()}
        return {(session, node) for session, node in every if not node.startswith("nedbus_")}

    def is_silent(self, now: float) -> bool:
        """Return whether nothing came for longer than its rate explains; a topic without a rate comes on events."""
        rate = get_topic(self.what.topic).rate if isinstance(self.what, Address) else 0.0
        return rate > 0 and now - max(self.since, self.heard) >= max(_SILENCE, _SILENCE / rate)


class PublisherTable:
    """All publishers that are alive, by key.

    Two publishers of one key are alike if both have the same gid: their messages cannot be told apart.
    """

    def __init__(self) -> None:
        self._keys: dict[TopicKey, _AnnouncedKey] = {}

    def add(self, token: PublisherToken, what: Address | str, now: float) -> None:
        """Add a publisher: of an address, or of a message that is not carried, "" if no option asks for it."""
        key = self._keys.setdefault(token.key, _AnnouncedKey(what, now))
        if token.text not in key.tokens and len(key.tokens) < _MAX_PUBLISHERS:
            key.tokens[token.text] = token
            key.alike_until = math.inf if key.has_alike() else key.alike_until

    def remove(self, token: PublisherToken, now: float) -> None:
        """Remove a publisher that is gone."""
        key = self._keys.get(token.key)
        if key is None:
            return
        key.tokens.pop(token.text, None)
        if key.alike_until == math.inf and not key.has_alike():
            key.alike_until = now + _SETTLE_TIME
        if not key.tokens and key.alike_until <= now:  # else messages of several publishers may still arrive
            del self._keys[token.key]

    def forget(self, key: TopicKey) -> None:
        """Forget the publishers of a key."""
        self._keys.pop(key, None)

    def hear(self, key: TopicKey, now: float) -> bool:
        """Note the arrival of a message; return whether its key is announced, and not carried."""
        announced = self._keys.get(key)
        if announced is None:
            return False
        announced.heard = now
        return isinstance(announced.what, str)

    def are_alike(self, key: TopicKey, now: float) -> bool:
        """Return whether two publishers of this key are alike, or were until a moment ago."""
        return key in self._keys and now < self._keys[key].alike_until

    def is_alive(self, token: PublisherToken) -> bool:
        """Return whether this publisher is still there."""
        return token.key in self._keys and token.text in self._keys[token.key].tokens

    def has(self, key: TopicKey) -> bool:
        """Return whether a key has a publisher."""
        return key in self._keys and bool(self._keys[key].tokens)

    def only(self, key: TopicKey) -> PublisherToken | None:
        """Return the publisher of a key that has one; None if it has none, or several."""
        tokens = self._keys[key].tokens if key in self._keys else {}
        return next(iter(tokens.values())) if len(tokens) == 1 else None

    def report(self, now: float) -> Absence:
        """Return what is not carried, and what is silent while other topics of its node arrive."""
        self._keys = {name: key for name, key in self._keys.items() if key.tokens or now < key.alike_until}
        nodes = [(key, key.nodes()) for key in self._keys.values()]
        sending = {node for key, own in nodes if now - key.heard < _NODE_TIMEOUT for node in own}
        silent = {str(key.what) for key, own in nodes if sending & own and key.is_silent(now)}
        not_carried = {key.what for key, own in nodes if own and key.what and isinstance(key.what, str)}
        return Absence(tuple(sorted(not_carried)[:_MAX_NAMES]), tuple(sorted(silent)[:_MAX_NAMES]))
