"""What was sent while the link was broken, by publishers that a subscription hears for the first time.

Zenoh recovers what is missing since the last message of a publisher; of one that it has not heard before it takes the
first message that comes, as a late reader wants it. A reader whose link broke is no late reader: it was stopped before
the first message, perhaps, and gets what the publisher still keeps from before.
"""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.errors import NedbusError
from nedbus.transport import RawSample, Session, entity_name, query_kept, while_open

from .receive_queue import ReceiveQueue

_PERIOD: Final = (
    10.0  # s after a link broke or came back in which publishers are looked at: heartbeats come twice a second
)
_TIMEOUT: Final = 2.0  # s for a publisher to send what it keeps


class CatchUp:
    """Follow the links of a session for one queue of mode `every`, and complete what arrives after a break."""

    def __init__(self, session: Session, receive_queue: ReceiveQueue) -> None:
        self._session = session
        self._queue = receive_queue
        with while_open():
            self._listener = session.info.declare_transport_events_listener(
                zenoh.handlers.Callback(self._on_link, indirect=False), history=False
            )

    def complete(self, batch: list[RawSample]) -> list[RawSample]:
        """Return a batch with, before the first message of a publisher that is new, what it has kept; it may wait."""
        if time.monotonic() >= self._queue.unsettled_until:
            return batch
        complete: list[RawSample] = []
        seen: set[str] = set()  # publishers of this batch, which the queue does not know before it has the batch
        for sample in batch:
            info = sample.source_info
            publisher = entity_name(info.source_id) if info is not None else ""
            if info is not None and publisher not in seen:
                seen.add(publisher)
                if info.source_sn and not self._queue.knows(publisher):
                    with suppress(NedbusError):  # closed meanwhile
                        key = str(sample.key_expr)
                        complete += query_kept(self._session, key, publisher, end=info.source_sn, timeout=_TIMEOUT)
            complete.append(sample)
        return complete

    def close(self) -> None:
        """Follow the links no more."""
        self._listener.undeclare()

    def _on_link(self, _: zenoh.TransportEvent) -> None:
        self._queue.unsettled_until = time.monotonic() + _PERIOD
