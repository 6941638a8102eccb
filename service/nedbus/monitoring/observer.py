"""An observer: a reader of a selection, the health of its streams, and the account of its vehicles."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Final

from nedbus.client import Bus, Health, Histogram, Monitor, RejectionReport, Sample, stream_state
from nedbus.events import Account
from nedbus_msgs import Address, Selection

_MAX_WAITING: Final = 200  # messages that may wait to be read, at any rate
_MAX_LAG: Final = 1.0  # s of messages that may wait to be read
_MAX_PAUSE: Final = 2.5  # s between two looks; after a longer one this process was held up itself
_SETTLING_TIME: Final = 3.0  # s after a link is back, in which what was held up arrives
_MAX_AGE: Final = 3.0  # s of the first sample of a stream; an older one is of a stream that has ended


@dataclass(frozen=True, slots=True)
class Sight:
    """Streams, new rejections and the link at one moment [s since the epoch].

    `alive`: published addresses; `link`, `behind`: the fault of the link, and of this reader itself, "" without one.
    """

    time: float
    alive: Collection[Address]
    rejected: list[RejectionReport]
    link: str
    healths: Mapping[Address, Health]
    behind: str


class Observer:
    """Read a selection, and look at it twice a second; `account` is what happened, by this host's clock.

    The samples of `subscription` are given to `add` by the thread that reads them; any thread may look.
    """

    def __init__(self, bus: Bus, selection: Selection) -> None:
        self.account = Account()
        self.subscription = bus.subscribe_to(selection, mode="every")
        self._bus, self._selection = bus, selection
        self._monitor = Monitor()
        self._rejections = bus.rejections()
        self._looked: float | None = None
        self._disconnected = 0.0  # when there was no link, last
        self._lock = threading.Lock()  # a stream is not in the monitor for a moment while a sample is added

    def add(self, sample: Sample[Any]) -> None:
        """Add a sample that was read just now; the last one of a stream that ended long ago says nothing of now."""
        with self._lock:
            is_known = self._monitor.add(sample)
        if is_known or sample.latency is None or sample.latency <= _MAX_AGE:
            received, missing = sample.received / 1e9, sample.provenance.missing
            self.account.add(sample.address, sample.message, received, missing=missing, lost=sample.lost)

    def measure(self) -> dict[Address, tuple[Health, Histogram | None]]:
        """Return the health of each stream now, and its latencies."""
        with self._lock:
            healths = self._monitor.snapshot()
            return {address: (health, self._monitor.latencies(address)) for address, health in healths.items()}

    def look(self) -> Sight:
        """Look at streams, rejections and the link, and note in the account what changed."""
        now, connected = time.time(), self._bus.connected
        dropped, waiting = self.subscription.counts.dropped, self.subscription.waiting
        with self._lock:
            healths = self._monitor.snapshot()
        rejected = [report for report in self._rejections.take() if self._selection.matches(report.address)]
        for report in rejected:
            self.account.reject(report.address, report.reason, report.received / 1e9)
        alive = {address for addresses in self._bus.vehicles(timeout=0.2).values() for address in addresses}
        self._disconnected = min(self._disconnected, now) if connected else now
        settled = now - self._disconnected > _SETTLING_TIME
        states = {
            main: stream_state(healths[main], alive=main in alive).name if settled else "unknown"
            for main in [vehicle.main for vehicle in list(self.account.vehicles.values())]
            if main is not None and (main in healths or not settled)
        }
        link = "" if connected else f"no link to {' or '.join(self._bus.routers)}"
        paused, self._looked = self._looked is not None and now - self._looked > _MAX_PAUSE, now
        rate = sum(health.usual_rate or 0.0 for health in healths.values())
        is_behind = paused or waiting > max(_MAX_WAITING, _MAX_LAG * rate)
        self.account.look(now, states, link=link, dropped=dropped, is_behind=is_behind)
        behind = ""
        if self.account.overload is not None:
            behind = f"this reader does not read in time: {waiting} messages wait, {dropped} were never read"
        return Sight(now, alive, rejected, link, healths, behind)
