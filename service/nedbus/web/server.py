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

from nedbus import Bus, Sample, clock, limits
from nedbus.endpoints import is_loopback
from nedbus.errors import ListenError, system_reason
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

_WILDCARDS: Final = {"0.0.0.0", "::"}  # noqa: S104 - only compared
_STOP_POLL: Final = 100  # ms between checks of `stop`
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
    bus: Bus,
    selection: Selection,
    options: PageOptions,
    *,
    version: str,
    stop: threading.Event,
    on_listening: Callable[[str], object],
) -> None:
    """Serve a page of the selected streams until `stop` is set; call `on_listening` with the URL once it listens.

    Raises ConfigError for an invalid background, ListenError if the address is not available.
    """
    live = LiveFleet(bus, selection, version=version)
    if options.background is None:
        background = None
    else:
        background = Background(options.background)
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
    if options.background is None:
        background = None
    else:
        background = Background(options.background)

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
        self.fleet = Fleet(self.monitor)
        self._vision = VisionWatch()
        now = clock.utc()
        reports = []
        for report in bus.accounts(within=PAST):
            if any(map(selection.matches_vehicle, report.vehicles)):
                reports.append(report)
        remembered = [event for _, event in once_per_service(reports) if event.time < now]
        self.timeline = EventTimeline(self.event_log, before=remembered)

    def add(self, sample: Sample[Any]) -> None:
        """Add a sample to the metrics and to the fleet."""
        super().add(sample)
        self.fleet.add(sample, clock.steady())
        self._vision.add(sample)

    def poll(self) -> Snapshot:
        """Poll all vehicles; update the fleet and the clock of the timeline."""
        snapshot = super().poll()
        event_log = self.event_log
        ahead = round(clock.to_utc(), 1)  # rounded: each change redraws the time axes
        self.timeline.clock_offset = ahead
        self.timeline.times = Times(is_live=True, ahead=ahead)
        # Another thread adds streams while these names are copied.
        vehicles = {address.vehicle for address in [*self.fleet.streams]}
        vehicles.update(event_log.vehicles)
        states = {vehicle: event_log.state(vehicle, snapshot.time) for vehicle in vehicles}
        fusion = self._vision.reports(vehicles, self.positions)
        self.fleet.update(snapshot, states, self.log_streams, fusion)
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
        self._open_page = open_page
        self._loop = IOLoop()
        try:
            sockets, port = bind_sockets(options.host, options.port)
        except OSError as exc:
            url = f"http://{options.host}:{options.port}"
            reason = system_reason(exc)
            raise ListenError([url], reason, hint="choose another address with --http") from exc
        handlers = [(path, _TextHandler, {"render": render}) for path, render in pages.items()]
        tornado = _Tornado(
            options,
            {"/": Application(FunctionHandler(self._open_or_refuse))},
            extra_patterns=handlers,
            extra_websocket_origins=["*"],
            auth_provider=_TokenCheck(),
            keep_alive_milliseconds=0,  # Bokeh's keep-alive may drop a busy session
            websocket_ping_interval=_PING,
            unused_session_lifetime_milliseconds=_UNUSED_LIFETIME,
            check_unused_sessions_milliseconds=1000,
            websocket_max_message_size_bytes=limits.PAGE_MESSAGE_BYTES,
        )
        http = _HttpServer(
            tornado,
            max_body_size=limits.PAGE_REQUEST_BYTES,
            max_buffer_size=2 * limits.PAGE_MESSAGE_BYTES,
            idle_connection_timeout=TIMINGS.page_request,
            body_timeout=TIMINGS.page_request,
        )
        self._loop.add_callback(http.add_sockets, sockets)
        self._server = BaseServer(self._loop, tornado, http)
        self.url = f"http://{_shown_host(options.host)}:{port}"

    def _open_or_refuse(self, document: Document) -> None:
        sessions = self._server.get_sessions("/")
        waiting = [session for session in sessions if not session.connection_count]
        viewers = len(sessions) - len(waiting)
        for session in waiting[: -limits.PAGES]:  # the oldest
            session.request_expiration()
        if viewers >= limits.PAGES or len(waiting) >= limits.WAITING_PAGES:
            _log_once("limit of %d open pages reached: further pages are refused", limits.PAGES)
            document.add_root(Div(text=f"limit of {limits.PAGES} open pages reached: close one"))
        else:
            self._open_page(document)

    def run(self, stop: threading.Event) -> None:
        """Serve until `stop` is set, in this thread."""
        poll = PeriodicCallback(lambda: self._loop.stop() if stop.is_set() else None, _STOP_POLL)
        self._loop.add_callback(poll.start)
        self._loop.add_callback(self._server.start)
        self._loop.start()
        poll.stop()  # otherwise it would stop the loop again while the server shuts down
        self._server.stop()
        self._loop.close(all_fds=True)


def _shown_host(host: str) -> str:
    """Return a host as a browser on this machine needs it in a URL."""
    if host in _WILDCARDS:
        return "127.0.0.1"
    if ":" in host:
        return f"[{host}]"
    return host


class _HttpServer(HTTPServer):
    """Close connections above a limit: without a free file descriptor, `accept` would fail in a busy loop."""

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        super().initialize(*args, **kwargs)
        self._streams: list[IOStream] = []
        files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        self._limit = min(limits.PAGE_CONNECTIONS, files // 2)

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        self._streams = [known for known in self._streams if not known.closed()]
        if len(self._streams) >= self._limit:
            text = "limit of %d connections reached: further connections are closed"
            _log_once(text, self._limit)
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
        refusal = why_refused(
            request.path,
            request.headers.get_list,
            is_local=is_loopback(self._options.host),
            origins=self._options.origins,
        )
        if not refusal:
            return super().find_handler(request, **kwargs)
        page = Page.text(f"{refusal}; add other names with --origin", status=403)
        return self.get_handler_delegate(request, _Refusal, {"render": lambda: page})


class _TokenCheck(NullAuth):
    """Bokeh's auth hook, without a login: reject a WebSocket without a valid token, which Bokeh would log."""

    login_url = "/"  # required by Bokeh, never used

    async def get_user_async(self, handler: RequestHandler) -> str:  # type: ignore[override] # a property in Bokeh
        request = handler.request
        if request.path.endswith("/ws"):
            protocol = request.headers.get("Sec-WebSocket-Protocol", "")
            if not _is_valid_token(protocol):
                raise HTTPError(403, reason="WebSocket without a valid page token")
        return "viewer"


def _is_valid_token(protocol: str) -> bool:
    """Return whether the protocol of a WebSocket contains the token of a page that has not expired."""
    name, _, token = protocol.partition(",")
    if name != "bokeh":
        return False
    try:
        expiry: float = get_token_payload(token.strip())["session_expiry"]
        return clock.utc() < expiry
    except Exception:  # noqa: BLE001 - Bokeh does not translate the errors of its decoders
        return False


class _TextHandler(RequestHandler):
    def initialize(self, render: Callable[[], Page]) -> None:
        self._render = render

    def get(self) -> None:
        page = self._render()
        self.set_status(page.status)
        self.set_header("Content-Type", page.content_type)
        self.set_header("X-Content-Type-Options", "nosniff")
        self.finish(page.content)

    head = get  # Tornado omits the body


class _Refusal(_TextHandler):
    post = put = patch = delete = options = _TextHandler.get
