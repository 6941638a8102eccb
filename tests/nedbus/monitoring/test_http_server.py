"""The HTTP server answers any request from any client, and is read-only."""

from __future__ import annotations

import errno
import http.client
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, nullcontext, suppress
from types import SimpleNamespace

import pytest

from nedbus.monitoring import HttpServer, Page, http_server
from nedbus.timings import Timings
from tests.peers.http_client import HttpClient
from tests.waits import DEADLINE, repeating

GO, BUSY = threading.Event(), threading.Semaphore(0)
PATHS = ("/metrics", "/healthz", "/readyz", "/vehicles", "/status")


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


@pytest.fixture(scope="module")
def others() -> Iterator[tuple[HttpClient, HttpClient]]:
    """Serve the pages of a service on loopback and on all interfaces."""
    content = {path: lambda: Page.text("content") for path in PATHS}
    with closing(HttpServer("127.0.0.1:0", content)) as local, closing(HttpServer("0.0.0.0:0", content)) as public:
        yield HttpClient(local.port), HttpClient(public.port)


def test_unknown_path_returns_404_and_failing_page_500(server: HttpClient, caplog: pytest.LogCaptureFixture) -> None:
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
    ("host", "status", "elsewhere"),
    [
        ("127.0.0.1:9464", 200, 200),
        ("192.0.2.1", 200, 200),  # forwarded port
        ("[::1]:9464", 200, 200),
        ("[fe80::1]", 200, 200),
        ("localhost:1234", 200, 200),
        ("LocalHost.", 200, 200),
        (f"{socket.gethostname()}:9464", 200, 200),
        (f"{socket.getfqdn()}:9464", 200, 200),
        ("vehicle-1:9464", 403, 200),  # Docker container
        ("evil.example:9464", 403, 403),
        ("localhost.evil.example", 403, 403),
        ("127.0.0.1.evil.example", 403, 403),
        ("evil.example:9464@127.0.0.1", 403, 403),
        ("[evil.example]", 403, 403),
    ],
)
def test_foreign_host_header_is_forbidden(
    others: tuple[HttpClient, HttpClient], host: str, status: int, elsewhere: int
) -> None:
    """A foreign site that rebinds its DNS name to this host cannot read /status, or anything from a loopback server.

    A server on all interfaces serves metrics, health, readiness and vehicles under any host name.
    """
    local, public = others
    for path in PATHS:
        assert local.request(path, Host=host)[0] == status, path
        assert public.request(path, Host=host)[0] == (elsewhere if path == "/status" else 200), path
    refused = "/status is only served under an IP address or a name of this host\n"
    assert local.request("/status", Host=host)[1] == ("content\n" if status == 200 else refused)


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


@pytest.mark.parametrize(
    ("sent", "each_second"),
    [(b"", b""), (b"GET /page HTTP/1.0\r\nHost:", b""), (b"GET /", b"a"), (b"GET /large HTTP/1.0\r\n\r\n", b"")],
    ids=["no request", "half a request", "byte by byte", "response not read"],
)
def test_slow_clients_time_out(timings: Timings, sent: bytes, each_second: bytes) -> None:
    """While 16 clients stall in sending or reading, a new client is served once a stalled client times out."""
    timings.http_client = 0.5
    large = Page.text("x" * 20_000_000)  # exceeds the socket buffers
    server = HttpServer("127.0.0.1:0", {"/large": lambda: large, "/page": lambda: Page.text("a page")})
    with closing(server), ExitStack() as clients:
        slow = [
            clients.enter_context(socket.create_connection(("127.0.0.1", server.port), DEADLINE)) for _ in range(16)
        ]
        for client in slow:
            client.sendall(sent)

        def drip() -> None:
            for client in slow:
                with suppress(OSError):
                    client.sendall(each_second)

        with repeating(drip) if each_second else nullcontext():
            for _ in range(20):
                assert HttpClient(server.port).request("/page") == (200, "a page\n")


def test_close_does_not_wait_for_clients(timings: Timings) -> None:
    """The server closes at once while 16 clients do not read their responses and another client is queued."""
    timings.http_client = 10_000.0  # far beyond the deadline of this test
    made = threading.Semaphore(0)

    def make() -> Page:
        made.release()
        return Page.text("x" * 20_000_000)  # exceeds the socket buffers

    server = HttpServer("127.0.0.1:0", {"/large": make})
    with ExitStack() as clients:
        for _ in range(17):
            client = clients.enter_context(socket.create_connection(("127.0.0.1", server.port), DEADLINE))
            client.sendall(b"GET /large HTTP/1.0\r\n\r\n")
        for _ in range(16):
            assert made.acquire(timeout=DEADLINE)
        server.close()


def test_client_beyond_thread_limit_waits(server: HttpClient) -> None:
    """While 16 clients are served, another client waits; all clients get their responses."""
    with ThreadPoolExecutor(17) as pool:
        answers = []
        for _ in range(16):  # sequential: a client that has not yet sent its request may be disconnected
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
    monkeypatch.setattr(http_server, "time", SimpleNamespace(sleep=sleep))
    is_full.set()
    with closing(HttpServer("127.0.0.1:0", {"/page": lambda: Page.text("a page")})) as server:
        assert HttpClient(server.port).request("/page") == (200, "a page\n")
    assert pauses == [http_server._ACCEPT_PAUSE]
