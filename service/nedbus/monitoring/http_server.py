"""A small HTTP server that can only be read: each path has a page, and a client can change nothing."""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Final, NamedTuple

from nedbus.errors import ListenError
from nedbus.settings import split_http

_log = logging.getLogger(__name__)

_CLIENTS: Final = 16  # that are answered at the same time
_PATIENCE: Final = 5.0  # s that a client may take to ask, and to read the answer


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

    Raises ListenError when it cannot listen there.
    """

    def __init__(self, where: str, pages: Mapping[str, Callable[[], Page]]) -> None:
        host, port = split_http(where)
        try:
            self._server = _Server((host, port), _make_handler(pages))
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
    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, where: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        self.address_family = socket.AF_INET6 if ":" in where[0] else socket.AF_INET
        self._free = threading.BoundedSemaphore(_CLIENTS)
        super().__init__(where, handler)

    def process_request(self, request: socket.socket | tuple[bytes, socket.socket], client_address: object) -> None:
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(
        self, request: socket.socket | tuple[bytes, socket.socket], client_address: object
    ) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: object, client_address: object) -> None:
        _log.debug("an HTTP client went away", exc_info=True)


def _make_handler(pages: Mapping[str, Callable[[], Page]]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = _PATIENCE
        server_version = "nedbus"
        sys_version = ""

        def do_GET(self) -> None:
            self._answer()

        def do_HEAD(self) -> None:
            self._answer()

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002
            _log.debug(format, *args)

        def _answer(self) -> None:
            page = _make_page(pages, self.path.partition("?")[0])
            self.send_response(page.status)
            self.send_header("Content-Type", page.content_type)
            self.send_header("Content-Length", str(len(page.content)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(page.content)

    return Handler


def _make_page(pages: Mapping[str, Callable[[], Page]], path: str) -> Page:
    make = pages.get(path)
    if make is None:
        return Page.text(f"there is {', '.join(pages)}", status=200 if path == "/" else 404)
    try:
        return make()
    except Exception:  # noqa: BLE001 - of one page, not of the server
        _log.exception("%s failed", path)
        return Page.text("an unexpected error: the log has it", status=500)
