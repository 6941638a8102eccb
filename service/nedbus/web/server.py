"""Bokeh server of the web page, for live vehicles or a recording."""

import logging
import resource
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from bokeh.application import Application
from bokeh.application.handlers import FunctionHandler
from bokeh.document import Document
from bokeh.models.widgets import Div
from bokeh.server.auth_provider import NullAuth
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.util import bind_sockets
from bokeh.util.token import get_token_payload
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPServerRequest
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.iostream import IOStream
from tornado.web import HTTPError, RequestHandler

from nedbus import Bus, Sample, clock
from nedbus.endpoints import is_loopback
from nedbus.errors import ListenError
from nedbus.health import Times
from nedbus.log_event import about
from nedbus.monitoring import Exporter, Page, Snapshot, why_refused
from nedbus.timings import TIMINGS
from nedbus.vehicle_events import once_per_service
from nedbus_msgs import Selection

from .background import Background
from .event_timeline import PAST, EventTimeline
from .fleet import Fleet
from .playback import Player, Recording
from .viewer import Viewer
from .vision import VisionWatch

_log = logging.getLogger(__name__)

MAX_VIEWERS: Final = 32  # pages open at the same time, each with a WebSocket
_WILDCARDS: Final = {"0.0.0.0", "::"}  # noqa: S104 - only compared
_STOP_POLL: Final = 100  # ms between checks of `stop`
# request body, normally empty; Tornado buffers it before the Host header is checked
_MAX_BODY_BYTES: Final = 2**16
_MAX_MESSAGE_BYTES: Final = 2**20  # WebSocket message from a browser
_MAX_WAITING: Final = 4 * MAX_VIEWERS  # pages without a WebSocket, including expiring ones
_MAX_CONNECTIONS: Final = 512  # or half of RLIMIT_NOFILE, if that is less
# s between WebSocket pings; without a pong before the next one, the connection is closed
_PING: Final = 15.0
# ms for which a page without a connection is kept, e.g. of a suspended browser
_UNUSED_LIFETIME: Final = 15_000


@dataclass(frozen=True, slots=True)
class PageOptions:
    """Options of a page: host, port, additional allowed origins, and the background file of the map."""

    host: str
    port: int
    origins: tuple[str, ...] = ()
    background: Path | None = None


def serve_live(
    bus: Bus, selection: Selection, options: PageOptions, *, version: str, stop: threading.Event,
    on_listening: Callable[[str], object],
) -> None:  # fmt: skip
    """Serve a page of the selected streams until `stop` is set; call `on_listening` with the URL once it listens.

    Raises ConfigError for an invalid background, ListenError if the address is not available.
    """
    live = LiveFleet(bus, selection, version=version)
    background = None if options.background is None else Background(options.background)
    server = WebServer(
        options,
        lambda page: Viewer(page, live.fleet, live.timeline, background=background),
        live.pages,
    )
    with ThreadPoolExecutor(1, thread_name_prefix="nedbus-web") as pool:
        reading = pool.submit(live.run, stop)  # a failure of `run` sets `stop`
        on_listening(server.url)
        server.run(stop)
        reading.result()


def serve_recording(
    paths: Sequence[Path],
    options: PageOptions,
    *,
    stop: threading.Event,
    on_listening: Callable[[str], object],
) -> None:
    """Serve a page of recordings until `stop` is set; each viewer has its own playback position.

    Raises ConfigError or SourceError if a file cannot be read, and the errors of `serve_live`.
    """
    recording = Recording(*paths)
    background = None if options.background is None else Background(options.background)

    def open_page(document: Document) -> None:
        player = Player(recording)
        Viewer(
            document,
            player.fleet,
            recording.timeline,
            title=recording.name,
            background=background,
            player=player,
        )

    server = WebServer(options, open_page, {"/healthz": lambda: Page.text("ok")})
    on_listening(server.url)
    server.run(stop)


class LiveFleet(Exporter):
    """Exporter that also updates the fleet and the event timeline of a page."""

    def __init__(self, bus: Bus, selection: Selection, *, version: str) -> None:
        super().__init__(bus, selection, version=version)
        self.fleet, self._vision = Fleet(self.monitor), VisionWatch()
        now = clock.utc()
        reports = [
            each
            for each in bus.accounts(within=PAST)
            if any(map(selection.matches_vehicle, each.vehicles))
        ]
        remembered = [event for _, event in once_per_service(reports) if event.time < now]
        self.timeline = EventTimeline(self.event_log, before=remembered)

    def add(self, sample: Sample[Any]) -> None:
        """Add a sample to the metrics and to the fleet."""
        super().add(sample)
        self.fleet.add(sample, clock.steady())
        self._vision.add(sample)

    def poll(self) -> Snapshot:
        """Poll all vehicles; update the fleet and the clock of the timeline."""
        snapshot, event_log = super().poll(), self.event_log
        ahead = round(clock.to_utc(), 1)  # rounded: each change redraws the time axes
        self.timeline.clock_offset, self.timeline.times = ahead, Times(is_live=True, ahead=ahead)
        vehicles = {*event_log.vehicles, *(address.vehicle for address in [*self.fleet.streams])}
        states = {vehicle: event_log.state(vehicle, snapshot.time) for vehicle in vehicles}
        self.fleet.update(
            snapshot, states, self.log_streams, self._vision.reports(vehicles, self.positions)
        )
        return snapshot


