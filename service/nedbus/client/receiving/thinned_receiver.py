"""Zenoh's side of a subscription with a maximum rate: thinned streams, and where publishers do not thin, whole ones."""

from __future__ import annotations

import logging
import time
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.client.housekeeping import Housekeeping
from nedbus.client.protocol import LIVE
from nedbus.errors import NedbusError
from nedbus.log_event import about
from nedbus.transport import AliveChanges, Answers, Session, ask, ask_alive, follow_heartbeats, while_open
from nedbus_msgs import ANY, AddressError, Selection, address_of_alive_key

from .receiver import Receiver, take_all
from .thinned_queue import ThinnedQueue

_log = logging.getLogger(__name__)

_TIMEOUT: Final = 2.0  # s for the last messages, and the liveliness tokens
_DRAIN: Final = 0.02  # s until what came of whole streams is thinned and queued
_RING: Final = 4096  # samples of one whole stream that may arrive until then
_UNTHINNED: Final = "%s: nobody sends it thinned (a publisher that cannot, or access rules): it is thinned here"


class ThinnedReceiver(Receiver):
    """Put what arrives into a ThinnedQueue until it is closed, and read whole the streams that nobody thins."""

    def __init__(
        self, session: Session, selection: Selection, queue: ThinnedQueue, *, prefix: str, housekeeping: Housekeeping
    ) -> None:
        self._prefix, self._thinned_queue, self._warned = prefix, queue, False
        self._wholes: dict[str, zenoh.ext.AdvancedSubscriber[zenoh.Handler[zenoh.Sample]]] = {}
        self._key_expr = selection.key_expr(prefix=prefix)
        self._alive_key = selection.alive_key_expr(prefix=prefix)
        self._changes = AliveChanges(session, self._alive_key)
        self._tokens: Answers | None = None  # all, if more changed than are kept
        self._last = ask(session, self._key_expr, timeout=_TIMEOUT)  # as what is thinned begins with the next message
        rate_key_expr = selection.rate_key_expr(queue.rate, prefix=prefix)
        super().__init__(session, rate_key_expr, queue, housekeeping=housekeeping, thinned=True)

    def _keep_house(self, now: float) -> float:
        pause = super()._keep_house(now)
        with suppress(NedbusError, zenoh.ZError):  # the session is closed
            self._queue_last()
            self._follow_tokens(now)
            self._read_whole(self._thinned_queue.unthinned(now))
        return min(pause, _DRAIN) if self._wholes or not self._last.ended else pause

    def _queue_last(self) -> None:
        """Queue the last messages of publishers, without those of a storage: their vehicles are gone."""
        found = [reply.ok for reply in self._last.take() if reply.ok is not None]
        if live := [raw for raw in found if raw.attachment is not None and raw.attachment.to_bytes() == LIVE]:
            self._thinned_queue.put_last(live)

    def _follow_tokens(self, now: float) -> None:
        if self._changes.missed and (self._tokens is None or self._tokens.ended):
            self._changes.missed = False
            self._tokens = ask_alive(self._session, self._alive_key, timeout=_TIMEOUT)
        answers = [] if self._tokens is None else self._tokens.take()
        known = [(str(reply.ok.key_expr), True) for reply in answers if reply.ok is not None]
        for token, alive in known + self._changes.take():
            with suppress(AddressError):  # not one of nedbus
                key = address_of_alive_key(token, prefix=self._prefix).key(prefix=self._prefix)
                self._thinned_queue.on_token(key, now, alive=alive)
        if ANY not in self._key_expr:  # one stream: perhaps of a plain Zenoh publisher, which has no token
            self._thinned_queue.on_token(self._key_expr, now, alive=True)

    def _read_whole(self, keys: set[str]) -> None:
        for key in self._wholes.keys() - keys:
            self._wholes.pop(key).undeclare()
            if key in self._heartbeats:
                _, undeclare = self._heartbeats.pop(key)
                undeclare()
        for key in keys - self._wholes.keys():
            ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_RING)
            with while_open():
                self._wholes[key] = zenoh.ext.declare_advanced_subscriber(self._session, key, ring)
            if not self._queue.newest_only:
                self._heartbeats[key] = follow_heartbeats(self._session, key)
        for key, whole in self._wholes.items():
            if batch := take_all(whole.handler, []):
                self._put(batch, full=_RING)
                if not self._warned and key in self._thinned_queue.unthinned(time.monotonic()):
                    self._warned = True
                    _log.warning(_UNTHINNED, key, extra=about("unsupported"))

    def _undeclare(self) -> None:
        with suppress(zenoh.ZError):  # closed already with the session
            self._changes.undeclare()
            self._read_whole(set())
        super()._undeclare()
