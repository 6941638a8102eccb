"""The page of live vehicles: one reader of every message for all viewers."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Final

from nedbus.client import Bus
from nedbus.monitoring import Exporter, Page
from nedbus_msgs import Selection

from .fleet import Fleet
from .style import to_clock

LOOK: Final = 500
"""Milliseconds between two pictures of the states."""


class LiveFleet:
    """Read what a selection matches into a fleet, until it is told to stop."""

    def __init__(self, bus: Bus, selection: Selection, *, version: str) -> None:
        self.fleet = Fleet()
        self._bus, self._selection = bus, selection
        self._exporter = Exporter(
            bus, selection, version=version, watch=lambda sample: self.fleet.add(sample, time.time())
        )
        self._rejections = bus.rejections()
        self._broken: float | None = None  # since when the link is

    @property
    def pages(self) -> Mapping[str, Callable[[], Page]]:
        """Metrics and health, as `nedbus export` serves them."""
        return self._exporter.pages

    def run(self, stop: threading.Event) -> None:
        """Read until `stop` is set."""
        self._exporter.run(stop)

    def look(self) -> None:
        """Make the picture of now."""
        now = time.time()
        self._broken = None if self._bus.connected else self._broken or now
        routers = " or ".join(self._bus.routers)
        link = f"no link to {routers} since {to_clock(self._broken)}: waiting for it" if self._broken else ""
        self.fleet.reject([report for report in self._rejections.take() if self._selection.matches(report.address)])
        alive = {address for addresses in self._bus.vehicles(timeout=0.2).values() for address in addresses}
        self.fleet.look(now, self._exporter.healths, alive=alive, link=link)
