"""Downsampling: the rates that publishers offer, and the gate that limits a stream to a rate; no I/O."""

import math
from typing import Final

# Hz to which publishers downsample a stream, each on its own key
RATES: Final = (1, 2, 5, 10, 20, 50, 100)


class RateGate:
    """Rate limiter: passes at most rate x (T + 2.5 ms) + 2 messages in any T seconds, and two at once after a pause.

    The caller provides the clock.
    """

    def __init__(self, rate: float) -> None:
        self._period = math.ceil(1e9 / rate)  # ns
        # Due times are up to 2.5 ms early, so jitter has no effect: 100 Hz limited to 5 Hz passes every 20th message.
        self._early = min(2_500_000, self._period // 10)
        self._due = math.inf

    def passes(self, now: int) -> bool:
        """Return True if a message at `now`, in ns of any clock, passes."""
        due = self._due
        if due - 2 * self._period <= now < due:
            return False
        if now < due:  # the first message, or the clock was set back, for example by a reboot
            self._due = now + self._period - self._early
        else:
            # One period after the due time, not after this message: 100 Hz limited to 30 Hz stays 30 Hz on average.
            self._due = max(due + self._period, now - self._early)
        return True


def rate_step(max_rate: float) -> int:
    """Return the rate to request from publishers: the highest of RATES up to `max_rate`, else the lowest."""
    return max((rate for rate in RATES if rate <= max_rate), default=RATES[0])
