"""Which streams nobody sends thinned, so that they have to be read whole. Pure, with the caller's clock."""

from __future__ import annotations

from collections.abc import Set
from typing import Final

from .decoder import MAX_KEYS

PATIENCE: Final = 3.0
"""Seconds that a publisher has to send something thinned, from its liveliness token on."""


class Unthinned:
    """Follow the streams that are alive, by key; at most 10,000 of them.

    `always` is a stream that is waited for without a token as well: of a plain Zenoh publisher.
    """

    def __init__(self, now: float, *, always: str | None = None) -> None:
        self._always = always
        self._since: dict[str, float] = {} if always is None else {always: now}

    def appeared(self, key: str, now: float) -> None:
        """Note that a stream has a publisher."""
        if len(self._since) < MAX_KEYS:
            self._since.setdefault(key, now)

    def gone(self, key: str, now: float) -> None:
        """Note that the publisher of a stream is gone; another one may know less, or more."""
        self._since.pop(key, None)
        if key == self._always:
            self._since[key] = now

    def needed(self, heard: Set[str], now: float) -> set[str]:
        """Return which streams are to be read whole now: alive for a while, and not among those heard thinned."""
        return {key for key, since in self._since.copy().items() if key not in heard and now - since >= PATIENCE}
