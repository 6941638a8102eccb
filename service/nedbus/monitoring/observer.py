"""An observer: follow vehicles on a bus, whoever reads the samples, so that an account of what happened is kept."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Final

from nedbus.client import Bus, Health, RejectionReport, Sample, stream_state
from nedbus.events import Account
from nedbus_msgs import Address, Selection

_WAITING: Final = 200  # messages that may wait at any time
_STOOD: Final = 2.5  # s between two looks from which on this process was held up itself
_SETTLING: Final = 3.0  # s after a link is back, in which what was held up arrives
_OLD: Final = 3.0  # s that the first sample of a stream may be old
_MAX_STREAMS: Final = 4096
_LATE: Final = 1.0  # s of messages that wait, from which on a reader is behind


@dataclass(frozen=True, slots=True)
class Sight:
    """What was seen at one moment [s since the epoch]: what is published, what was rejected, and the link.

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
        self._cut = 0.0  # when there was no link, last

    def add(self, sample: Sample[Any]) -> None:
        """Add a sample that was read just now; the last one of a stream that ended long ago says nothing of now."""
        if sample.address not in self._seen:
            if len(self._seen) < _MAX_STREAMS:
                self._seen.add(sample.address)
            if sample.latency is not None and sample.latency > _OLD:
                return
        self.account.add(
            sample.address, sample.message, sample.received / 1e9,
            missing=sample.provenance.missing, lost=sample.lost,
        )  # fmt: skip

    def look(self, healths: Mapping[Address, Health], *, dropped: int, waiting: int = 0) -> Sight:
        """Note how streams arrive now, what was rejected, and what this reader did not read in time, or not yet."""
        now, connected = time.time(), self._bus.connected
        rejected = [report for report in self._rejections.take() if self._selection.matches(report.address)]
        for report in rejected:
            self.account.reject(report.address, report.reason, report.received / 1e9)
        alive = {address for addresses in self._bus.vehicles(timeout=0.2).values() for address in addresses}
        self._cut = min(self._cut, now) if connected else now
        settled = now - self._cut > _SETTLING
        states = {
            main: stream_state(healths[main], alive=main in alive).name if settled and main in healths else "unknown"
            for vehicle in list(self.account.vehicles.values())
            if (main := vehicle.main) is not None and (main in healths or not settled)
        }
        link = "" if connected else f"no link to {' or '.join(self._bus.routers)}"
        stood, self._looked = self._looked is not None and now - self._looked > _STOOD, now
        rate = sum(health.usual_rate or 0.0 for health in healths.values())
        self.account.look(
            now, states, link=link, dropped=dropped, is_behind=stood or waiting > max(_WAITING, _LATE * rate)
        )
        behind = ""
        if self.account.overload is not None:
            behind = f"this reader does not read in time: {waiting} messages wait, {dropped} were never read"
        return Sight(now, alive, rejected, link, healths, behind)
