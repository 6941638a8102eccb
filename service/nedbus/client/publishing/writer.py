"""A writer: one advanced publisher of Zenoh's, with its history cache, its sequence numbers and its heartbeats."""

from __future__ import annotations

from contextlib import suppress

import zenoh
from zenoh import Priority

from nedbus.errors import ClosedError
from nedbus.transport import entity_name, while_open

from .heartbeats import Heartbeats


class Writer:
    """Put payloads on one key; `cache` messages are kept for readers that missed some."""

    def __init__(
        self, heartbeats: Heartbeats, key: str, *, priority: Priority, cache: int, encoding: str | None = None
    ) -> None:
        self.session, self.key, self.priority, self.published = heartbeats.session, key, priority, 0
        self._heartbeats = heartbeats
        with while_open():
            # Joined routers look up the way of each message anew, unless something is declared on its very key.
            self._token = self.session.liveliness().declare_token(key)
            self._publisher: zenoh.ext.AdvancedPublisher | None = zenoh.ext.declare_advanced_publisher(
                self.session,
                key,
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=priority,
                cache=zenoh.ext.CacheConfig(cache),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
            )
            self.name = entity_name(self._publisher.id)
            heartbeats.add(self)

    def put(self, payload: bytes, stamp: zenoh.Timestamp, encoding: str | None = None) -> None:
        """Put a payload, with an encoding in place of the writer's if one is given; never wait for a reader."""
        if self._publisher is None:
            raise ClosedError
        self._publisher.put(payload, timestamp=stamp, encoding=encoding)
        self.published += 1

    @property
    def closed(self) -> bool:
        """Whether nothing can be put any more."""
        return self._publisher is None

    def close(self) -> None:
        """Withdraw the key and the cache; a second call does nothing."""
        self._heartbeats.remove(self)
        # Dropped, as nothing else refers to it: undeclare() would wait for Zenoh while it holds the interpreter's lock.
        self._publisher = None
        with suppress(zenoh.ZError):  # closed already with the session
            self._token.undeclare()
