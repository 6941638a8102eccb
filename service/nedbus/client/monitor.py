"""The health of all streams of a subscription; no I/O."""

from __future__ import annotations

import time
from operator import itemgetter
from typing import Final

from nedbus_msgs import Address, Message

from .health import Health, StreamHealth
from .histogram import Histogram
from .sample import Sample

_MAX_STREAMS: Final = 4096  # that a monitor follows


class Monitor:
    """Follow all streams of a subscription, at most 4096: then the one that was silent for longest is forgotten.

    The first sample of each address does not count: it may be the last value that a subscription starts with.
    """

    def __init__(self) -> None:
        self._streams: dict[Address, StreamHealth | None] = {}  # the one that was silent for longest comes first

    def add(self, sample: Sample[Message], *, received: int | None = None) -> bool:
        """Add a sample that was received just now, or at this time [ns] of another clock; return whether it counts."""
        address = sample.address
        known = address in self._streams
        stream = self._streams.pop(address, None)
        if known:
            stream = stream or StreamHealth(sample.topic)
            now = time.monotonic_ns() if received is None else received
            stream.add(sample.message, received=now, latency=sample.latency, lost=sample.lost)
        elif len(self._streams) >= _MAX_STREAMS:
            del self._streams[next(iter(self._streams))]
        self._streams[address] = stream
        return known

    def snapshot(self, now: int | None = None) -> dict[Address, Health]:
        """Return the health of each stream, sorted by address, now or at this time [ns] of the other clock."""
        streams = sorted(self._streams.items(), key=itemgetter(0))
        return {address: stream.snapshot(now) for address, stream in streams if stream is not None}

    def latencies(self, address: Address) -> Histogram | None:
        """Return the latencies of a stream since the start [s]."""
        stream = self._streams.get(address)
        return stream.latencies if stream is not None else None

    def forget(self, address: Address) -> None:
        """Forget a stream; it is followed anew if it comes back."""
        self._streams.pop(address, None)
