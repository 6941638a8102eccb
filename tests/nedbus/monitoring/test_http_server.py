"""The HTTP server answers any request from any client, and is read-only."""

from __future__ import annotations

import errno
import http.client
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, nullcontext, suppress
from types import SimpleNamespace

import pytest

from nedbus import limits
from nedbus.monitoring import HttpServer, Page, http_server
from nedbus.timings import Timings
from tests.peers.http_client import HttpClient
from tests.waits import DEADLINE, repeating, wait_for

GO, BUSY = threading.Event(), threading.Semaphore(0)


@pytest.fixture(scope="module")
def server() -> Iterator[HttpClient]:
    """Serve a page, two that raise, and one that blocks until GO is set."""

    def fail() -> Page:
        raise RuntimeError("broken page")

    def panic() -> Page:
        raise BaseException("panic")  # noqa: TRY002 - like pyo3's PanicException, it is not an Exception

    def wait() -> Page:
        BUSY.release()
        return Page.text(str(GO.wait(DEADLINE)))

    pages = {"/page": lambda: Page.text("a page"), "/fails": fail, "/panics": panic, "/waits": wait}
    with closing(HttpServer("127.0.0.1:0", pages)) as server:
        yield HttpClient(server.port)


def test_unknown_path_returns_404_and_failing_page_500(
    server: HttpClient, caplog: pytest.LogCaptureFixture
) -> None:
    """404 and / list the available pages; a page that raises, even a panic, returns 500 and is logged."""
    assert server.request("/other") == (404, "available pages: /page, /fails, /panics, /waits\n")
    assert server.request("/")[0] == 200
    assert server.request("/fails") == (500, "unexpected error: see the log\n")
    assert "broken page" in caplog.text
    assert server.request("/panics") == (500, "unexpected error: see the log\n")
    assert server.request("/page") == (200, "a page\n")


def test_only_get_and_head_are_allowed(server: HttpClient) -> None:
    """Methods other than GET and HEAD return 501; HEAD returns the headers of GET without content."""
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "BREW"):
        assert server.request("/page", method)[0] == 501, method
    assert server.request("/page", "HEAD") == (200, "")
    with closing(http.client.HTTPConnection(server.where, timeout=DEADLINE)) as connection:
        connection.request("HEAD", "/page")
        headers = connection.getresponse().headers
    assert (headers["Content-Length"], headers["X-Content-Type-Options"]) == ("7", "nosniff")


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"\x16\x03\x01 a TLS handshake\r\n\r\n", b"Error code: 400"),
        (b"GET\r\n\r\n", b"Error code: 400"),
        (b"GET /page HTTP/9.9\r\n\r\n", b"Error code: 505"),
        (b"GET /" + 70_000 * b"x" + b" HTTP/1.0\r\n\r\n", b"HTTP/1.0 414 "),
        (b"GET /page HTTP/1.0\r\n" + 200 * b"a: b\r\n" + b"\r\n", b"HTTP/1.0 431 "),
        (b"GET /page HTTP/1.0\r\na:" + 70_000 * b"x" + b"\r\n\r\n", b"HTTP/1.0 431 "),
        (b"GET /\xff\x00<script> HTTP/1.0\r\n\r\n", b"HTTP/1.0 404 "),
    ],
)
def test_malformed_requests_are_rejected(
    server: HttpClient, caplog: pytest.LogCaptureFixture, sent: bytes, answer: bytes
) -> None:
    """A malformed request gets an HTTP error and no log line; the next client is served."""
    with socket.create_connection(("127.0.0.1", server.port), DEADLINE) as client:
        client.sendall(sent)
        assert answer in client.recv(10_000)
    assert server.request("/page") == (200, "a page\n")
    assert not caplog.records


STALLED = pytest.mark.parametrize(
    ("sent", "each_second"),
    [
        (b"", b""),
        (b"GET /page HTTP/1.0\r\nHost:", b""),
        (b"GET /", b"a"),
        (b"GET /large HTTP/1.0\r\n\r\n", b""),
    ],
    ids=["no request", "half a request", "byte by byte", "response not read"],
)


@contextmanager
def stalled(
    count: int, sent: bytes, each_second: bytes
) -> Iterator[tuple[HttpServer, list[socket.socket]]]:
    """Run a server with clients that stall in sending or reading."""
    large = Page.text("x" * 20_000_000)  # exceeds the socket buffers
    server = HttpServer(
        "127.0.0.1:0", {"/large": lambda: large, "/page": lambda: Page.text("a page")}
    )
    with closing(server), ExitStack() as clients:
        where = "127.0.0.1", server.port
        slow = [
            clients.enter_context(socket.create_connection(where, DEADLINE)) for _ in range(count)
        ]

        def send(data: bytes) -> None:
            for client in slow:
                with suppress(OSError):
                    client.sendall(data)

        send(sent)
        with repeating(lambda: send(each_second)) if each_second else nullcontext():
            yield server, slow


