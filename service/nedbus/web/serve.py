"""The two pages, of live vehicles and of a recording: what each viewer gets, and what runs behind it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from bokeh.document import Document

from nedbus.client import Bus
from nedbus.events import ALL, Event
from nedbus.monitoring import Exporter, Page, Sight
from nedbus_msgs import Selection

from .background import Background
from .chronicle import PAST, Chronicle
from .fleet import Fleet
from .playback import Player, Recording
from .server import WebServer, Where
from .viewer import Viewer

_TICK: Final = 100  # ms between two moves of the map


def serve_live(
    bus: Bus, selection: Selection, where: Where, *, version: str, stop: threading.Event, tell: Callable[[str], object]
) -> None:
    """Serve the page of what a selection matches until `stop` is set; `tell` gets its address when it is there.

    Raises ConfigError for a bad background, ListenError if it cannot listen.
    """
    live = LiveFleet(bus, selection, version=version)
    background = Background(where.background) if where.background is not None else None

    def open_page(document: Document) -> None:
        viewer = Viewer(document, live.fleet, live.chronicle, background=background)
        document.add_periodic_callback(viewer.update, _TICK)

    server = WebServer(where, open_page, live.pages)
    with ThreadPoolExecutor(1, thread_name_prefix="nedbus-web") as pool:
        reading = pool.submit(live.run, stop)  # which sets `stop` when it fails
        tell(server.url)
        server.run(stop)
        reading.result()


def serve_recording(path: Path, where: Where, *, stop: threading.Event, tell: Callable[[str], object]) -> None:
    """Serve the page of a .ulg or .mcap file until `stop` is set; each viewer has a time of its own.

    Raises ConfigError and SourceError for a file that cannot be read, and as `serve_live`.
    """
    recording = Recording(path)
    background = Background(where.background) if where.background is not None else None

    def open_page(document: Document) -> None:
        player = Player(recording)
        viewer = Viewer(
            document, player.fleet, recording.chronicle, title=recording.name, background=background,
            whole=recording.whole, player=player,
        )  # fmt: skip
        document.add_periodic_callback(viewer.update, _TICK)

    server = WebServer(where, open_page, {"/healthz": lambda: Page.text("ok")})
    tell(server.url)
    server.run(stop)


class LiveFleet:
    """Read what a selection matches into a fleet, and keep an account of it, until it is told to stop.

    `pages`: metrics and health, as `nedbus export` serves them.
    """

    def __init__(self, bus: Bus, selection: Selection, *, version: str) -> None:
        self.fleet = Fleet()
        self._exporter = Exporter(
            bus, selection, version=version, on_look=self._look,
            watch=lambda sample: self.fleet.add(sample, time.time()),
        )  # fmt: skip
        self.chronicle = Chronicle(self._exporter.account, before=_remembered(bus, selection))
        self.pages: Mapping[str, Callable[[], Page]] = self._exporter.pages

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
    """Return the events of the last minutes that services remember."""
    now = time.time()
    return [
        event
        for report in bus.accounts(within=PAST)
        for event in report.events
        if event.time < now and event.vehicle != ALL and selection.vehicle in ("*", event.vehicle)
    ]
