"""Read-only HTTP server with one page per path.

It is the server of the standard library with limits. The WSGI server on top of it (wsgiref) keeps fewer promises: its
time limit restarts with each byte of a request, it joins several Host headers to one, and it writes a traceback to
stderr for each client that disconnects.
"""

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

from nedbus import limits
from nedbus.endpoints import is_loopback, split_http
from nedbus.errors import ListenError, system_reason
from nedbus.log_event import about
from nedbus.timings import TIMINGS

from .access import why_refused

_log = logging.getLogger(__name__)

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
        if faults:
            return cls.text("\n".join(faults), status=503)
        return cls.text(good)


class HttpServer(ThreadingHTTPServer):
    """Serve pages by path on HOST:PORT, in up to 16 background threads, until closed; access as in `why_refused`.

    A client has 5 s to send its request, and 5 s to read the response. If all threads are in use, a new client takes
    the thread of the client that has been sending or reading for the longest time, or waits for a page to be made.

    Raises ListenError if it cannot listen there.
    """

    daemon_threads = True
    # With Python's default of 5, the sixth concurrent client waits 1 s.
    request_queue_size = 2 * limits.HTTP_REQUESTS

    def __init__(self, where: str, pages: Mapping[str, Callable[[], Page]]) -> None:
        host, port = split_http(where)
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self.pages = pages
        self.is_local = is_loopback(host)
        self._free_threads = threading.Semaphore(limits.HTTP_REQUESTS)
        self._clients = _Clients()
        try:
            super().__init__((host, port), _Handler)
        except OSError as exc:
            reason = system_reason(exc)
            hint = "choose another address with --http"
            raise ListenError([f"http://{where}"], reason, hint=hint) from exc
        self.port: int = self.server_address[1]
        thread = threading.Thread(
            target=self.serve_forever, args=(_POLL,), name="nedbus-http", daemon=True
        )
        thread.start()

    def close(self) -> None:
        """Stop listening, and disconnect clients that are sending or reading; do not wait for queued clients."""
        self._free_threads.release(limits.HTTP_REQUESTS)
        self.shutdown()
        self.server_close()
        self._clients.disconnect(before=math.inf)

    def set_start(self, client: socket.socket, start: float) -> None:
        """Set when a client started to send its request or to read the response; inf while its page is made."""
        client.settimeout(TIMINGS.http_client)  # also effective after `close`
        self._clients.set_start(client, start)

    def service_actions(self) -> None:
        """Disconnect clients after their time limit; the base class calls this at each poll."""
        self._clients.disconnect(before=time.monotonic() - TIMINGS.http_client)

    def get_request(self) -> tuple[socket.socket, Any]:
        """Accept a client; if that fails, for example without free file descriptors, pause to avoid a busy loop."""
        try:
            return super().get_request()
        except OSError:
            time.sleep(_ACCEPT_PAUSE)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        """Handle a client in a thread; disconnect the client if no thread is free within 5 s."""
        if not self._acquire_thread():
            self.shutdown_request(request)
            return
        self.set_start(request, time.monotonic())
        super().process_request(request, client_address)

    def _acquire_thread(self) -> bool:
        """Wait up to 5 s for a free thread, and disconnect slow clients; return False if there is none."""
        is_free = self._free_threads.acquire(blocking=False)
        end = time.monotonic() + TIMINGS.http_client
        while not is_free and time.monotonic() < end:
            self._clients.disconnect(before=time.monotonic() - _GRACE, only_first=True)
            is_free = self._free_threads.acquire(timeout=_POLL)
        return is_free

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Handle a client, and release its thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free_threads.release()

    def shutdown_request(self, request: Any) -> None:
        """Close the connection of a client."""
        self._clients.remove(request)
        super().shutdown_request(request)

    def handle_error(self, request: object, client_address: object) -> None:
        """Log a disconnected client."""
        _log.debug("an HTTP client disconnected", exc_info=True)


class _Clients:
    """The connected clients, with the time at which each started to send or to read."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._starts: dict[socket.socket, float] = {}

    def set_start(self, client: socket.socket, start: float) -> None:
        with self._lock:
            self._starts[client] = start

    def remove(self, client: socket.socket) -> None:
        with self._lock:
            self._starts.pop(client, None)

    def disconnect(self, *, before: float, only_first: bool = False) -> None:
        """Disconnect the clients that started before this time, or only the one that started first."""
        with self._lock:  # a thread cannot close its connection meanwhile
            slow = [client for client, start in self._starts.items() if start < before]
            slow.sort(key=self._starts.__getitem__)
            if only_first:
                slow = slow[:1]
            for client in slow:
                del self._starts[client]
                with suppress(OSError):  # the client has disconnected
                    client.shutdown(socket.SHUT_RDWR)


class _Handler(BaseHTTPRequestHandler):
    server: HttpServer
    server_version = "nedbus"
    sys_version = ""

    def do_GET(self) -> None:
        self.server.set_start(self.connection, math.inf)
        page = self._make_page()
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

    def _make_page(self) -> Page:
        path, _, _ = self.path.partition("?")
        refusal = why_refused(path, self._values_of, is_local=self.server.is_local)
        if refusal:
            return Page.text(refusal, status=403)
        pages = self.server.pages
        if path not in pages:
            status = 200 if path == "/" else 404
            return Page.text(f"available pages: {', '.join(pages)}", status=status)
        try:
            return pages[path]()
        except BaseException:  # noqa: BLE001 - one page, even with a panic of Zenoh, must not break the server
            _log.exception("unexpected error in page %s", path, extra=about("internal_error"))
            return Page.text("unexpected error: see the log", status=500)

    def _values_of(self, name: str) -> list[str]:
        """Return the values of all headers with this name."""
        return self.headers.get_all(name, [])