class WebServer:
    """Server of the Bokeh page and of text pages by path.

    Access as in `why_refused`, with the hosts of `options.origins`.

    Raises ListenError if the address is not available.
    """

    def __init__(
        self,
        options: PageOptions,
        open_page: Callable[[Document], object],
        pages: Mapping[str, Callable[[], Page]],
    ) -> None:
        for name in ("bokeh", "tornado.access", "tornado.general"):
            logging.getLogger(name).setLevel(logging.ERROR)  # else they warn about each closed tab
        host = options.host
        self._loop = IOLoop()

        def open_or_refuse(document: Document) -> None:
            sessions = self._server.get_sessions("/")
            waiting = [each for each in sessions if not each.connection_count]
            for each in waiting[:-MAX_VIEWERS]:  # pages whose clients have opened no WebSocket
                each.request_expiration()
            if len(sessions) - len(waiting) >= MAX_VIEWERS or len(waiting) >= _MAX_WAITING:
                _log_once("limit of %d open pages reached: further pages are refused", MAX_VIEWERS)
                document.add_root(Div(text=f"limit of {MAX_VIEWERS} open pages reached: close one"))
            else:
                open_page(document)

        try:
            sockets, port = bind_sockets(host, options.port)
        except OSError as exc:
            reason = (exc.strerror or str(exc)).lower()
            hint = "choose another address with --http"
            raise ListenError([f"http://{host}:{options.port}"], reason, hint=hint) from exc
        tornado = _Tornado(
            options, {"/": Application(FunctionHandler(open_or_refuse))},
            extra_websocket_origins=["*"], auth_provider=_TokenCheck(),
            # Bokeh's keep-alive may drop a busy session
            keep_alive_milliseconds=0, websocket_ping_interval=_PING,
            unused_session_lifetime_milliseconds=_UNUSED_LIFETIME, check_unused_sessions_milliseconds=1000,
            websocket_max_message_size_bytes=_MAX_MESSAGE_BYTES,
            extra_patterns=[(path, _TextHandler, {"render": render}) for path, render in pages.items()],
        )  # fmt: skip
        http = _HttpServer(
            tornado, max_body_size=_MAX_BODY_BYTES, max_buffer_size=2 * _MAX_MESSAGE_BYTES,
            idle_connection_timeout=TIMINGS.page_request, body_timeout=TIMINGS.page_request,
        )  # fmt: skip
        self._loop.add_callback(http.add_sockets, sockets)
        self._server = BaseServer(self._loop, tornado, http)
        shown = "127.0.0.1" if host in _WILDCARDS else f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{port}"

    def run(self, stop: threading.Event) -> None:
        """Serve until `stop` is set, in this thread."""
        poll = PeriodicCallback(lambda: self._loop.stop() if stop.is_set() else None, _STOP_POLL)
        self._loop.add_callback(poll.start)
        self._loop.add_callback(self._server.start)
        self._loop.start()
        poll.stop()  # otherwise it would stop the loop again while the server shuts down
        self._server.stop()
        self._loop.close(all_fds=True)


class _HttpServer(HTTPServer):
    """Close connections above a limit: without a free file descriptor, `accept` would fail in a busy loop."""

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        super().initialize(*args, **kwargs)
        self._streams: list[IOStream] = []
        self._limit = min(_MAX_CONNECTIONS, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        self._streams = [each for each in self._streams if not each.closed()]
        if len(self._streams) >= self._limit:
            _log_once(
                "limit of %d connections reached: further connections are closed", self._limit
            )
            stream.close()
            return
        self._streams.append(stream)
        super().handle_stream(stream, address)


@cache
def _log_once(text: str, limit: int) -> None:
    _log.warning(text, limit, extra=about("http"))


class _Tornado(BokehTornado):
    """Bokeh's application with the access rule, which applies to every path: pages, WebSocket and scripts."""

    def __init__(self, options: PageOptions, *args: Any, **kwargs: Any) -> None:
        self._options = options
        super().__init__(*args, **kwargs)

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> Any:
        is_local, origins = is_loopback(self._options.host), self._options.origins
        refusal = why_refused(
            request.path, request.headers.get_list, is_local=is_local, origins=origins
        )
        if not refusal:
            return super().find_handler(request, **kwargs)
        page = Page.text(f"{refusal}; add other names with --origin", status=403)
        return self.get_handler_delegate(request, _Refusal, {"render": lambda: page})


class _TokenCheck(NullAuth):
    """Bokeh's auth hook, without a login: reject a WebSocket without a valid token, which Bokeh would log."""

    login_url = "/"  # required by Bokeh, never used

    async def get_user_async(self, handler: RequestHandler) -> str:  # type: ignore[override] # a property in Bokeh
        if handler.request.path.endswith("/ws"):
            name, _, token = handler.request.headers.get("Sec-WebSocket-Protocol", "").partition(
                ","
            )
            try:
                is_valid = (
                    name == "bokeh"
                    and clock.utc() < get_token_payload(token.strip())["session_expiry"]
                )
            except Exception:  # noqa: BLE001 - Bokeh does not translate the errors of its decoders
                is_valid = False
            if not is_valid:
                raise HTTPError(403, reason="WebSocket without a valid page token")
        return "viewer"


class _TextHandler(RequestHandler):
    def initialize(self, render: Callable[[], Page]) -> None:
        self._render = render

    def get(self) -> None:
        page = self._render()
        self.set_status(page.status)
        self.set_header("Content-Type", page.content_type)
        self.set_header("X-Content-Type-Options", "nosniff")
        self.finish(page.content)


class _Refusal(_TextHandler):
    head = post = put = patch = delete = options = _TextHandler.get
