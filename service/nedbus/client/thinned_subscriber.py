"""Zenoh's side of a subscription with a maximum rate: the thinned streams, and what is not there as such.

The last message of each stream is queried once, as a thinned stream begins with the next message that is due.
A stream that nobody thins is read whole, and thinned here: its publisher is a plain Zenoh publisher or an older nedbus,
or the access rules of a router stop what is thinned.
"""

from __future__ import annotations

import logging
import threading
import time
from contextlib import ExitStack, suppress
from typing import Final

import zenoh

from nedbus.errors import NedbusError
from nedbus.log_event import about
from nedbus.transport import AliveChanges, Session, alive_keys, query, while_open
from nedbus_msgs import ANY, AddressError, Selection, address_of_alive_key, get_topic

from .channels import declare_reader, take_all
from .publishing.publisher_registry import LIVE
from .recovery import Recovery
from .thinned_queue import ThinnedQueue
from .unthinned import Unthinned
from .zenoh_subscriber import ZenohSubscriber

_log = logging.getLogger(__name__)

_TIMEOUT: Final = 2.0  # s for the last messages, and the liveliness tokens
_LOOK: Final = 0.25  # s until it is looked again which streams have to be read whole
_DRAIN: Final = 0.02  # s until what came of whole streams is thinned and queued
_CHANNEL: Final = 4096  # samples of one whole stream that may arrive until then


class ThinnedSubscriber(ZenohSubscriber):
    """Put what arrives into a ThinnedQueue until it is closed; a thread looks after the streams that nobody thins."""

    def __init__(self, session: Session, selection: Selection, queue: ThinnedQueue, *, prefix: str) -> None:
        key_expr = selection.rate_key_expr(queue.rate, prefix=prefix)
        super().__init__(session, key_expr, queue, thinned=True)
        self._session = session
        self._prefix = prefix
        self._selection = selection
        self._thinned_queue = queue
        self._unthinned = Unthinned(time.monotonic(), always=_only_key(selection, prefix))
        self._wholes: dict[str, _WholeStream] = {}
        self._warned = False
        self._ended = threading.Event()
        self._watch = threading.Thread(target=self._follow_unthinned, name="nedbus-unthinned", daemon=True)
        self._watch.start()

    def wait(self, timeout: float | None) -> bool:
        """Wait until there may be something in the queue; return False after `timeout` seconds.

        The reader never waits for the channel itself, as not all comes through it.
        """
        self._by_reader = False
        self._needed.set()
        return self._queue.wait(timeout)

    def close(self) -> None:
        """End the subscription; a second call does nothing."""
        self._ended.set()
        super().close()
        self._watch.join(1.0)

    def _follow_unthinned(self) -> None:
        with ExitStack() as closing, suppress(NedbusError, zenoh.ZError):  # the session is closed
            closing.callback(self._close_wholes)
            self._queue_last()
            alive = self._selection.alive_key_expr(prefix=self._prefix)
            changes = AliveChanges(self._session, alive)
            closing.callback(changes.close)
            known = False
            while True:
                if not known:
                    for key in alive_keys(self._session, alive, timeout=_TIMEOUT):
                        self._change(key, alive=True)
                for key, is_alive in changes.take():
                    self._change(key, alive=is_alive)
                known = not changes.missed
                self._look()
                if self._ended.wait(_DRAIN if self._wholes else _LOOK):
                    break

    def _queue_last(self) -> None:
        """Queue the last messages of publishers, without those of a storage: their vehicles are gone."""
        last = query(self._session, self._selection.key_expr(prefix=self._prefix), timeout=_TIMEOUT)
        live = [raw for raw in last if raw.attachment is not None and raw.attachment.to_bytes() == LIVE]
        self._thinned_queue.put_last(live)
        self._queue.wakeups.wake()

    def _change(self, key: str, *, alive: bool) -> None:
        """Note a liveliness token."""
        try:
            address = address_of_alive_key(key, prefix=self._prefix)
        except AddressError:
            return  # not one of nedbus
        stream = address.key(prefix=self._prefix)
        if alive:
            self._unthinned.appeared(stream, time.monotonic())
        else:
            self._thinned_queue.heard.discard(stream)
            self._unthinned.gone(stream, time.monotonic())

    def _look(self) -> None:
        needed = self._unthinned.needed(self._thinned_queue.heard, time.monotonic())
        for key in self._wholes.keys() - needed:
            self._wholes.pop(key).close()
        for key in needed - self._wholes.keys():
            self._wholes[key] = _WholeStream(self._session, key, self._thinned_queue, self._recovery)
        for key, whole in self._wholes.items():
            batch = whole.take()
            if batch:
                self._put(batch, full=_CHANNEL)
                self._queue.wakeups.wake()
                self._warn_once(key)

    def _warn_once(self, key: str) -> None:
        if self._warned or key in self._thinned_queue.heard:
            return
        self._warned = True
        text = (
            "%s: nobody sends it thinned (a publisher that cannot, or access rules): it is read whole and thinned here"
        )
        _log.warning(text, key, extra=about("unsupported"))

    def _close_wholes(self) -> None:
        for whole in self._wholes.values():
            with suppress(zenoh.ZError):  # closed already with the session
                whole.close()
        self._wholes.clear()


class _WholeStream:
    """A stream that nobody thins; a ring, so that Zenoh never waits for it."""

    def __init__(self, session: Session, key: str, queue: ThinnedQueue, recovery: Recovery | None) -> None:
        channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_CHANNEL)
        with while_open():
            self._subscriber, self._misses = declare_reader(session, key, channel)
        self._thinned_queue = queue
        self._unwatch = recovery.watch(key) if recovery is not None else None

    def take(self) -> list[zenoh.Sample]:
        """Return what has arrived."""
        batch = take_all(self._subscriber.handler, [])
        self._misses.announce(self._thinned_queue)
        return batch

    def close(self) -> None:
        if self._unwatch is not None:
            self._unwatch()
        self._misses.undeclare()
        self._subscriber.undeclare()


def _only_key(selection: Selection, prefix: str) -> str | None:
    """Return the key of the one stream that is selected, None for a selection of several."""
    any_instance = selection.topic != ANY and get_topic(selection.topic).instances and selection.instance is None
    if ANY in (selection.vehicle, selection.topic) or any_instance:
        return None
    return selection.key_expr(prefix=prefix)
