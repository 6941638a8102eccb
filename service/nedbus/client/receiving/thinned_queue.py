"""The queue of a reader with a maximum rate: what it leaves out counts neither as lost nor as dropped."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from nedbus.client.rate_gate import RateGate, check_max_rate, rate_step
from nedbus.client.sample import Mode
from nedbus.transport import RawSample

from .decoder import MAX_KEYS, Arrival, Decoder
from .pending_queue import PendingQueue

PATIENCE: Final = 3.0  # s that a publisher has to send something thinned, from its liveliness token on
_STALL: Final = 2_000_000_000  # ns at 1 Hz, two periods: after so long one passes whatever its timestamp says


@dataclass(slots=True, eq=False)
class _Thinning:
    """State of one stream: its publisher, and the last message that passed."""

    gate: RateGate
    alive_since: float = math.inf  # s
    by_publisher: bool = False  # something thinned has arrived
    passed_at: float = -math.inf  # ns
    whole_sent: float = -math.inf  # ns, when what passed last was sent, if its publisher had not thinned it


class ThinnedQueue(PendingQueue):
    """Queue at most `max_rate` messages a second of each stream; raise ConfigError if that is no number above 0."""

    def __init__(self, mode: Mode, decoder: Decoder, *, max_rate: float, name: str = "") -> None:
        super().__init__(mode, decoder, name=name, thinned=True)
        check_max_rate(max_rate)
        self.rate = rate_step(max_rate)  # which publishers are asked for
        self._max_rate = max_rate
        self._thinnings: dict[str, _Thinning] = {}  # by key

    def put_last(self, batch: Sequence[RawSample]) -> None:
        """Queue the last messages that were queried, each unless its stream goes on already."""
        arrivals = self._decoder.admit(batch)
        with self._lock:
            for arrival in arrivals:
                if arrival[1] and self._thinning(arrival[0].key).passed_at == -math.inf:
                    self._queue([arrival])
        self.wake()

    def on_token(self, key: str, now: float, *, alive: bool) -> None:
        """Note that a stream has a publisher; forget it when that is gone, as the next one may thin, or not."""
        if not alive:
            self._thinnings.pop(key, None)
        elif (thinning := self._thinning(key)).alive_since > now:
            thinning.alive_since = now

    def unthinned(self, now: float) -> set[str]:
        """Return the keys of the streams to be read whole: alive for a while, and not thinned by their publishers."""
        known = list(self._thinnings.items())  # at once: another thread adds to them
        return {key for key, each in known if not each.by_publisher and now - each.alive_since >= PATIENCE}

    def _queue(self, arrivals: Sequence[Arrival]) -> None:
        super()._queue([arrival for arrival in arrivals if self._passes(arrival)])

    def _thinning(self, key: str) -> _Thinning:
        known = self._thinnings.get(key) or _Thinning(RateGate(self._max_rate))
        return self._thinnings.setdefault(key, known) if len(self._thinnings) < MAX_KEYS else known

    def _passes(self, arrival: Arrival) -> bool:
        stream, _, raw, lost = arrival
        now = time.monotonic_ns()
        sent = now if raw.timestamp is None else raw.timestamp.get_time_as_ntp64().as_nanos()
        thinning = self._thinning(stream.key)
        thinning.by_publisher |= stream.thinned
        passes = thinning.gate.passes(sent)
        if stream.thinned and self.rate <= self._max_rate:
            # Its publisher has decided. But the last message that was queried may have overtaken this one.
            passes = not 0 <= thinning.whole_sent - sent <= _STALL / self.rate
        elif now - thinning.passed_at >= _STALL / self._max_rate:
            passes = True
        if passes:
            thinning.passed_at, thinning.whole_sent = now, -math.inf if stream.thinned else sent
        else:
            stream.unreported += lost
        return passes
