"""Acknowledgements: a publisher asks the readers of mode `every` whether they have what was published.

Each of them answers a query on `<key>/@ack` in its turn, after all that was sent before it.
"""

from __future__ import annotations

import time

import zenoh

from nedbus.transport import Session, ask_all, while_open
from nedbus_msgs import ack_key


class Acknowledgement:
    """Wait for the readers of one key, which `publisher` publishes with this priority."""

    def __init__(
        self, session: Session, key: str, publisher: zenoh.ext.AdvancedPublisher, *, priority: zenoh.Priority
    ) -> None:
        self._session = session
        self._key = key
        self._publisher = publisher
        self._priority = priority

    def wait(self, published: int, *, timeout: float) -> bool:
        """Wait until all readers have `published` messages; return False if one has not within `timeout` seconds.

        Raises ClosedError once the session is closed.
        """
        end = time.monotonic() + timeout
        if not self._ask(end):
            return False
        self._send_last_number(published)
        # The first answer comes when a reader has asked for what it misses, the second when it has it.
        return self._ask(end) and self._ask(end)

    def _ask(self, end: float) -> bool:
        left = end - time.monotonic()
        return ask_all(self._session, ack_key(self._key), timeout=left, priority=self._priority)

    def _send_last_number(self, published: int) -> None:
        """Send one heartbeat of Zenoh's advanced publishers by hand: the sequence number of the last message."""
        if published:
            publisher = self._publisher.id
            number = zenoh.ext.z_serialize(zenoh.ext.UInt32((published - 1) % 2**32))
            with while_open(self._session):
                self._session.put(f"{self._key}/@adv/pub/{publisher.zid}/{publisher.eid}/_", number)
