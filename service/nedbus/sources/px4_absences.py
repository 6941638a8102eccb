"""What vehicles announce by liveliness tokens, against what of it arrives and is carried; no I/O, no clock.

Times are monotonic seconds of the caller's clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from nedbus.transport import PublisherToken
from nedbus_msgs import Address, get_topic

from .source import Absence

_SILENT: Final = 5.0  # s, or messages at the nominal rate if that is slower, of which none came
_SENDS: Final = 3.0  # s for which a node sends after a message of it: a link that is down silences no topic
_MAX_KEYS: Final = 1000  # and publishers of each; a vehicle has a handful
_MAX_PUBLISHERS: Final = 8
_MAX_NAMES: Final = 100


@dataclass(slots=True, eq=False)
class _Key:
    """A key that is announced: its address, or the message that is not carried; by which nodes, by their tokens."""

    what: Address | str
    since: float
    heard: float = -math.inf
    nodes: dict[str, tuple[str, str]] = field(default_factory=dict)

    def is_silent(self, now: float) -> bool:
        """Return whether nothing came for longer than its rate explains; what has none comes on events."""
        rate = get_topic(self.what.topic).rate if isinstance(self.what, Address) else 0.0
        return rate > 0 and now - max(self.since, self.heard) >= max(_SILENT, _SILENT / rate)


class Absences:
    """Compare what is announced with what arrives."""

    def __init__(self) -> None:
        self._keys: dict[str, _Key] = {}

    def announce(self, token: PublisherToken, what: Address | str, now: float) -> None:
        """Take note of a publisher: of an address, or of a message that is not carried, "" if nobody wants it."""
        if str(token.key) in self._keys or len(self._keys) < _MAX_KEYS:
            nodes = self._keys.setdefault(str(token.key), _Key(what, now)).nodes
            if len(nodes) < _MAX_PUBLISHERS:
                nodes[token.text] = token.session, token.node

    def withdraw(self, token: PublisherToken) -> None:
        """Take note that a publisher is gone."""
        key = self._keys.get(str(token.key))
        if key is not None:
            key.nodes.pop(token.text, None)
            if not key.nodes:
                del self._keys[str(token.key)]

    def hear(self, name: str, now: float) -> bool:
        """Take note of a message; return whether its key is announced, and not carried."""
        key = self._keys.get(name)
        if key is None:
            return False
        key.heard = now
        return isinstance(key.what, str)

    def report(self, now: float) -> Absence:
        """Return what is not carried, and what is silent while other topics of its node arrive."""
        keys = self._keys.values()
        sending = {node for key in keys if now - key.heard < _SENDS for node in key.nodes.values()}
        silent = {str(key.what) for key in keys if key.is_silent(now) and sending.intersection(key.nodes.values())}
        not_carried = {key.what for key in keys if isinstance(key.what, str) and key.what}
        return Absence(tuple(sorted(not_carried)[:_MAX_NAMES]), tuple(sorted(silent)[:_MAX_NAMES]))
