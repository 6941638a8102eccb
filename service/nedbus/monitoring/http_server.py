"""Read-only HTTP server with one page per path."""

from __future__ import annotations

import json
import logging
import math
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final, NamedTuple

from nedbus.endpoints import is_loopback, split_http
from nedbus.errors import ListenError
from nedbus.log_event import about
from nedbus.timings import TIMINGS

from .access import why_refused

_log = logging.getLogger(__name__)

_MAX_REQUESTS: Final = 16  # concurrent
_POLL: Final = 0.1  # s
_GRACE: Final = 0.2  # s to send a request or read a response, even if all threads are in use
_ACCEPT_PAUSE: Final = 0.2  # s


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
    """Serve pages by path on HOST:PORT, in up to 16 background threads, until closed; access as in `why_refused`.

    A client has 5 s to send its request, and 5 s to read the response. If all threads are in use, a new client takes
    the thread of the client that has been sending or reading for the longest time, or waits for a page to be made.

    Raises ListenError if it cannot listen there.
    """

    daemon_threads = True
    # with Python's default of 5, the sixth concurrent client waits 1 s
    request_queue_size = 2 * _MAX_REQUESTS

    def __init__(self, where: str, pages: Mapping[str, Callable[[], Page]]) -> None:
        host, port = split_http(where)
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self.pages, self.is_local = pages, is_loopback(host)
        self._free = threading.Semaphore(_MAX_REQUESTS)
        self._lock = threading.Lock()
        self._starts: dict[socket.socket, float] = {}  # see `set_start`
        try:
            super().__init__((host, port), _Handler)
        except OSError as exc:
            reason = (exc.strerror or str(exc)).lower()
            raise ListenError(
                [f"http://{where}"], reason, hint="choose another address with --http"
            ) from exc
        self.port: int = self.server_address[1]
        threading.Thread(
            target=self.serve_forever, args=(_POLL,), name="nedbus-http", daemon=True
        ).start()

    def close(self) -> None:
        """Stop listening, and disconnect clients that are sending or reading; do not wait for queued clients."""
        self._free.release(_MAX_REQUESTS)
        self.shutdown()
        self.server_close()
        self._disconnect(before=math.inf)

    def set_start(self, client: socket.socket, start: float) -> None:
        """Set when a client started to send its request or to read the response; inf while its page is made."""
        client.settimeout(TIMINGS.http_client)  # also effective after `close`
        with self._lock:
            self._starts[client] = start

    def service_actions(self) -> None:
        """Disconnect clients after their time limit; the base class calls this at each poll."""
        self._disconnect(before=time.monotonic() - TIMINGS.http_client)

    def get_request(self) -> tuple[socket.socket, Any]:
        """Accept a client; if that fails, for example without free file descriptors, pause to avoid a busy loop."""
        try:
            return super().get_request()
        except OSError:
            time.sleep(_ACCEPT_PAUSE)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        """Handle a client in a thread; disconnect the client if no thread is free within 5 s."""
        is_free, end = self._free.acquire(blocking=False), time.monotonic() + TIMINGS.http_client
        while not is_free and time.monotonic() < end:
            self._disconnect(before=time.monotonic() - _GRACE, limit=1)
            is_free = self._free.acquire(timeout=_POLL)
        if not is_free:
            self.shutdown_request(request)
            return
        self.set_start(request, time.monotonic())
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Handle a client, and release its thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def shutdown_request(self, request: Any) -> None:
        """Close the connection of a client."""
        with self._lock:
            self._starts.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: object, client_address: object) -> None:
        """Log a disconnected client."""
        _log.debug("an HTTP client disconnected", exc_info=True)

    def _disconnect(self, *, before: float, limit: int = _MAX_REQUESTS) -> None:
        """Disconnect up to `limit` clients that started to send or read before this time, the earliest first."""
        with self._lock:  # a thread cannot close its connection meanwhile
            slow = [client for client, start in self._starts.items() if start < before]
            for client in sorted(slow, key=self._starts.__getitem__)[:limit]:
                del self._starts[client]
                with suppress(OSError):  # the client has disconnected
                    client.shutdown(socket.SHUT_RDWR)


class _Handler(BaseHTTPRequestHandler):
    server: HttpServer
    server_version = "nedbus"
    sys_version = ""

    def do_GET(self) -> None:
        self.server.set_start(self.connection, math.inf)
        page = self._make_page(self.path.partition("?")[0])
        self.server.set_start(self.connection, time.monotonic())
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
        pages, headers = self.server.pages, self.headers
        if refusal := why_refused(
            path, lambda name: headers.get_all(name, []), is_local=self.server.is_local
        ):
            return Page.text(refusal, status=403)
        if path not in pages:
            return Page.text(
                f"available pages: {', '.join(pages)}", status=200 if path == "/" else 404
            )
        try:
            return pages[path]()
        except BaseException:  # noqa: BLE001 - one page, even with a panic of Zenoh, must not break the server
            _log.exception("unexpected error in page %s", path, extra=about("internal_error"))
            return Page.text("unexpected error: see the log", status=500)
