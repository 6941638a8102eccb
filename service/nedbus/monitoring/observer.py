"""An observer: keep an account of the vehicles on a bus, from the samples of a reader."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Final

from nedbus.client import Bus, Health, RejectionReport, Sample, stream_state
from nedbus.events import Account
from nedbus_msgs import Address, Selection

_MAX_WAITING: Final = 200  # messages that may wait to be read, at any rate
_MAX_LAG: Final = 1.0  # s of messages that may wait to be read
_MAX_PAUSE: Final = 2.5  # s between two looks; after a longer one this process was held up itself
_SETTLING_TIME: Final = 3.0  # s after a link is back, in which what was held up arrives
_MAX_AGE: Final = 3.0  # s of the first sample of a stream; an older one is of a stream that has ended
_MAX_STREAMS: Final = 4096


@dataclass(frozen=True, slots=True)
class Sight:
    """All that was seen at one moment [s since the epoch]: published addresses, rejections, and the link.

    `link`: "" or what is wrong with it. `healths`: of all streams. `behind`: what is wrong with this reader itself.
    """

    time: float
    alive: Collection[Address]
    rejected: list[RejectionReport]
    link: str
    healths: Mapping[Address, Health]
    behind: str


class Observer:
    """Add samples as they are read, and look twice a second; `account` is what happened, by this host's clock."""

    def __init__(self, bus: Bus, selection: Selection) -> None:
        self.account = Account()
        self._bus, self._selection = bus, selection
        self._rejections = bus.rejections()
        self._looked: float | None = None
        self._seen: set[Address] = set()
        self._disconnected = 0.0  # when there was no link, last

    def add(self, sample: Sample[Any]) -> None:
        """Add a sample that was read just now; the last one of a stream that ended long ago says nothing of now."""
        if sample.address not in self._seen:
            if len(self._seen) < _MAX_STREAMS:
                self._seen.add(sample.address)
            if sample.latency is not None and sample.latency > _MAX_AGE:
                return
        received, missing = sample.received / 1e9, sample.provenance.missing
        self.account.add(sample.address, sample.message, received, missing=missing, lost=sample.lost)

    def look(self, healths: Mapping[Address, Health], *, dropped: int, waiting: int = 0) -> Sight:
        """Note how streams arrive now, rejections, and the messages that this reader dropped, or has not read yet."""
        now, connected = time.time(), self._bus.connected
        rejected = [report for report in self._rejections.take() if self._selection.matches(report.address)]
        for report in rejected:
            self.account.reject(report.address, report.reason, report.received / 1e9)
        alive = {address for addresses in self._bus.vehicles(timeout=0.2).values() for address in addresses}
        self._disconnected = min(self._disconnected, now) if connected else now
        settled = now - self._disconnected > _SETTLING_TIME
        mains = [vehicle.main for vehicle in list(self.account.vehicles.values())]
        states = {
            main: stream_state(healths[main], alive=main in alive).name if settled and main in healths else "unknown"
            for main in mains
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
