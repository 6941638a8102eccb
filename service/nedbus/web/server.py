"""The server of the page: Bokeh's, which listens on this host alone unless it is told otherwise."""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from bokeh.application import Application
from bokeh.application.handlers import FunctionHandler
from bokeh.document import Document
from bokeh.models.widgets import Div
from bokeh.resources import Resources
from bokeh.server.auth_provider import NullAuth
from bokeh.server.server import Server
from bokeh.server.views.static_handler import StaticHandler
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.web import HTTPError, RequestHandler

from nedbus.errors import ListenError
from nedbus.monitoring import Page
from nedbus.settings import is_loopback

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


class WebServer:
    """Serve a page, and pages of text by their path, until it is told to stop.

    A page of somebody else that is open in the same browser gets nothing, also where that has made its own name lead
    here: browsers have to call this one by a name of this host or one of `where.origins`.

    Raises ListenError when it cannot listen there.
    """

    def __init__(
        self, where: Where, open_page: Callable[[Document], object], pages: Mapping[str, Callable[[], Page]]
    ) -> None:
        for name in ("bokeh", "tornado.access", "tornado.general"):
            logging.getLogger(name).setLevel(logging.ERROR)  # each tab that is closed would be a warning
        host = where.host
        names = set(where.origins)
        text_names = names if is_loopback(host) else None
        self._loop = IOLoop()

        def open_or_refuse(document: Document) -> None:
            if len(self._server.get_sessions("/")) >= MAX_VIEWERS:
                document.add_root(Div(text=f"{MAX_VIEWERS} pages are open, which is the limit: close one"))
            else:
                open_page(document)

        try:
            self._server = Server(
                {"/": Application(FunctionHandler(open_or_refuse))}, io_loop=self._loop, address=host, port=where.port,
                allow_websocket_origin=["*"], auth_provider=_Names(names), keep_alive_milliseconds=5000,
                unused_session_lifetime_milliseconds=_UNUSED_LIFETIME,
                check_unused_sessions_milliseconds=_UNUSED_LIFETIME // 3,
                websocket_max_message_size=_MAX_MESSAGE_BYTES,
                http_server_kwargs={"max_body_size": _MAX_BODY_BYTES, "max_buffer_size": 2 * _MAX_MESSAGE_BYTES},
                extra_patterns=[(path, _Text, {"make": make, "names": text_names}) for path, make in pages.items()],
            )  # fmt: skip
        except OSError as exc:
            reason = (exc.strerror or str(exc)).lower()
            hint = "choose another address with --listen"
            raise ListenError([f"http://{host}:{where.port}"], reason, hint=hint) from exc
        # The server would send all of BokehJS, of which half is for formulas and WebGL, which nothing here uses.
        parts = Resources(
            mode="server", root_url="/", path_versioner=StaticHandler.append_version,
            components=["bokeh", "bokeh-widgets", "bokeh-tables"],
        )  # fmt: skip
        self._server._tornado.resources = lambda *_: parts  # type: ignore[method-assign]  # noqa: SLF001
        port = self._server.port or where.port
        names |= _names_of(host, port)
        shown = "127.0.0.1" if host in _ANY else host
        self.url = f"http://{_join(shown, port)}"

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
    """Answer only browsers that ask for one of these names."""

    login_url = "/"  # Bokeh demands it where users are checked; nobody is sent there

    def __init__(self, names: Collection[str]) -> None:
        self._names = names
        super().__init__()

    @property
    def get_user_async(self) -> Callable[[Any], Any]:
        """Return what checks a request before anything is answered; everybody is the same user."""

        async def check(handler: RequestHandler) -> str:
            _require_name(handler, self._names)
            return "viewer"

        return check


def _require_name(handler: RequestHandler, names: Collection[str]) -> None:
    headers = handler.request.headers
    host = headers.get("Host", "")
    for name in (host, headers.get("Origin", f"//{host}").partition("//")[2]):  # Origin: null has no name
        if name not in names:
            raise HTTPError(403, reason=f"this page is not called {name[:100]}: --origin lets browsers call it so")


class _Text(RequestHandler):
    def initialize(self, make: Callable[[], Page], names: Collection[str] | None) -> None:
        self._make, self._names = make, names

    def get(self) -> None:
        if self._names is not None:
            _require_name(self, self._names)
        page = self._make()
        self.set_status(page.status)
        self.set_header("Content-Type", page.content_type)
        self.set_header("X-Content-Type-Options", "nosniff")
        self.finish(page.content)


def _names_of(host: str, port: int) -> set[str]:
    """Return the names by which a browser may ask for a page on this address."""
    names = {"localhost", "127.0.0.1", "::1", host}
    if host in _ANY:
        names |= {socket.gethostname(), socket.getfqdn()}
        with suppress(OSError):  # a host that does not find itself: --origin names it
            names |= {str(address[4][0]) for address in socket.getaddrinfo(socket.gethostname(), None)}
    return {_join(name, port) for name in names}


def _join(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