def threads_since(before: set[threading.Thread]) -> int:
    """Return the number of threads started since."""
    return len({*threading.enumerate()} - before)


@pytest.mark.slow
@STALLED
def test_stalled_clients_delay_no_others(timings: Timings, sent: bytes, each_second: bytes) -> None:
    """While more clients than threads stall in sending or reading, others are served before any of those times out."""
    timings.http_client = 10_000.0  # far beyond the deadline of this test
    before = {*threading.enumerate()}
    with stalled(40, sent, each_second) as (server, _):
        for _ in range(20):
            assert HttpClient(server.port).request("/page") == (200, "a page\n")
            # accepting, and sending bytes
            assert threads_since(before) <= 2 + limits.HTTP_REQUESTS


@STALLED
def test_slow_clients_time_out(
    monkeypatch: pytest.MonkeyPatch, timings: Timings, sent: bytes, each_second: bytes
) -> None:
    """A client that stalls in sending its request or reading the response is disconnected, and its thread ends."""
    timings.http_client = 0.3
    ended, handle = threading.Semaphore(0), HttpServer.process_request_thread

    def handle_and_count(server: HttpServer, request: socket.socket, address: object) -> None:
        handle(server, request, address)
        ended.release()

    monkeypatch.setattr(HttpServer, "process_request_thread", handle_and_count)
    with stalled(limits.HTTP_REQUESTS, sent, each_second):
        for _ in range(limits.HTTP_REQUESTS):
            assert ended.acquire(timeout=DEADLINE)


@pytest.mark.slow
def test_close_does_not_wait_for_clients(timings: Timings) -> None:
    """The server closes at once while pages for 16 clients are made, and another client is queued."""
    timings.http_client = 10_000.0  # far beyond the deadline of this test
    made, go = threading.Semaphore(0), threading.Event()

    def make() -> Page:
        made.release()
        go.wait(DEADLINE)
        return Page.text("x" * 20_000_000)  # exceeds the socket buffers

    server = HttpServer("127.0.0.1:0", {"/large": make})
    with ExitStack() as clients:
        for _ in range(17):
            client = clients.enter_context(
                socket.create_connection(("127.0.0.1", server.port), DEADLINE)
            )
            client.sendall(b"GET /large HTTP/1.0\r\n\r\n")
        for _ in range(16):
            assert made.acquire(timeout=DEADLINE)
        server.close()
        go.set()


@pytest.mark.slow
def test_close_disconnects_stalled_clients(timings: Timings) -> None:
    """When the server closes, clients that do not read their responses are disconnected, and their threads end."""
    timings.http_client = 10_000.0  # far beyond the deadline of this test
    before = {*threading.enumerate()}
    with stalled(16, b"GET /large HTTP/1.0\r\n\r\n", b"") as (server, _):
        wait_for(lambda: threads_since(before) == 17, what="the requests")
        server.close()
        wait_for(lambda: threads_since(before) == 0, what="the end of all requests")


def test_client_beyond_thread_limit_waits(server: HttpClient) -> None:
    """While 16 clients are served, another client waits; all clients get their responses."""
    with ThreadPoolExecutor(17) as pool:
        answers = []
        # sequential: a client that has not yet sent its request may be disconnected
        for _ in range(16):
            answers.append(pool.submit(server.request, "/waits"))
            assert BUSY.acquire(timeout=DEADLINE)
        answers.append(pool.submit(server.request, "/waits"))
        assert not BUSY.acquire(timeout=0.2)
        GO.set()
        assert {answer.result(DEADLINE) for answer in answers} == {(200, "True\n")}


def test_server_pauses_without_free_file_descriptor(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the limit of open files a client stays queued, and the server pauses before it retries."""
    pauses: list[float] = []
    is_full = threading.Event()
    accept = socket.socket.accept

    def try_accept(listening: socket.socket) -> tuple[socket.socket, object]:
        if is_full.is_set():
            raise OSError(errno.EMFILE, "too many open files")
        return accept(listening)

    def sleep(seconds: float) -> None:
        pauses.append(seconds)
        is_full.clear()

    monkeypatch.setattr(socket.socket, "accept", try_accept)
    monkeypatch.setattr(http_server, "time", SimpleNamespace(sleep=sleep, monotonic=time.monotonic))
    is_full.set()
    with closing(HttpServer("127.0.0.1:0", {"/page": lambda: Page.text("a page")})) as server:
        assert HttpClient(server.port).request("/page") == (200, "a page\n")
    assert pauses == [http_server._ACCEPT_PAUSE]
