"""Throttle: the maximum rate of each stream at its reader; no I/O.

Publishers downsample to the nearest rate that they offer. The throttle limits what arrives to the rate that the reader
asked for, and joins the last message of a stream with the downsampled ones after it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from nedbus.client.rate_gate import RateGate, rate_step
from nedbus_msgs import Address, Selection, check_max_rate

from .arrival import Arrival

_OVERTAKEN: Final = 2_000_000_000  # ns by which a last message may overtake a downsampled one


@dataclass(slots=True)
class Throttled:
    """What a throttle knows of a stream."""

    gate: RateGate
    has_arrived: bool = False  # a downsampled message
    last_sent: float = -math.inf  # time of sending of the last message [ns]


class Throttle:
    """Limits each stream to `max_rate` messages per second (see RateGate).

    `rate`: the one requested from publishers. Messages omitted to limit the rate count neither as lost nor as dropped.
    Raises ArgumentError unless `max_rate` is a finite number above 0. Not thread-safe.
    """

    def __init__(self, max_rate: float, selection: Selection, *, prefix: str) -> None:
        check_max_rate(max_rate)
        self.selection = selection
        self.rate = rate_step(max_rate)
        self.key_exprs = selection.rate_key_exprs(self.rate, prefix=prefix)
        self._max_rate = max_rate
        self._prefix = prefix

    def key_of(self, address: Address) -> str:
        """Return the key of the downsampled messages of a stream."""
        return address.rate_key(self.rate, prefix=self._prefix)

    def passing(self, arrivals: Sequence[Arrival]) -> list[Arrival]:
        """Return the messages to be read; the next one of each stream reports the losses before the others."""
        passing: list[Arrival] = []
        for arrival in arrivals:
            if self._passes(arrival):
                passing.append(arrival)
            else:
                arrival.stream.unreported += arrival.lost
        return passing

    def takes_last(self, throttled: Throttled, last: Arrival) -> bool:
        """Return True if the last message of a stream, which was asked for, precedes all that have arrived."""
        if throttled.has_arrived or throttled.last_sent != -math.inf:
            return False
        throttled.last_sent = _sent(last)
        return True

    def new_state(self) -> Throttled:
        """Return the state of a stream of which nothing has arrived."""
        return Throttled(RateGate(self._max_rate))

    def _passes(self, arrival: Arrival) -> bool:
        stream = arrival.stream
        if stream.throttled is None:
            stream.throttled = self.new_state()
        throttled = stream.throttled
        throttled.has_arrived = True
        if 0 <= throttled.last_sent - _sent(arrival) <= _OVERTAKEN:
            return False
        if self.rate <= self._max_rate:
            return True
        return throttled.gate.passes(time.monotonic_ns())  # below the lowest rate of publishers


def _sent(arrival: Arrival) -> float:
    """Return the time of sending [ns]; infinity without a timestamp."""
    stamp = arrival.raw.timestamp
    if stamp is None:
        return math.inf
    return stamp.get_time_as_ntp64().as_nanos()
