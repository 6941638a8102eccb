"""KeyReader: wait for the newest sample of one key, with less processor time than a subscription of the client API.

It neither orders samples nor recovers lost ones, and starts without the last message of the publisher.
"""

from contextlib import suppress
from typing import Final

import zenoh

from nedbus.errors import ClosedError

from .session import RawSample, Session, translate_zenoh_errors

_RING_CAPACITY: Final = 16_384  # samples that wait while the reader is busy; beyond them the oldest are lost


class KeyReader:
    """The samples of one key on a session, which stays open. `receive` is for one thread, `close` for any.

    `superseded`: samples that were left out, because a newer one had arrived before the reader was ready.
    """

    def __init__(self, session: Session, key: str) -> None:
        self.superseded = 0
        ring: zenoh.handlers.RingChannel[RawSample] = zenoh.handlers.RingChannel(_RING_CAPACITY)
        with translate_zenoh_errors():
            self._subscriber = session.declare_subscriber(key, ring)
        self._handler = self._subscriber.handler  # a receive on the subscriber would prevent undeclaring it

    def receive(self) -> RawSample:
        """Wait for a sample and return the newest one; raise ClosedError once the reader or its session is closed."""
        try:
            newest = self._handler.recv()
            while (newer := self._handler.try_recv()) is not None:
                newest = newer
                self.superseded += 1
        except zenoh.ZError as exc:
            raise ClosedError from exc
        return newest

    def close(self) -> None:
        """End reception, also of a `receive` that waits; a second call does nothing."""
        with suppress(zenoh.ZError):  # the session may be closed already
            self._subscriber.undeclare()
