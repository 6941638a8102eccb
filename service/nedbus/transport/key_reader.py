"""KeyReader: wait for the newest sample of one key, with less processor time than a subscription of the client API.

It neither orders samples nor recovers lost ones, and starts without the last message of the publisher.
"""

from contextlib import suppress
from typing import Final

import zenoh

from nedbus.errors import ClosedError

from .session import RawSample, Session, entity_name, translate_zenoh_errors

# samples that wait while the reader is busy; beyond them the oldest are overwritten
_RING_CAPACITY: Final = 16_384


class KeyReader:
    """The samples of one key on a session, which stays open. `receive` is for one thread, `close` for any.

    `superseded`: samples that were left out, because a newer one had arrived before the reader was ready. Those that
    the ring has overwritten are counted by the numbers of their publisher.
    """

    def __init__(self, session: Session, key: str) -> None:
        self.superseded = 0
        self._last: RawSample | None = None
        ring: zenoh.handlers.RingChannel[RawSample] = zenoh.handlers.RingChannel(_RING_CAPACITY)
        with translate_zenoh_errors():
            self._subscriber = session.declare_subscriber(key, ring)
        # a receive on the subscriber would prevent undeclaring it
        self._handler = self._subscriber.handler

    def receive(self) -> RawSample:
        """Wait for a sample and return the newest one; raise ClosedError once the reader or its session is closed."""
        try:
            newest = self._handler.recv()
            received = 1
            while (newer := self._handler.try_recv()) is not None:
                newest = newer
                received += 1
        except zenoh.ZError as exc:
            raise ClosedError from exc
        self.superseded += received - 1
        if received >= _RING_CAPACITY:
            self.superseded += _numbers_between(self._last, newest, received=received)
        self._last = newest
        return newest

    def close(self) -> None:
        """End reception, also of a `receive` that waits; a second call does nothing."""
        with suppress(zenoh.ZError):  # the session may be closed already
            self._subscriber.undeclare()


def _numbers_between(last: RawSample | None, newest: RawSample, *, received: int) -> int:
    """Return how many samples of a publisher are missing after its last one, beside those received; 0 if unknown."""
    if last is None or last.source_info is None or newest.source_info is None:
        return 0
    if entity_name(last.source_info.source_id) != entity_name(newest.source_info.source_id):
        return 0
    return max(0, newest.source_info.source_sn - last.source_info.source_sn - received)
