"""The link of a session to its router, with callbacks for its changes."""

from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from functools import partial
from itertools import islice

import zenoh

from nedbus import limits
from nedbus.transport import Session, translate_zenoh_errors

from .io_thread import TICK, CallThread, Job

_calls = CallThread("nedbus-callbacks")


class LinkCallback(AbstractContextManager["LinkCallback"]):
    """A function that is called when the link to the router is lost or restored; `bus.on_link` returns one.

    It need not be kept: without `close`, the calls end with the bus.
    """

    def __init__(self, watch: "LinkWatch", call: Callable[[bool], object], *, is_up: bool) -> None:
        self._watch = watch
        self._call = call
        self._is_up = is_up
        self._closed = False

    def close(self) -> None:
        """End the calls; one that is running returns. A second call does nothing."""
        self._closed = True
        self._watch.callbacks.discard(self)

    def __exit__(self, *exc: object) -> None:
        self.close()

    def on_state(self, is_up: bool) -> None:
        """Schedule the call if the state of the link has changed; called by the poll of the link."""
        if is_up != self._is_up:
            self._is_up = is_up
            _calls.put(partial(self._run, is_up))

    def _run(self, is_up: bool) -> None:
        if not self._closed:
            self._call(is_up)


class LinkWatch:
    """Poll the link of a session, and call functions on a separate thread whenever it is lost or restored."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self.callbacks: set[LinkCallback] = set()  # changed by single atomic calls
        with translate_zenoh_errors():
            changes: zenoh.handlers.RingChannel[zenoh.TransportEvent] = zenoh.handlers.RingChannel(
                limits.LINK_CHANGES
            )
            self._listener = session.info.declare_transport_events_listener(changes, history=False)
        _calls.start()
        self._job = Job(self._poll)

    def add(self, call: Callable[[bool], object]) -> LinkCallback:
        """Call a function whenever the state of the link changes, from that of now."""
        callback = LinkCallback(self, call, is_up=bool(self._session.info.routers_zid()))
        self.callbacks.add(callback)
        return callback

    def close(self) -> None:
        """End the calls."""
        self._job.end()
        with suppress(zenoh.ZError):  # the session is already closed
            self._listener.undeclare()

    def _poll(self, _: float) -> float:
        with suppress(zenoh.ZError):  # undeclared
            for event in islice(iter(self._listener.handler.try_recv, None), limits.LINK_CHANGES):
                for callback in tuple(self.callbacks):
                    callback.on_state(event.kind == zenoh.SampleKind.PUT)
        return TICK
