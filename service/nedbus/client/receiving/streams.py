"""Streams: the keys of a subscription, of which the least recently active are evicted; no I/O."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from heapq import heappop, heappush, heapreplace

from nedbus import limits

from .arrival import Stream


class Streams:
    """The state of each key.

    `open_stream`: returns the state of a new key, or raises AddressError. `on_evict`: called with an evicted state,
    and True if it was evicted because there were too many.
    """

    def __init__(
        self, open_stream: Callable[[str], Stream], on_evict: Callable[[Stream, bool], object]
    ) -> None:
        self._open_stream = open_stream
        self._on_evict = on_evict
        self._streams: dict[str, Stream] = {}
        # heap: each key, with a time at which it was active
        self._by_activity: list[tuple[float, str]] = []
        self.get = self._streams.get
        # keys for the receiver to declare to Zenoh
        self.opened: deque[str] = deque(maxlen=limits.KEYS)
        self.evicted: deque[str] = deque(maxlen=limits.KEYS)

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
        """Evict silent keys above KEPT_KEYS, and the least recently active at KEYS; keys with requests are last."""
        order = self._by_activity
        while len(order) >= limits.KEYS or (
            len(order) >= limits.KEPT_KEYS and order[0][0] < now - limits.KEY_SILENCE
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
            self._on_evict(stream, since >= now - limits.KEY_SILENCE)
