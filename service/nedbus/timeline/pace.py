"""Pace of a replay: when each message is published."""

from typing import Final

SKIPPED_PAUSE: Final = 60.0
"""A longer pause of a replay takes no time [s]."""


class Pace:
    """When the messages of a replay are published; the only place where pauses are shortened.

    `speed`: 2.0 takes half the time. `skipped`: number of pauses of more than a minute so far.
    """

    def __init__(self, speed: float = 1.0) -> None:
        self.skipped = 0
        self._speed = speed
        self._last = 0.0
        self._due = 0.0

    def publish_at(self, at: float) -> float:
        """Return when to publish the message at a time on the axis [s], as seconds since the first message."""
        step = at - self._last
        if step > 0:
            self._last = at
            if step > SKIPPED_PAUSE:
                self.skipped += 1
            else:
                self._due += step
        return self._due / self._speed
