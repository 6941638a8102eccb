"""A reader on the host that keeps everything it gets."""

from __future__ import annotations

import threading
import time

import nedbus
from nedbus_msgs import Address
from tests.conftest import DEADLINE, wait_for

from .flight import Flight


class Recorder:
    """Reads a subscription in a thread of its own, as a script does, and keeps everything."""

    def __init__(self, subscription: nedbus.Subscription) -> None:
        self.subscription = subscription
        self.samples: list[nedbus.Sample] = []
        self.unseen = 0  # messages that may have been superseded before the first one that was read
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        for sample in self.subscription:
            if not self.samples:
                self.unseen = self.subscription.counts.dropped
            self.samples.append(sample)

    def wait_for_more(self, count: int, *, seconds: float = DEADLINE) -> float:
        """Wait for so many samples from now on, and return how long that took."""
        start, before = time.monotonic(), len(self.samples)
        wait_for(lambda: len(self.samples) >= before + count, what=f"{count} more samples", seconds=seconds)
        return time.monotonic() - start

    def of(self, address: Address) -> list[nedbus.Sample]:
        """Return what arrived of one address so far."""
        return [sample for sample in list(self.samples) if sample.address == address]

    def close(self) -> None:
        self.subscription.close()
        self._thread.join(DEADLINE)


def indices(samples: list[nedbus.Sample], flight: Flight) -> list[int]:
    """Return the indices of these samples of one address in its flight; every value must be right."""
    return flight.indices((sample.address, sample.message) for sample in samples).popitem()[1]
