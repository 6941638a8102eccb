"""Downsampling: the rates that publishers offer, and the gate that lets messages pass at a rate. Pure."""

from __future__ import annotations

import math
from typing import Final

from nedbus.errors import ConfigError

RATES: Final = (1, 2, 5, 10, 20, 50, 100)
"""Messages a second to which a publisher downsamples a stream for its readers, each on a key of its own."""


class RateGate:
    """Let at most `rate` messages a second pass: in T seconds rate x (T + 2.5 ms) + 2, two at once after a pause.

    The clock is the caller's.
    """

    def __init__(self, rate: float) -> None:
        self._period = math.ceil(1e9 / rate)  # ns
        # Messages are due up to 2.5 ms before they come: of 100 Hz to 5 Hz each 20th passes, whatever their jitter.
        self._early = min(2_500_000, self._period // 10)
        self._due = math.inf

    def passes(self, now: int) -> bool:
        """Return whether a message at `now`, in nanoseconds of any clock, passes."""
        due = self._due
        if due - 2 * self._period <= now < due:
            return False
        if now < due:  # the first, or the clock was set back: a vehicle restarted
            self._due = now + self._period - self._early
        else:
            # Not a period after this message: of 100 Hz to 30 Hz pass 30 a second, 30 or 40 ms apart.
            self._due = max(due + self._period, now - self._early)
        return True


def check_max_rate(max_rate: object) -> None:
    """Raise ConfigError for what is no number of messages a second."""
    if isinstance(max_rate, bool) or not isinstance(max_rate, int | float) or not 0 < max_rate < math.inf:
        raise ConfigError("max_rate", f"{max_rate!r} is invalid: messages a second, a finite number above 0")


def rate_step(max_rate: float) -> int:
    """Return the rate to request of publishers: the greatest of RATES that is not above, or else the least."""
    return max((rate for rate in RATES if rate <= max_rate), default=RATES[0])
