"""Whether anybody subscribes to a key expression, without publishing anything on it."""

from __future__ import annotations

from contextlib import suppress

import zenoh

from nedbus.transport import Session, while_open


class Demand:
    """Follow whether anybody subscribes to a key expression; `wanted` is set on a thread of Zenoh's.

    It costs one declaration, a publisher that publishes nothing, and a message whenever who subscribes changes.
    """

    def __init__(self, session: Session, key_expr: str) -> None:
        self.wanted = False
        with while_open():
            self._probe = session.declare_publisher(key_expr)
            # It calls at once if somebody does already.
            self._listener = self._probe.declare_matching_listener(
                zenoh.handlers.Callback(self._on_status, indirect=False)
            )

    def close(self) -> None:
        """Follow it no more."""
        with suppress(zenoh.ZError):  # closed already with the session
            self._listener.undeclare()
            self._probe.undeclare()

    def _on_status(self, status: zenoh.MatchingStatus) -> None:
        self.wanted = status.matching
