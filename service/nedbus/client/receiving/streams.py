"""Streams: the keys of a subscription, of which the least recently active are evicted; no I/O."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from heapq import heappop, heappush, heapreplace
from typing import Final

from .arrival import Stream

MAX_KEYS: Final = 10_000
"""Keys tracked by a reader, to bound its memory; beyond that the least recently active are evicted and counted."""

MAX_SILENCE: Final = 600.0
"""Seconds without a message or heartbeat after which a key is evicted, if there are more than KEPT_KEYS."""

KEPT_KEYS: Final = 1_000
"""Keys kept however long they are silent, to count the losses of a long outage."""


class Streams:
    """The state of each key.

    `open_stream`: returns the state of a new key, or raises AddressError. `on_evict`: called with an evicted state,
    and True if it was evicted because of MAX_KEYS.
    """

    def __init__(
        self, open_stream: Callable[[str], Stream], on_evict: Callable[[Stream, bool], object]
    ) -> None:
        self._open_stream, self._on_evict = open_stream, on_evict
        self._streams: dict[str, Stream] = {}
        # heap: each key, with a time at which it was active
        self._by_activity: list[tuple[float, str]] = []
        self.get = self._streams.get
        # keys for the receiver to declare to Zenoh
        self.opened: deque[str] = deque(maxlen=MAX_KEYS)
        self.evicted: deque[str] = deque(maxlen=MAX_KEYS)

    def __iter__(self) -> Iterator[Stream]:
        return iter(self._streams.values())

    def open(self, key: str, now: float) -> Stream:
        """Return the state of a key, a new one if needed; raise AddressError if the key has no address."""
        stream = self._streams.get(key)
        if stream is None:
            stream = self._open_stream(key)
            stream.last_active = now
            self._evict(now)
            self._streams[key] = stream
            heappush(self._by_activity, (now, key))
            self.opened.append(key)
        return stream

    def _evict(self, now: float) -> None:
        """Evict silent keys above KEPT_KEYS, and the least recently active at MAX_KEYS; keys with requests are last."""
        order = self._by_activity
        while len(order) >= MAX_KEYS or (
            len(order) >= KEPT_KEYS and order[0][0] < now - MAX_SILENCE
        ):
            since, key = order[0]
            stream = self._streams[key]
            if any(writer.request for writer in stream.writers.values()):
                stream.last_active = now
            if since < stream.last_active:
                heapreplace(order, (stream.last_active, key))
                continue
            heappop(order)
            del self._streams[key]
            self.evicted.append(key)
            self._on_evict(stream, since >= now - MAX_SILENCE)
