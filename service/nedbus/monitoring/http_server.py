"""Read-only HTTP server with one page per path."""

from __future__ import annotations

import ipaddress
import json
import logging
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final, NamedTuple

from nedbus.errors import ConfigError, ListenError
from nedbus.log_event import about
from nedbus.settings import is_loopback, split_http
from nedbus.timings import TIMINGS

_log = logging.getLogger(__name__)

_MAX_REQUESTS: Final = 16  # concurrent
_ACCEPT_PAUSE: Final = 0.2  # s
_ANY_NAME: Final = {"/metrics", "/healthz", "/readyz", "/vehicles"}  # scrapers and probes may use any host name


class Page(NamedTuple):
    """An HTTP response: status, content type and body."""

    status: int
    content_type: str
    content: bytes

    @classmethod
    def text(cls, text: str, *, status: int = 200) -> Page:
        """Return a plain-text page."""
        return cls(status, "text/plain; charset=utf-8", f"{text}\n".encode())

    @classmethod
    def json(cls, content: Mapping[str, Any]) -> Page:
        """Return a JSON page."""
        return cls(200, "application/json", json.dumps(content, indent=2).encode())

    @classmethod
    def verdict(cls, faults: list[str], good: str) -> Page:
        """Return status 503 with one fault per line, or 200 with `good` if there are none."""
        return cls.text("\n".join(faults), status=503) if faults else cls.text(good)


class HttpServer(ThreadingHTTPServer):
    """Serve pages by path on HOST:PORT, in up to 16 background threads, until closed.

    Protects against DNS rebinding, where a web page in a browser on this network points its own host name to this
    server to read the responses. Pages are served only under host names that such a page cannot control: IP addresses,
    localhost, this host's own names and, unless bound to loopback, names without a dot, as in Docker. Unless bound to
    loopback, metrics, health, readiness and vehicle states are served under any name.

    Raises ConfigError for an invalid HOST:PORT, ListenError if it cannot listen there.
    """

    daemon_threads = True
    request_queue_size = 2 * _MAX_REQUESTS  # with Python's default of 5, the sixth concurrent client waits 1 s

    def __init__(self, where: str, pages: Mapping[str, Callable[[], Page]]) -> None:
        try:
            host, port = split_http(where)
        except ValueError as exc:
            raise ConfigError("--http", str(exc)) from exc
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self.pages, self.is_local = pages, is_loopback(host)
        self._free = threading.Semaphore(_MAX_REQUESTS)
        try:
            super().__init__((host, port), _Handler)
        except OSError as exc:
            reason = (exc.strerror or str(exc)).lower()
            raise ListenError([f"http://{where}"], reason, hint="choose another address with --http") from exc
        self.port: int = self.server_address[1]
        threading.Thread(target=self.serve_forever, args=(0.2,), name="nedbus-http", daemon=True).start()

    def close(self) -> None:
        """Stop listening; do not wait for queued clients."""
        self._free.release(_MAX_REQUESTS)
        self.shutdown()
        self.server_close()

    def get_request(self) -> tuple[socket.socket, Any]:
        """Accept a client; if that fails, for example without free file descriptors, pause to avoid a busy loop."""
        try:
            return super().get_request()
        except OSError:
            time.sleep(_ACCEPT_PAUSE)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        """Handle a client in a thread; disconnect the client if no thread is free within 5 s."""
        if self._free.acquire(timeout=TIMINGS.http_client):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Handle a client, and release its thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """Log a disconnected client."""
        _log.debug("an HTTP client disconnected", exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    server: HttpServer
    server_version = "nedbus"
    sys_version = ""

    def handle(self) -> None:
        """Handle one request; stop receiving after the timeout, even from a client that sends byte by byte."""
        self.connection.settimeout(TIMINGS.http_client)
        deadline = threading.Timer(TIMINGS.http_client, self._stop_receiving)
        deadline.start()
        try:
            super().handle()
        finally:
            deadline.cancel()

    def do_GET(self) -> None:
        page = self._make_page(self.path.partition("?")[0])
        self.send_response(page.status)
        self.send_header("Content-Type", page.content_type)
        self.send_header("Content-Length", str(len(page.content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(page.content)

    do_HEAD = do_GET  # noqa: N815 - the name http.server calls

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        _log.debug(format, *args)

    def _make_page(self, path: str) -> Page:
        pages, is_local = self.server.pages, self.server.is_local
        if path not in pages:
            return Page.text(f"available pages: {', '.join(pages)}", status=200 if path == "/" else 404)
        host = self.headers.get("Host") or "localhost"  # every browser sends Host
        if (is_local or path not in _ANY_NAME) and not is_local_host_header(host, local=is_local):
            return Page.text(f"{path} is only served under an IP address or a name of this host", status=403)
        try:
            return pages[path]()
        except BaseException:  # noqa: BLE001 - one page, even with a panic of Zenoh, must not break the server
            _log.exception("unexpected error in page %s", path, extra=about("internal_error"))
            return Page.text("unexpected error: see the log", status=500)

    def _stop_receiving(self) -> None:
        with suppress(OSError):  # the client has disconnected
            self.connection.shutdown(socket.SHUT_RD)


def is_local_host_header(host: str, *, local: bool) -> bool:
    """Return whether the name in a Host header is one that a foreign web page cannot point to this host."""
    name = host.rpartition("]")[0][1:] if host.startswith("[") else host.partition(":")[0]
    name = name.lower().removesuffix(".")
    with suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return name == "localhost" or (not local and "." not in name) or name in _names()


@cache
def _names() -> set[str]:
    return {socket.gethostname().lower(), socket.getfqdn().lower()}
