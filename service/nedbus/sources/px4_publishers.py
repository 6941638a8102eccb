"""Decide which publishers of a key are alive, and which are alike, from their liveliness tokens; no I/O, no clock.

Times are monotonic seconds of the caller's clock.
"""

from __future__ import annotations

from collections import Counter
from typing import Final

from nedbus.transport import PublisherToken, TopicKey

_MAX_TOKENS: Final = 10_000  # that are followed; a vehicle has a handful
_SETTLE: Final = 1.0  # s in which messages may still arrive from a publisher whose token is gone


class AlivePublishers:
    """The publishers that are alive, by the key of their messages.

    Two publishers of one key are alike if both have the same gid: their messages cannot be told apart.
    """

    def __init__(self) -> None:
        self._by_key: dict[TopicKey, dict[str, PublisherToken]] = {}
        self._sessions: dict[tuple[TopicKey, bytes], Counter[str]] = {}  # those with one gid
        self._alike: Counter[TopicKey] = Counter()  # how many gids of a key have several sessions
        self._settled: dict[TopicKey, float] = {}  # until when keys count as alike that no longer are
        self._count = 0

    def add(self, token: PublisherToken) -> None:
        """Take note of a publisher that appeared."""
        tokens = self._by_key.get(token.key, {})
        if token.text in tokens or self._count >= _MAX_TOKENS:
            return
        self._by_key.setdefault(token.key, tokens)[token.text] = token
        self._count += 1
        if token.gid is not None:
            sessions = self._sessions.setdefault((token.key, token.gid), Counter())
            sessions[token.session] += 1
            self._alike[token.key] += len(sessions) == 2 and sessions[token.session] == 1

    def remove(self, token: PublisherToken, now: float) -> None:
        """Take note of a publisher that is gone."""
        was_alike = self._alike[token.key] > 0
        self._remove(token)
        if was_alike and not self._alike[token.key]:
            self._settled = {key: until for key, until in self._settled.items() if until > now}
            self._settled[token.key] = now + _SETTLE
        self._alike += Counter()  # forgets those that are 0

    def forget(self, key: TopicKey) -> None:
        """Forget the publishers of a key."""
        for token in list(self._by_key.get(key, {}).values()):
            self._remove(token)

    def _remove(self, token: PublisherToken) -> None:
        tokens = self._by_key.get(token.key, {})
        if tokens.pop(token.text, None) is None:
            return
        self._count -= 1
        if not tokens:
            del self._by_key[token.key]
        if token.gid is not None:
            sessions = self._sessions[token.key, token.gid]
            sessions[token.session] -= 1
            if not sessions[token.session]:
                del sessions[token.session]
                self._alike[token.key] -= len(sessions) == 1
            if not sessions:
                del self._sessions[token.key, token.gid]

    def are_alike(self, key: TopicKey, now: float) -> bool:
        """Return whether two publishers of this key are alike, or were until a moment ago."""
        return self._alike[key] > 0 or now < self._settled.get(key, now)

    def is_alive(self, token: PublisherToken) -> bool:
        """Return whether this publisher is still there."""
        return token.text in self._by_key.get(token.key, ())

    def only(self, key: TopicKey) -> PublisherToken | None:
        """Return the publisher of a key that has one; None if it has none, or several."""
        tokens = self._by_key.get(key, {})
        return next(iter(tokens.values())) if len(tokens) == 1 else None
