"""Access control and limits of the page's server: HTTP and WebSocket requests made by hand, without a browser."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import product
from typing import Any, cast

import pytest
import websockets
from bokeh.client import pull_session
from bokeh.document import Document
from bokeh.models.widgets import Div, TextInput
from tornado.ioloop import PeriodicCallback
from websockets.sync.client import ClientConnection, connect

from nedbus.monitoring import Page
from nedbus.timings import Timings
from nedbus.web.server import PageOptions, WebServer, _log_once
from tests.nedbus.web.page import in_thread, serving_live
from tests.peers.ports import free_port
from tests.peers.processes import Start
from tests.waits import DEADLINE, wait_for

PATHS = ("/", "/metrics", "/healthz")


@pytest.fixture
def url() -> Iterator[str]:
    """Serve a minimal page and two text pages."""

    def serve(stop: threading.Event, on_listening: Callable[[str], object]) -> None:
        texts = {path: lambda: Page.text("a text") for path in PATHS[1:]}
        options = PageOptions("127.0.0.1", 0, ("ground.example:8420",))
        server = WebServer(options, lambda document: document.add_root(Div(text="a word")), texts)
        on_listening(server.url)
        server.run(stop)

    with in_thread(serve) as url:
        yield url


def status_of(url: str, method: str = "GET", **headers: str) -> int:
    request = urllib.request.Request(url, method=method, headers=headers)  # noqa: S310 - our own address
    try:
        with urllib.request.urlopen(request, timeout=DEADLINE) as response:  # noqa: S310 - our own address
            return int(response.status)
    except urllib.error.HTTPError as exc:
        with exc:
            return exc.code


def open_socket(url: str, origin: str) -> ClientConnection:
    """Open the WebSocket from this origin, with the token of a new page."""
    with urllib.request.urlopen(url, timeout=DEADLINE) as page:  # noqa: S310 - our own address
        token = re.search(r'"token":"([^"]+)"', page.read().decode())
    assert token
    protocols = [websockets.Subprotocol("bokeh"), websockets.Subprotocol(token[1])]
    return connect(
        f"{url.replace('http', 'ws')}/ws", origin=websockets.Origin(origin), subprotocols=protocols
    )


def is_answered(url: str, origin: str) -> bool:
    """Return whether the WebSocket sends anything to a page from this origin."""
    try:
        with open_socket(url, origin) as connection:
            return bool(connection.recv(timeout=DEADLINE))
    except (websockets.InvalidHandshake, websockets.ConnectionClosed):
        return False


def test_pages_of_other_origins_get_no_websocket(url: str) -> None:
    """The WebSocket sends nothing to a page of another site; it does to this page, and to one of --origin."""
    host = url.removeprefix("http://")
    for origin in (
        "http://evil.example",
        f"http://evil.example@{host}",
        "null",
        f"http://{host}.evil.example",
        "http://192.0.2.1",
    ):
        assert not is_answered(url, origin)
    assert is_answered(url, url)
    assert is_answered(url, "http://ground.example:8420")


@pytest.mark.slow
def test_page_has_the_viewport_of_a_phone(endpoint: str) -> None:
    """Without a viewport, a phone lays the page out as on a desktop instead of in a single column."""
    with serving_live(endpoint) as url, urllib.request.urlopen(url, timeout=DEADLINE) as page:  # noqa: S310 - our own
        assert '<meta name="viewport" content="width=device-width' in page.read().decode()


def test_head_of_a_text_page_has_no_body(url: str) -> None:
    """HEAD returns the status and Content-Length of GET, as probes and `curl -I` expect."""
    host = url.removeprefix("http://")
    address = ("127.0.0.1", int(url.rpartition(":")[2]))
    length = len(Page.text("a text").content)
    for path in PATHS[1:]:
        request = f"HEAD {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n"
        with socket.create_connection(address, DEADLINE) as client:
            client.sendall(request.encode())
            answer = b"".join(iter(lambda: client.recv(1000), b"")).decode()
        assert answer.startswith("HTTP/1.1 200 ")
        assert f"\r\nContent-Length: {length}\r\n" in answer
        assert answer.endswith("\r\n\r\n")
    assert status_of(url, method="HEAD", Host="evil.example") == 403


def test_write_methods_and_large_bodies_are_refused(url: str) -> None:
    """POST, PUT and DELETE are refused; a body of 100 MB is refused before it is sent, whatever the Host header."""
    for path, method in product(PATHS, ("POST", "PUT", "DELETE")):
        assert status_of(url + path, method=method) in {403, 405}
        assert status_of(url + path, method=method, Host="evil.example") == 403
    bodies = ("Content-Length: 100000000\r\n\r\n", "Transfer-Encoding: chunked\r\n\r\n5f5e100\r\n")
    for body, host, method in product(
        bodies, (url.removeprefix("http://"), "evil.example"), ("POST", "PUT", "GET")
    ):
        with socket.create_connection(
            ("127.0.0.1", int(url.rpartition(":")[2])), DEADLINE
        ) as client:
            client.sendall(f"{method} / HTTP/1.1\r\nHost: {host}\r\n{body}".encode())
            assert client.recv(1000).startswith(b"HTTP/1.1 400 ")


def test_oversized_websocket_message_closes_the_connection(url: str) -> None:
    """A WebSocket message above 1 MiB closes the connection."""
    with open_socket(url, url) as connection:

        def is_closed() -> bool:
            try:
                with suppress(TimeoutError):
                    connection.recv(timeout=0.1)
            except websockets.ConnectionClosed:
                return True
            return False

        connection.recv(timeout=DEADLINE)  # a new page is not ready for messages yet
        connection.send(" " * 2**20)
        assert not is_closed()
        with suppress(websockets.ConnectionClosed):  # the server may close while this is being sent
            connection.send(" " * (2**20 + 1))
        wait_for(is_closed, what="the connection to close")


@pytest.mark.filterwarnings("ignore:There is no current event loop")  # of Bokeh's client
def test_page_above_the_viewer_limit_shows_a_notice(
    monkeypatch: pytest.MonkeyPatch, url: str
) -> None:
    """A page beyond the maximum number of open pages, here 1, shows only a notice."""
    monkeypatch.setattr("nedbus.limits.PAGES", 1)
    for text in ("a word", "limit of 1 open pages reached: close one"):
        session = pull_session(url=url)
        assert [root.text for root in session.document.roots if isinstance(root, Div)] == [text]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:There is no current event loop")  # of Bokeh's client
def test_requests_without_websocket_do_not_count_as_viewers(
    monkeypatch: pytest.MonkeyPatch, url: str
) -> None:
    """Pages requested without opening a WebSocket do not count as viewers, but have a separate limit."""
    monkeypatch.setattr("nedbus.limits.PAGES", 1)
    for _ in range(10):
        assert status_of(url) == 200
    session = pull_session(url=url)
    assert [root.text for root in session.document.roots if isinstance(root, Div)] == ["a word"]
    monkeypatch.setattr("nedbus.limits.WAITING_PAGES", 0)
    refused = pull_session(url=url)
    assert [root.text for root in refused.document.roots if isinstance(root, Div)] != ["a word"]


@pytest.fixture
def low_limits(monkeypatch: pytest.MonkeyPatch, timings: Timings) -> None:
    """Lower the limits of the server that `url` starts."""
    timings.page_request = 0.3
    monkeypatch.setattr("nedbus.limits.PAGE_CONNECTIONS", 3)
    _log_once.cache_clear()


@pytest.mark.parametrize(
    "start", ["", "GET / HTTP/1.1\r\nHost: ", "POST / HTTP/1.1\r\nContent-Length: 9\r\n\r\nx"]
)
@pytest.mark.usefixtures("low_limits")
def test_incomplete_request_times_out(url: str, start: str) -> None:
    """A client that sends nothing, part of a header or part of a body is disconnected."""
    with socket.create_connection(("127.0.0.1", int(url.rpartition(":")[2])), DEADLINE) as client:
        client.sendall(start.encode())
        while client.recv(1000):
            pass


@pytest.mark.usefixtures("low_limits")
def test_connections_above_the_limit_are_closed(url: str, caplog: pytest.LogCaptureFixture) -> None:
    """Connections above the limit are closed at once and logged once; later connections are served."""
    where = ("127.0.0.1", int(url.rpartition(":")[2]))
    connections = [socket.create_connection(where, DEADLINE) for _ in range(10)]
    wait_for(lambda: "connections reached" in caplog.text, what="the warning")
    for each in connections:
        with each:
            each.recv(1)  # until closed
    assert status_of(url) == 200
    assert caplog.text.count("limit of 3 connections reached: further connections are closed") == 1


@pytest.mark.parametrize("protocols", [[], ["bokeh"], ["bokeh", "e30"], ["other", "e30"]])
def test_websocket_without_token_is_refused_without_traceback(
    url: str, protocols: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    """A WebSocket without the subprotocol or a valid page token is refused, and nothing is logged."""
    offered = [websockets.Subprotocol(each) for each in protocols]
    with pytest.raises(websockets.InvalidStatus, match="403"):
        connect(
            f"{url.replace('http', 'ws')}/ws",
            origin=websockets.Origin(url),
            subprotocols=offered or None,
        )
    assert not caplog.records


def test_disconnect_during_a_message_logs_no_traceback(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A tab that closes while its message waits for the document lock, which an update holds, logs nothing."""
    ran: list[None] = []
    is_free, is_waiting = threading.Event(), threading.Event()

    class FastCallback(PeriodicCallback):
        """A periodic callback of Bokeh's server that runs at 100 Hz."""

        def __init__(self, job: Callable[[], Any], _: float) -> None:
            def run() -> Any:
                ran.append(None)
                return job()

            super().__init__(run, 10)

    async def update() -> None:
        is_waiting.set()
        while not is_free.is_set():
            await asyncio.sleep(0.01)

    field = TextInput()

    def open_page(document: Document) -> None:
        document.add_root(field)
        document.add_periodic_callback(cast("Any", update), 50)  # Bokeh awaits it

    def serve(stop: threading.Event, on_listening: Callable[[str], object]) -> None:
        server = WebServer(PageOptions("127.0.0.1", 0), open_page, {})
        on_listening(server.url)
        server.run(stop)

    monkeypatch.setattr("bokeh.server.tornado.PeriodicCallback", FastCallback)
    changed = {"kind": "ModelChanged", "model": {"id": field.id}, "attr": "value", "new": "x"}
    with in_thread(serve) as url:
        with open_socket(url, url) as connection:
            connection.recv(timeout=DEADLINE)
            assert is_waiting.wait(DEADLINE)
            for part in ({"msgid": "1", "msgtype": "PATCH-DOC"}, {}, {"events": [changed]}):
                connection.send(json.dumps(part))
            connection.socket.shutdown(socket.SHUT_RDWR)
        before = len(ran)
        wait_for(lambda: len(ran) > before + 50, what="the callbacks of the server")
        is_free.set()
        wait_for(lambda: field.value == "x", what="the message")
        before = len(ran)
        wait_for(lambda: len(ran) > before + 20, what="the end of the connection")
    assert not caplog.records


@pytest.mark.slow
def test_listening_on_all_interfaces_warns(run_nedbus: Start, endpoint: str) -> None:
    """With --http 0.0.0.0 the command warns about missing authentication; --origin allows a name; Ctrl-C stops it."""
    port = free_port()
    url, listen = f"http://127.0.0.1:{port}", f"--http=0.0.0.0:{port}"
    process = run_nedbus(
        "web", "-c", endpoint, listen, "--origin", "ground.example:8420", coverage=False
    )
    wait_for(lambda: "has no password" in process.err, what="the warning")
    assert status_of(f"{url}/healthz", Host="prometheus.example") == 200
    assert status_of(f"{url}/status", Host="ground.example:8420") == 200
    assert status_of(f"{url}/status", Host="evil.example:8420") == 403
    assert status_of(url, Host="ground.example:8420") == 200
    assert status_of(url, Host="evil.example:8420") == 403
    process.signal(signal.SIGINT)
    assert process.wait() in {0, 130}
    assert "Traceback" not in process.err
