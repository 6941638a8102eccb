"""A subscription with a maximum rate: downsampled streams, and at full rate those whose publishers do not downsample.

A stream from which nothing downsampled has come for 3 s (its publisher cannot, or access rules forbid it) is read at
full rate by its exact key, and downsampled here, until something downsampled comes. Such a stream has no account: what
is missing of it is neither lost nor recovered.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import zenoh

from nedbus.client.housekeeping import Housekeeping
from nedbus.client.protocol import LIVE
from nedbus.client.rate_gate import RateGate, check_max_rate, rate_step
from nedbus.client.sample import Mode
from nedbus.errors import NedbusError
from nedbus.log_event import about
from nedbus.transport import AliveTokens, RawSample, Session, ask, while_open
from nedbus_msgs import ANY, AddressError, Selection, address_of_alive_key

from .decoder import MAX_KEYS, Arrival, Decoder
from .pending_queue import PendingQueue
from .receiver import Receiver, drain

_log = logging.getLogger(__name__)

DOWNSAMPLED_TIMEOUT: Final = 3.0
"""Seconds from the liveliness token of a stream on, after which it is read at full rate."""

_TIMEOUT: Final = 2.0  # s for the last messages, and for all liveliness tokens
_FULL_RATE_POLL: Final = 0.02  # s between two looks at streams that are read at full rate
_FULL_RATE_RING: Final = 4096  # samples of one of these that may arrive until then
_OVERTAKEN: Final = 2_000_000_000  # ns by which a downsampled message is older than one at full rate that overtook it


@dataclass(slots=True, eq=False)
class _StreamRate:
    """State of one stream. `full_rate_sent`: when the last message that passed at full rate was sent [ns]."""

    gate: RateGate
    alive_since: float = math.inf  # s
    is_downsampled: bool = False  # by its publisher
    full_rate_sent: float = -math.inf


class MaxRateQueue(PendingQueue):
    """Queue at most `max_rate` messages a second of each stream; raise ConfigError if that is no number above 0.

    What is left out counts neither as lost nor as dropped.
    """

    def __init__(self, mode: Mode, decoder: Decoder, *, max_rate: float, name: str = "") -> None:
        super().__init__(mode, decoder, name=name)
        check_max_rate(max_rate)
        self.rate = rate_step(max_rate)  # requested of publishers
        self._max_rate = max_rate
        self._rates: dict[str, _StreamRate] = {}  # by key

    def put_full_rate(self, batch: Sequence[RawSample]) -> None:
        """Queue messages of streams that do not come downsampled, as far as they are due."""
        arrivals = self._decoder.admit(batch)
        now = time.monotonic_ns()
        with self._lock:
            for arrival in arrivals:
                rate = self._rate(arrival[0].key)
                if arrival[1] and not rate.is_downsampled and rate.gate.passes(now):
                    rate.full_rate_sent = _sent(arrival)
                    super()._queue([arrival])
        self.wake()

    def on_token(self, key: str, now: float, *, alive: bool) -> None:
        """Note that a stream has a publisher, or forget it: the next one may downsample, or not."""
        if not alive:
            self._rates.pop(key, None)
        elif (rate := self._rate(key)).alive_since > now:
            rate.alive_since = now

    def full_rate_keys(self, now: float) -> set[str]:
        """Return the keys of streams to be read at full rate: alive for a while, and not downsampled."""
        known = list(self._rates.items())  # at once: another thread adds to them
        return {key for key, each in known if not each.is_downsampled and now - each.alive_since >= DOWNSAMPLED_TIMEOUT}

    def _queue(self, arrivals: Sequence[Arrival]) -> None:
        super()._queue([arrival for arrival in arrivals if self._passes(arrival)])

    def _passes(self, arrival: Arrival) -> bool:
        """Return whether a downsampled message passes; one at full rate, such as the last one, may be newer."""
        rate = self._rate(arrival[0].key)
        rate.is_downsampled = True
        passes = not 0 <= rate.full_rate_sent - _sent(arrival) <= _OVERTAKEN
        if self.rate > self._max_rate:  # below the least rate of publishers
            passes = passes and rate.gate.passes(time.monotonic_ns())
        if not passes:
            arrival[0].unreported += arrival[3]
        return passes

    def _rate(self, key: str) -> _StreamRate:
        known = self._rates.get(key) or _StreamRate(RateGate(self._max_rate))
        return self._rates.setdefault(key, known) if len(self._rates) < MAX_KEYS else known


class MaxRateReceiver(Receiver):
    """Put what arrives into a MaxRateQueue until it is closed."""

    def __init__(
        self, session: Session, selection: Selection, queue: MaxRateQueue, *, prefix: str, housekeeping: Housekeeping
    ) -> None:
        self._prefix, self._rate_queue, self._warned = prefix, queue, False
        self._full_rate: dict[str, zenoh.Subscriber[zenoh.Handler[zenoh.Sample]]] = {}
        self._key_expr = selection.key_expr(prefix=prefix)
        self._tokens = AliveTokens(session, selection.alive_key_expr(prefix=prefix))
        self._last = ask(session, self._key_expr, timeout=_TIMEOUT)  # downsampling begins with the next message
        rate_key_expr = selection.rate_key_expr(queue.rate, prefix=prefix)
        super().__init__(session, rate_key_expr, queue, housekeeping=housekeeping, downsampled=True)

    def _keep_house(self, now: float) -> float:
        pause = super()._keep_house(now)
        with suppress(NedbusError, zenoh.ZError):  # the session is closed
            found = [reply.ok for reply in self._last.take() if reply.ok is not None]
            # Without those of a storage: their vehicles are gone.
            if live := [raw for raw in found if raw.attachment is not None and raw.attachment.to_bytes() == LIVE]:
                self._rate_queue.put_full_rate(live)
            self._follow_tokens(now)
            self._read_full_rate(self._rate_queue.full_rate_keys(now))
        return min(pause, _FULL_RATE_POLL) if self._full_rate or not self._last.ended else pause

    def _follow_tokens(self, now: float) -> None:
        for token, alive in self._tokens.take(timeout=_TIMEOUT):
            with suppress(AddressError):  # not one of nedbus
                key = address_of_alive_key(token, prefix=self._prefix).key(prefix=self._prefix)
                self._rate_queue.on_token(key, now, alive=alive)
        if ANY not in self._key_expr:  # one stream: perhaps of a plain Zenoh publisher, which has no token
            self._rate_queue.on_token(self._key_expr, now, alive=True)

    def _read_full_rate(self, keys: set[str]) -> None:
        for key in self._full_rate.keys() - keys:
            self._full_rate.pop(key).undeclare()
        for key in keys - self._full_rate.keys():
            ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_FULL_RATE_RING)
            with while_open():
                self._full_rate[key] = self._session.declare_subscriber(key, ring)
        for key, subscriber in self._full_rate.items():
            if batch := drain(subscriber.handler, []):
                self._rate_queue.put_full_rate(batch)
                if not self._warned:
                    self._warned = True
                    text = "%s: its publisher does not downsample (it cannot, or access rules): read at full rate"
                    _log.warning(text, key, extra=about("unsupported"))

    def _undeclare(self) -> None:
        with suppress(zenoh.ZError):  # closed already with the session
            self._tokens.undeclare()
            self._read_full_rate(set())
        super()._undeclare()


def _sent(arrival: Arrival) -> float:
    """Return when a message was sent [ns]; infinity without a timestamp."""
    stamp = arrival[2].timestamp
    return math.inf if stamp is None else stamp.get_time_as_ntp64().as_nanos()
