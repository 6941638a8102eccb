"""A small HTTP server that can only be read: each path has a page, and a client can change nothing."""

from __future__ import annotations

import ipaddress
import logging
import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Final, NamedTuple, cast

from nedbus.errors import ConfigError, ListenError
from nedbus.log_event import about
from nedbus.settings import is_loopback, split_http

_log = logging.getLogger(__name__)

_CLIENTS: Final = 16  # that are answered at the same time
_PATIENCE: Final = 5.0  # s that a client may take to ask, and to read the answer
_ANY_NAME: Final = {"/metrics", "/healthz", "/readyz", "/vehicles"}  # a Prometheus or a probe calls a host as it likes


class Page(NamedTuple):
    """An answer: HTTP's status, the type of its content, and the content."""

    status: int
    content_type: str
    content: bytes

    @classmethod
    def text(cls, text: str, *, status: int = 200) -> Page:
        """Return a page of plain text."""
        return cls(status, "text/plain; charset=utf-8", f"{text}\n".encode())


class HttpServer:
    """Serve pages by path on HOST:PORT, in threads of its own, until it is closed.

    A page of somebody else in a browser on this network may make its own name lead here and read what is answered
    under that name. So a page is answered under names that only lead here: addresses, localhost, the names of this
    host and, for others than this host, names without a dot, as in Docker. Others may ask by any name for metrics,
    health, readiness and the states of vehicles.

    Raises ConfigError for anything but HOST:PORT, ListenError when it cannot listen there.
    """

    def __init__(self, where: str, pages: Mapping[str, Callable[[], Page]]) -> None:
        try:
            host, port = split_http(where)
        except ValueError as exc:
            raise ConfigError("--http", str(exc)) from exc
        try:
            self._server = _Server((host, port), _make_handler(pages, local=is_loopback(host)))
        except OSError as exc:
            reason = (exc.strerror or str(exc)).lower()
            raise ListenError([f"http://{where}"], reason, hint="choose another address with --http") from exc
        self.port: int = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.2,), name="nedbus-http", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Listen no more."""
        self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    """Answer at most 16 clients at a time; when there are more, the one that was silent for longest has to go."""

    daemon_threads = True
    allow_reuse_address = True
    request_queue_size = 2 * _CLIENTS  # with Python's five the sixth that connects at once waits for a second

    def __init__(self, where: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        self.address_family = socket.AF_INET6 if ":" in where[0] else socket.AF_INET
        self._free = threading.BoundedSemaphore(_CLIENTS)
        self._silent: dict[socket.socket, None] = {}  # those that have not asked yet, the oldest first
        self._changing = threading.Lock()
        super().__init__(where, handler)

    def process_request(self, request: socket.socket | tuple[bytes, socket.socket], client_address: object) -> None:
        if not (self._free.acquire(blocking=False) or self._make_room()):
            self.shutdown_request(request)
            return
        if isinstance(request, socket.socket):
            with self._changing:
                self._silent[request] = None
        super().process_request(request, client_address)

    def process_request_thread(
        self, request: socket.socket | tuple[bytes, socket.socket], client_address: object
    ) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            if isinstance(request, socket.socket):
                self.has_asked(request)
            self._free.release()

    def has_asked(self, request: socket.socket) -> None:
        """Note that a client has sent its request: it is answered, however many others come."""
        with self._changing:
            self._silent.pop(request, None)

    def _make_room(self) -> bool:
        """Disconnect the client that was silent for longest, and return whether there is room then."""
        with self._changing:
            oldest = next(iter(self._silent), None)
            if oldest is None:
                return False
            del self._silent[oldest]
            with suppress(OSError):  # it has gone by itself
                oldest.shutdown(socket.SHUT_RDWR)
        return self._free.acquire(timeout=_PATIENCE)

    def handle_error(self, request: object, client_address: object) -> None:
        _log.debug("an HTTP client went away", exc_info=True)


def _make_handler(pages: Mapping[str, Callable[[], Page]], *, local: bool) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = _PATIENCE
        server_version = "nedbus"
        sys_version = ""

        def do_GET(self) -> None:
            self._answer()

        def do_HEAD(self) -> None:
            self._answer()

        def parse_request(self) -> bool:
            is_valid = super().parse_request()
            cast("_Server", self.server).has_asked(self.connection)
            return is_valid

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002
            _log.debug(format, *args)

        def _answer(self) -> None:
            path = self.path.partition("?")[0]
            host = self.headers.get("Host") or "localhost"  # every browser names it
            if path in pages and (local or path not in _ANY_NAME) and not _leads_here(host, local=local):
                page = Page.text(f"{path} is answered under an address or a name of this host only", status=403)
            else:
                page = _make_page(pages, path)
            self.send_response(page.status)
            self.send_header("Content-Type", page.content_type)
            self.send_header("Content-Length", str(len(page.content)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(page.content)

    return Handler


def _leads_here(host: str, *, local: bool) -> bool:
    """Return whether a Host is a name that nobody else can make lead to this host."""
    name = host.rpartition("]")[0][1:] if host.startswith("[") else host.partition(":")[0]
    name = name.lower().removesuffix(".")
    with suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return name == "localhost" or (not local and "." not in name) or name in _names()


@cache
def _names() -> set[str]:
    return {socket.gethostname().lower(), socket.getfqdn().lower()}


def _make_page(pages: Mapping[str, Callable[[], Page]], path: str) -> Page:
    make = pages.get(path)
    if make is None:
        return Page.text(f"there is {', '.join(pages)}", status=200 if path == "/" else 404)
    try:
        return make()
    except Exception:  # noqa: BLE001 - of one page, not of the server
        _log.exception("%s failed", path, extra=about("bug"))
        return Page.text("an unexpected error: the log has it", status=500)
