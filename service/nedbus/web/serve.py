"""The two pages, of live vehicles and of a recording: what each viewer gets, and what runs behind it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bokeh.document import Document

from nedbus.client import Bus
from nedbus.monitoring import Page
from nedbus_msgs import Selection

from .live import LiveFleet
from .playback import Player, Recording
from .server import WebServer
from .viewer import TICK, Viewer

if TYPE_CHECKING:
    from .background import Background


@dataclass(frozen=True, slots=True)
class Where:
    """Where a page is served: HOST and port, further ORIGINs that browsers may call it by, and what lies under it."""

    host: str
    port: int
    origins: tuple[str, ...] = ()
    background: Path | None = None

    def open(
        self, open_page: Callable[[Document, Background | None], object], pages: Mapping[str, Callable[[], Page]]
    ) -> WebServer:
        """Return a server that listens there; raise ConfigError for a bad background, ListenError if it cannot."""
        background = None
        if self.background is not None:
            from .background import Background

            background = Background(self.background)
        return WebServer(
            self.host, self.port, lambda page: open_page(page, background), pages=pages, origins=self.origins
        )


def serve_live(
    bus: Bus, selection: Selection, where: Where, *, version: str, stop: threading.Event, tell: Callable[[str], object]
) -> None:
    """Serve the page of what a selection matches until `stop` is set; `tell` gets its address when it is there."""
    live = LiveFleet(bus, selection, version=version)

    def open_page(document: Document, background: Background | None) -> None:
        viewer = Viewer(document, live.fleet, live.chronicle, background=background)
        document.add_periodic_callback(viewer.update, TICK)

    server = where.open(open_page, live.pages)
    with ThreadPoolExecutor(1, thread_name_prefix="nedbus-web") as pool:
        reading = pool.submit(live.run, stop)  # which sets `stop` when it fails
        tell(server.url)
        server.run(stop)
        reading.result()


def serve_recording(path: Path, where: Where, *, stop: threading.Event, tell: Callable[[str], object]) -> None:
    """Serve the page of a .ulg or .mcap file until `stop` is set; each viewer has a time of its own."""
    recording = Recording(path)

    def open_page(document: Document, background: Background | None) -> None:
        player = Player(recording)
        viewer = Viewer(
            document, player.fleet, recording.chronicle, title=recording.name, background=background,
            whole=recording.whole, player=player,
        )  # fmt: skip
        player.on_jump = viewer.restart

        def tick() -> None:
            player.tick()
            viewer.update()

        document.add_periodic_callback(tick, TICK)

    server = where.open(open_page, {"/healthz": lambda: Page.text("ok")})
    tell(server.url)
    server.run(stop)
