"""Subscription with a maximum rate: last messages first, then the streams that publishers downsample.

If a publisher does not downsample, a warning is logged; the full rate is never used, as the link may not carry it.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.client.protocol import LIVE
from nedbus.client.rate_gate import RateGate, rate_step
from nedbus.client.sample import Mode
from nedbus.errors import NedbusError
from nedbus.log_event import about
from nedbus.transport import AliveTokens, RawSample, Session, ask
from nedbus_msgs import AddressError, Selection, address_of_alive_key, get_topic

from .decoder import MAX_KEYS, Arrival, Decoder
from .pending_queue import PendingQueue
from .receiver import Receiver

_log = logging.getLogger(__name__)

DOWNSAMPLED_TIMEOUT: Final = 10.0
"""Seconds from a stream's liveliness token to the warning that no downsampled message has arrived."""

_TIMEOUT: Final = 2.0  # s for the queries of last messages and liveliness tokens
_LAST_POLL: Final = 0.02  # s between polls for last messages
_OVERTAKEN: Final = 2_000_000_000  # ns by which a last message may overtake a downsampled one


class MaxRateQueue(PendingQueue):
    """Queue at most `max_rate` messages per second and stream, a finite number above 0.

    Messages omitted to keep the rate count neither as lost nor as dropped.
    """

    def __init__(self, mode: Mode, decoder: Decoder, *, max_rate: float, name: str = "") -> None:
        super().__init__(mode, decoder, name=name)
        self.rate = rate_step(max_rate)  # requested from publishers
        self.downsampled: dict[str, RateGate] = {}
        """Rate gates of the streams with a downsampled message so far, by key."""
        self._max_rate = max_rate
        self._last_sent: dict[str, float] = {}  # time of sending of the last message [ns], by key

    def put_last(self, batch: Sequence[RawSample]) -> None:
        """Queue the last messages of streams that have delivered none yet."""
        arrivals = self._decoder.admit(batch)
        with self._lock:
            for arrival in arrivals:
                key = arrival[0].key
                if arrival[1] and not (key in self.downsampled or key in self._last_sent):
                    if len(self._last_sent) < MAX_KEYS:
                        self._last_sent[key] = _sent(arrival)
                    super()._queue([arrival])
        self.wake()

    def _queue(self, arrivals: Sequence[Arrival]) -> None:
        super()._queue([arrival for arrival in arrivals if self._passes(arrival)])

    def _passes(self, arrival: Arrival) -> bool:
        stream = arrival[0]
        gate = self.downsampled.get(stream.key)
        if gate is None:
            gate = RateGate(self._max_rate)
            if len(self.downsampled) < MAX_KEYS:
                self.downsampled[stream.key] = gate
        passes = not 0 <= self._last_sent.get(stream.key, -math.inf) - _sent(arrival) <= _OVERTAKEN
        if self.rate > self._max_rate:  # lower than publishers offer
            passes = passes and gate.passes(time.monotonic_ns())
        if not passes:
            stream.unreported += arrival[3]
        return passes


class MaxRateReceiver(Receiver):
    """Put downsampled and last messages into a MaxRateQueue until closed."""

    def __init__(self, session: Session, selection: Selection, queue: MaxRateQueue, *, prefix: str) -> None:
        self._prefix, self._rate_queue = prefix, queue
        self._awaiting: dict[str, float] = {}  # appearance of tokens without a downsampled message yet [s], by key
        self._tokens = AliveTokens(session, selection.alive_key_expr(prefix=prefix))
        self._last = ask(session, selection.key_expr(prefix=prefix), timeout=_TIMEOUT)
        rate_key_expr = selection.rate_key_expr(queue.rate, prefix=prefix)
        super().__init__(session, rate_key_expr, queue, history=False)
        self._undeclares.append(self._tokens.undeclare)
        self.pump()  # last messages bypass the ring, so no reader may block on it

    def _poll(self, now: float) -> float:
        pause = super()._poll(now)
        with suppress(NedbusError, zenoh.ZError):  # the session is closed
            found = [reply.ok for reply in self._last.take() if reply.ok is not None]
            # Only live publishers: vehicles with nothing but a stored message are gone.
            if live := [raw for raw in found if raw.attachment is not None and raw.attachment.to_bytes() == LIVE]:
                self._rate_queue.put_last(live)
            self._check_publishers(now)
        return pause if self._last.ended else min(pause, _LAST_POLL)

    def _check_publishers(self, now: float) -> None:
        """Warn about live streams without a downsampled message."""
        for token, alive in self._tokens.take(timeout=_TIMEOUT):
            with suppress(AddressError):  # not a nedbus key
                address = address_of_alive_key(token, prefix=self._prefix)
                topic, key = get_topic(address.topic), address.key(prefix=self._prefix)
                if not alive:
                    self._awaiting.pop(key, None)
                elif topic.rate and not topic.on_change:  # others may pause for long
                    self._awaiting.setdefault(key, now)
        due = [key for key, since in self._awaiting.items() if now - since >= DOWNSAMPLED_TIMEOUT]
        for key in due:
            del self._awaiting[key]
        if missing := [key for key in due if key not in self._rate_queue.downsampled]:
            text = "%d streams are not received, as they are not downsampled (by publisher or access rules), such as %s"
            _log.warning(text, len(missing), missing[0], extra=about("unsupported"))


def _sent(arrival: Arrival) -> float:
    """Return the time of sending [ns]; infinity without a timestamp."""
    stamp = arrival[2].timestamp
    return math.inf if stamp is None else stamp.get_time_as_ntp64().as_nanos()
