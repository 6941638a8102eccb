"""Whether anybody subscribes to a key expression, without publishing anything on it."""

from __future__ import annotations

import threading
from contextlib import suppress

import zenoh

from nedbus.transport import Session, while_open


class Demand:
    """Follow whether anybody subscribes to a key expression.

    It costs one declaration, a publisher that publishes nothing, and a message whenever who subscribes changes.
    """

    def __init__(self, session: Session, key_expr: str) -> None:
        channel: zenoh.handlers.RingChannel[zenoh.MatchingStatus] = zenoh.handlers.RingChannel(1)
        with while_open():
            self._probe = session.declare_publisher(key_expr)
            self._listener = self._probe.declare_matching_listener(channel)  # begins with how it is now
        self._wanted = False
        self._taking = threading.Lock()  # all publishers of a vehicle share one
        self._take = self._listener.handler.try_recv

    def is_wanted(self) -> bool:
        """Return whether anybody subscribes, as far as Zenoh has told."""
        with self._taking, suppress(zenoh.ZError):  # closed
            while (status := self._take()) is not None:
                self._wanted = status.matching
        return self._wanted

    def close(self) -> None:
        """Follow it no more."""
        with suppress(zenoh.ZError):  # closed already with the session
            self._listener.undeclare()
            self._probe.undeclare()
