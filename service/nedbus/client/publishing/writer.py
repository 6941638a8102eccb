"""A writer: one advanced publisher of Zenoh's, with its history cache, its sequence numbers and its heartbeats."""

from __future__ import annotations

from contextlib import suppress
from typing import Final

import zenoh
from zenoh import Priority

from nedbus.errors import ClosedError
from nedbus.transport import entity_name, while_open

from .heartbeats import Heartbeats

NUMBERED: Final = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None)


class Writer:
    """Put payloads on one key; `cache` messages are kept for readers that missed some."""

    def __init__(
        self, heartbeats: Heartbeats, key: str, *, priority: Priority, cache: int, encoding: str | None = None
    ) -> None:
        self.session = session = heartbeats.session
        self.key = key
        self.priority = priority
        self.published = 0
        with while_open():
            # A router remembers where to send what comes on a key that it knows as such; of any other it finds out for
            # each message, which is most of what one costs where several routers are joined.
            self._token = session.liveliness().declare_token(key)
            publisher = zenoh.ext.declare_advanced_publisher(
                session,
                key,
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=priority,
                cache=zenoh.ext.CacheConfig(cache),
                sample_miss_detection=NUMBERED,
            )
            self._publisher: zenoh.ext.AdvancedPublisher | None = publisher
            self.name = entity_name(publisher.id)
            heartbeats.add(self)
        self._heartbeats = heartbeats

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
