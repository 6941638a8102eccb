"""The page of live vehicles: one reader of every message for all viewers."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping

from nedbus.client import Bus
from nedbus.events import ALL, Event
from nedbus.monitoring import Exporter, Page, Sight
from nedbus_msgs import Selection

from .chronicle import PAST, Chronicle
from .fleet import Fleet


class LiveFleet:
    """Read what a selection matches into a fleet, and keep an account of it, until it is told to stop."""

    def __init__(self, bus: Bus, selection: Selection, *, version: str) -> None:
        self.fleet = Fleet()
        self._exporter = Exporter(
            bus, selection, version=version, on_look=self._look,
            watch=lambda sample: self.fleet.add(sample, time.time()),
        )  # fmt: skip
        self.chronicle = Chronicle(self._exporter.account, before=_remembered(bus, selection))

    @property
    def pages(self) -> Mapping[str, Callable[[], Page]]:
        """Metrics and health, as `nedbus export` serves them."""
        return self._exporter.pages

    def run(self, stop: threading.Event) -> None:
        """Read until `stop` is set."""
        self._exporter.run(stop)

    def _look(self, sight: Sight) -> None:
        """Make the picture of now."""
        account = self._exporter.account
        self.fleet.reject(sight.rejected)
        states = {vehicle: account.state(vehicle, sight.time) for vehicle in list(account.vehicles)}
        own = sight.behind.replace("this reader", "this page")
        self.fleet.look(sight.time, sight.healths, states, alive=sight.alive, link=sight.link, own=own)


def _remembered(bus: Bus, selection: Selection) -> list[Event]:
    reports = bus.accounts(within=PAST)
    now = time.time()
    told = [
        event
        for report in reports
        for event in report.events
        if event.time < now and event.vehicle != ALL and selection.vehicle in ("*", event.vehicle)
    ]
    return sorted(told, key=lambda event: event.time)
