"""Which messages of a stream pass when at most so many a second are asked for. Pure, with the caller's clock."""

from __future__ import annotations

import math
from typing import Final

from nedbus.errors import ConfigError

from .qos import RATES

_EARLY: Final = 2_500_000  # ns


class RateGate:
    """Let at most `rate` messages a second pass.

    A message passes when it is due, and the next one is due a period after that moment, not after the message: of
    100 Hz to 30 Hz messages come 30 or 40 ms apart, and 30 a second. So the mean is the rate, or that of the stream
    where that is less, while the stream has no pause of more than two periods. After such a pause two messages may
    pass at once: in T seconds never more than rate x (T + 2.5 ms) + 2.
    """

    def __init__(self, rate: float) -> None:
        self._period = math.ceil(1e9 / rate)
        # Messages are due a moment before they come: of 100 Hz to 5 Hz each 20th passes, whatever their jitter.
        self._early = min(_EARLY, self._period // 10)
        self._due: int | None = None

    def passes(self, now: int) -> bool:
        """Return whether a message at `now`, in nanoseconds of any clock, passes."""
        due = self._due
        if due is not None and due - 2 * self._period <= now < due:
            return False
        if due is None or now < due:  # the first, or the clock was set back: a vehicle restarted
            self._due = now + self._period - self._early
        else:
            self._due = max(due + self._period, now - self._early)
        return True


def check_max_rate(max_rate: object) -> None:
    """Raise ConfigError for what is no number of messages a second."""
    if isinstance(max_rate, bool) or not isinstance(max_rate, int | float) or not 0 < max_rate < math.inf:
        raise ConfigError("max_rate", f"{max_rate!r} is invalid: messages a second, a finite number above 0")


def rate_step(max_rate: float) -> int:
    """Return which of RATES serves readers who ask for so much: the greatest that is not more, or else the least."""
    return max((rate for rate in RATES if rate <= max_rate), default=RATES[0])
