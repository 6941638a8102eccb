"""The link of a session to its router, with a callback for its changes."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import islice
from typing import Final

import zenoh

from nedbus.transport import Session, translate_zenoh_errors

from .io_thread import TICK, CallThread, Job

MAX_LINK_CHANGES: Final = 64
"""Changes of a link between two polls of 0.1 s; beyond that the oldest are dropped."""

_calls = CallThread("nedbus-callbacks")


class LinkWatch:
    """Call a function on a separate thread whenever the link of a session is lost or restored."""

    def __init__(self, session: Session, call: Callable[[bool], object]) -> None:
        self._call, self._is_up = call, bool(session.info.routers_zid())
        with translate_zenoh_errors():
            changes: zenoh.handlers.RingChannel[zenoh.TransportEvent] = zenoh.handlers.RingChannel(MAX_LINK_CHANGES)
            self._listener = session.info.declare_transport_events_listener(changes, history=False)
        _calls.start()
        self._job = Job(self._poll)

    def close(self) -> None:
        """End the calls."""
        self._job.end()
        with suppress(zenoh.ZError):  # the session is already closed
            self._listener.undeclare()

    def _poll(self, _: float) -> float:
        with suppress(zenoh.ZError):  # undeclared
            for event in islice(iter(self._listener.handler.try_recv, None), MAX_LINK_CHANGES):
                is_up = event.kind == zenoh.SampleKind.PUT
                if is_up != self._is_up:
                    self._is_up = is_up
                    _calls.put(partial(self._call, is_up))
        return TICK
