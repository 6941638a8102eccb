"""The server of the page, of live vehicles or of a recording: Bokeh's, on this host alone unless told otherwise."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from bokeh.application import Application
from bokeh.application.handlers import FunctionHandler
from bokeh.document import Document
from bokeh.models.widgets import Div
from bokeh.server.auth_provider import NullAuth
from bokeh.server.server import Server
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.web import HTTPError, RequestHandler

from nedbus.client import Bus
from nedbus.errors import ListenError
from nedbus.events import ALL
from nedbus.monitoring import Exporter, Page, Sight, leads_here
from nedbus.settings import is_loopback
from nedbus_msgs import Selection

from .background import Background
from .chronicle import PAST, Chronicle
from .fleet import Fleet
from .playback import Player, Recording
from .viewer import Viewer

MAX_VIEWERS: Final = 32
"""Pages that are open at the same time."""

_ANY: Final = {"0.0.0.0", "::"}  # noqa: S104 - hosts that stand for all addresses
_STOP_POLL: Final = 100  # ms until the end is noticed
_MAX_BODY_BYTES: Final = 2**16  # of a request, which has none: Tornado keeps it before its Host is checked
_MAX_MESSAGE_BYTES: Final = 2**20  # of a browser about its page
_UNUSED_LIFETIME: Final = 15_000  # ms that a page without a browser is kept: a laptop that wakes up within it goes on


@dataclass(frozen=True, slots=True)
class Where:
    """The address of a page, further ORIGINs that browsers may call it by, and the file that is drawn under the map."""

    host: str
    port: int
    origins: tuple[str, ...] = ()
    background: Path | None = None

    def open_background(self) -> Background | None:
        """Read the file under the map."""
        return None if self.background is None else Background(self.background)


def serve_live(
    bus: Bus, selection: Selection, where: Where, *, version: str, stop: threading.Event, tell: Callable[[str], object]
) -> None:
    """Serve the page of a selection until `stop` is set; call `tell` with its address when it listens.

    Raises ConfigError for a bad background, ListenError if it cannot listen.
    """
    live = LiveFleet(bus, selection, version=version)
    background = where.open_background()
    server = WebServer(where, lambda page: Viewer(page, live.fleet, live.chronicle, background=background), live.pages)
    with ThreadPoolExecutor(1, thread_name_prefix="nedbus-web") as pool:
        reading = pool.submit(live.run, stop)  # which sets `stop` when it fails
        tell(server.url)
        server.run(stop)
        reading.result()


def serve_recording(path: Path, where: Where, *, stop: threading.Event, tell: Callable[[str], object]) -> None:
    """Serve the page of a .ulg or .mcap file until `stop` is set; each viewer has a time of its own.

    Raises ConfigError and SourceError for a file that cannot be read, and as `serve_live`.
    """
    recording, background = Recording(path), where.open_background()

    def open_page(document: Document) -> None:
        player = Player(recording)
        Viewer(document, player.fleet, recording.chronicle, title=path.name, background=background, player=player)

    server = WebServer(where, open_page, {"/healthz": lambda: Page.text("ok")})
    tell(server.url)
    server.run(stop)


class LiveFleet:
    """Read a selection into a fleet and a chronicle.

    `run` reads until an event is set; `pages`: metrics and health, as `nedbus export` serves them.
    """

    def __init__(self, bus: Bus, selection: Selection, *, version: str) -> None:
        self.fleet = Fleet()
        self._exporter = Exporter(
            bus, selection, version=version, on_look=self._look,
            watch=lambda sample: self.fleet.add(sample, time.time()),
        )  # fmt: skip
        now = time.time()
        remembered = [
            event
            for report in bus.accounts(within=PAST)
            for event in report.events
            if event.time < now and event.vehicle != ALL and selection.vehicle in ("*", event.vehicle)
        ]
        self.chronicle = Chronicle(self._exporter.account, before=remembered)
        self.run, self.pages = self._exporter.run, self._exporter.pages

    def _look(self, sight: Sight) -> None:
        account = self._exporter.account
        self.fleet.reject(sight.rejected)
        states = {vehicle: account.state(vehicle, sight.time) for vehicle in list(account.vehicles)}
        own = sight.behind.replace("this reader", "this page")
        self.fleet.look(sight.time, sight.healths, states, alive=sight.alive, link=sight.link, own=own)


class WebServer:
    """Serve a page, and pages of text by their path.

    A foreign page that is open in the same browser gets nothing, also where its own name leads here (DNS rebinding):
    browsers have to call this one by a name that only leads here, as `HttpServer` has it, or by one of `where.origins`.

    Raises ListenError when it cannot listen there.
    """

    def __init__(
        self, where: Where, open_page: Callable[[Document], object], pages: Mapping[str, Callable[[], Page]]
    ) -> None:
        for name in ("bokeh", "tornado.access", "tornado.general"):
            logging.getLogger(name).setLevel(logging.ERROR)  # each tab that is closed would be a warning
        host = where.host
        self._loop = IOLoop()

        def open_or_refuse(document: Document) -> None:
            if len(self._server.get_sessions("/")) >= MAX_VIEWERS:
                document.add_root(Div(text=f"{MAX_VIEWERS} pages are open, which is the limit: close one"))
            else:
                open_page(document)

        try:
            self._server = Server(
                {"/": Application(FunctionHandler(open_or_refuse))}, io_loop=self._loop, address=host, port=where.port,
                allow_websocket_origin=["*"], auth_provider=_Names(where), keep_alive_milliseconds=5000,
                unused_session_lifetime_milliseconds=_UNUSED_LIFETIME,
                check_unused_sessions_milliseconds=_UNUSED_LIFETIME // 3,
                websocket_max_message_size=_MAX_MESSAGE_BYTES,
                http_server_kwargs={"max_body_size": _MAX_BODY_BYTES, "max_buffer_size": 2 * _MAX_MESSAGE_BYTES},
                extra_patterns=[(path, _Text, {"make": make, "where": where}) for path, make in pages.items()],
            )  # fmt: skip
        except OSError as exc:
            reason = (exc.strerror or str(exc)).lower()
            hint = "choose another address with --http"
            raise ListenError([f"http://{host}:{where.port}"], reason, hint=hint) from exc
        shown = "127.0.0.1" if host in _ANY else f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self._server.port}"

    def run(self, stop: threading.Event) -> None:
        """Serve until `stop` is set, in this thread."""
        poll = PeriodicCallback(lambda: self._loop.stop() if stop.is_set() else None, _STOP_POLL)
        self._loop.add_callback(poll.start)
        self._loop.add_callback(self._server.start)
        self._loop.start()
        poll.stop()  # it would stop the loop once more, amid the end of the server
        self._server.stop()
        self._loop.close(all_fds=True)


class _Names(NullAuth):
    """Refuse requests under foreign names."""

    login_url = "/"  # Bokeh demands it where users are checked; no browser is sent there

    def __init__(self, where: Where) -> None:
        self._where = where
        super().__init__()

    @property
    def get_user_async(self) -> Callable[[Any], Any]:
        """Return the check of a request, before any answer; all viewers are the same user."""

        async def check(handler: RequestHandler) -> str:
            _require_name(handler, self._where)
            return "viewer"

        return check


def _require_name(handler: RequestHandler, where: Where) -> None:
    headers = handler.request.headers
    host = headers.get("Host", "")
    origin = headers.get("Origin", f"//{host}").partition("//")[2]  # Origin: null has no name
    is_own = host in where.origins or leads_here(host, local=is_loopback(where.host))
    if not is_own or origin not in (host, *where.origins):
        name = origin if is_own else host
        raise HTTPError(403, reason=f"this page is not called {name[:100]}: --origin lets browsers call it so")


class _Text(RequestHandler):
    def initialize(self, make: Callable[[], Page], where: Where) -> None:
        self._make, self._where = make, where

    def get(self) -> None:
        if is_loopback(self._where.host):
            _require_name(self, self._where)
        page = self._make()
        self.set_status(page.status)
        self.set_header("Content-Type", page.content_type)
        self.set_header("X-Content-Type-Options", "nosniff")
        self.finish(page.content)
