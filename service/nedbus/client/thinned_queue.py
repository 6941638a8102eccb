"""The queue of a reader who asked for at most so many messages a second: what is more is left out here.

Most comes thinned by its publisher already. What does not passes a gate here, after it was followed for losses: what
is left out is neither lost nor dropped, and what was lost before it is reported with the next message that passes.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from nedbus.transport import RawSample

from .decoder import MAX_KEYS, Arrival, Decoder
from .rate_gate import RateGate, check_max_rate, rate_step
from .receive_queue import ReceiveQueue
from .sample import Mode

_STALL: Final = 2_000_000_000  # ns at 1 Hz, two periods: after so long one passes whatever its timestamp says


@dataclass(slots=True, eq=False)
class _Thinning:
    """What passed of one stream, in ns; None if nothing did.

    `here`: when the last message that passed arrived. `whole`: when it was sent, if its publisher had not thinned it.
    """

    gate: RateGate
    here: int | None = None
    whole: int | None = None


class ThinnedQueue(ReceiveQueue):
    """Queue at most `max_rate` messages a second of each stream.

    `rate` is what publishers are asked for. `heard` has the keys of streams of which something thinned has arrived.

    Raises ConfigError for a `max_rate` that is no finite number above 0.
    """

    def __init__(self, mode: Mode, decoder: Decoder, *, max_rate: float, name: str = "") -> None:
        super().__init__(mode, decoder, name=name)
        self._follower.tracker.thinned = True
        check_max_rate(max_rate)
        self.rate = rate_step(max_rate)
        self.heard: set[str] = set()
        self._max_rate = max_rate
        self._thinnings: dict[str, _Thinning] = {}  # by key
        self._last: frozenset[int] = frozenset()  # ids of the samples of put_last

    def put_last(self, batch: Sequence[RawSample]) -> None:
        """Queue the last messages that were queried, each unless its stream goes on already."""
        self._last = frozenset(map(id, batch))
        self.put(batch)
        self._last = frozenset()

    def _queue(self, arrivals: list[Arrival]) -> bool:
        passed = []
        for arrival in arrivals:
            if self._passes(arrival):
                passed.append(arrival)
            else:
                self._follower.report_later(arrival[0].key, arrival[3])
        return super()._queue(passed)

    def _passes(self, arrival: Arrival) -> bool:
        stream, _, raw, _ = arrival
        here = time.monotonic_ns()
        sent = here if raw.timestamp is None else raw.timestamp.get_time_as_ntp64().as_nanos()
        thinning = self._thinnings.get(stream.key)
        if thinning is None:
            thinning = _Thinning(RateGate(self._max_rate))
            if len(self._thinnings) < MAX_KEYS:
                self._thinnings[stream.key] = thinning
        due = thinning.gate.passes(sent)
        if stream.thinned and len(self.heard) < MAX_KEYS:
            self.heard.add(stream.key)
        if id(raw) in self._last:
            passes = thinning.here is None
        elif stream.thinned and self.rate <= self._max_rate:
            # Its publisher has decided. But the last message that was queried may have overtaken this one.
            passes = thinning.whole is None or not 0 <= thinning.whole - sent <= _STALL / self.rate
        else:
            passes = due or thinning.here is None or here - thinning.here >= _STALL / self._max_rate
        if passes:
            thinning.here, thinning.whole = here, None if stream.thinned else sent
        return passes
