"""Access to the page of `nedbus web`, and the answers to those refused; spoken by hand, without a browser."""

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
from nedbus.web.server import WebServer, Where, _log_once
from tests.nedbus.web.page import in_thread
from tests.peers.ports import free_port
from tests.peers.processes import Start
from tests.waits import DEADLINE, wait_for

PATHS = ("/", "/metrics", "/healthz")


@pytest.fixture
def url() -> Iterator[str]:
    """Serve a page of one word, and two texts."""

    def serve(stop: threading.Event, tell: Callable[[str], object]) -> None:
        texts = {path: lambda: Page.text("a text") for path in PATHS[1:]}
        where = Where("127.0.0.1", 0, ("ground.example:8420",))
        server = WebServer(where, lambda document: document.add_root(Div(text="a word")), texts)
        tell(server.url)
        server.run(stop)

    with in_thread(serve) as url:
        yield url


def status_of(url: str, method: str = "GET", **headers: str) -> int:
    request = urllib.request.Request(url, method=method, headers=headers)  # noqa: S310 - our own address
    try:
        with urllib.request.urlopen(request, timeout=DEADLINE) as answer:  # noqa: S310 - our own address
            return int(answer.status)
    except urllib.error.HTTPError as exc:
        with exc:
            return exc.code


def open_socket(url: str, origin: str) -> ClientConnection:
    """Connect to the page's socket as a page from there, with the token of a page that it made."""
    with urllib.request.urlopen(url, timeout=DEADLINE) as page:  # noqa: S310 - our own address
        token = re.search(r'"token":"([^"]+)"', page.read().decode())
    assert token
    protocols = [websockets.Subprotocol("bokeh"), websockets.Subprotocol(token[1])]
    return connect(f"{url.replace('http', 'ws')}/ws", origin=websockets.Origin(origin), subprotocols=protocols)


def answers(url: str, origin: str) -> bool:
    """Tell whether the page's socket says anything to a page from there."""
    try:
        with open_socket(url, origin) as connection:
            return bool(connection.recv(timeout=DEADLINE))
    except (websockets.InvalidHandshake, websockets.ConnectionClosed):
        return False


def test_foreign_pages_get_nothing(url: str) -> None:
    """A page of somebody else, also one whose name leads here, gets neither the page nor its socket nor metrics."""
    host = url.removeprefix("http://")
    for path in PATHS:
        assert status_of(url + path) == 200
        assert status_of(url + path, Host="ground.example:8420") == 200
        assert status_of(url + path, Host="evil.example:8420") == 403
        for origin in ("http://evil.example", "http://192.0.2.1"):
            assert status_of(url + path, Host=host, Origin=origin) == 403
        assert status_of(url + path, Host="localhost:9000", Origin="http://localhost:9000") == 200, "a forwarded port"
    for origin in (
        "http://evil.example",
        f"http://evil.example@{host}",
        "null",
        f"http://{host}.evil.example",
        "http://192.0.2.1",
    ):
        assert not answers(url, origin)
    assert answers(url, url)
    assert answers(url, "http://ground.example:8420")
    assert status_of(url + "/metrics", Host="localhost" + host.removeprefix("127.0.0.1")) == 200


def test_nothing_can_be_sent_and_bodies_are_not_kept(url: str) -> None:
    """Only reading is answered; who announces 100 MB is refused before it has sent them, whatever name it came by."""
    for path, method in product(PATHS, ("POST", "PUT", "DELETE")):
        assert status_of(url + path, method=method) in {403, 405}
    bodies = ("Content-Length: 100000000\r\n\r\n", "Transfer-Encoding: chunked\r\n\r\n5f5e100\r\n")
    for body, host, method in product(bodies, (url.removeprefix("http://"), "evil.example"), ("POST", "PUT", "GET")):
        with socket.create_connection(("127.0.0.1", int(url.rpartition(":")[2])), DEADLINE) as client:
            client.sendall(f"{method} / HTTP/1.1\r\nHost: {host}\r\n{body}".encode())
            assert client.recv(1000).startswith(b"HTTP/1.1 400 ")


def test_browser_says_little_at_a_time(url: str) -> None:
    """A message on the socket of a page has a limit of 1 MiB, which ends it."""
    with open_socket(url, url) as connection:

        def is_closed() -> bool:
            try:
                with suppress(TimeoutError):
                    connection.recv(timeout=0.1)
            except websockets.ConnectionClosed:
                return True
            return False

        connection.recv(timeout=DEADLINE)  # a page that has just been opened takes nothing yet
        connection.send(" " * 2**20)
        assert not is_closed()
        with suppress(websockets.ConnectionClosed):  # it may end while this is being sent
            connection.send(" " * (2**20 + 1))
        wait_for(is_closed, what="the end of the page")


@pytest.mark.filterwarnings("ignore:There is no current event loop")  # of Bokeh's client
def test_too_many_viewers_are_told(monkeypatch: pytest.MonkeyPatch, url: str) -> None:
    """One page more than the limit, which is 1 here, says so instead of taking the memory of all."""
    monkeypatch.setattr("nedbus.web.server.MAX_VIEWERS", 1)
    for said in ("a word", "limit of 1 open pages reached: close one"):
        session = pull_session(url=url)
        assert [root.text for root in session.document.roots if isinstance(root, Div)] == [said]


def test_parts_of_foreign_pages_are_refused(url: str) -> None:
    """An image, a script or a frame of another site gets nothing, where a browser names it; a link to here works."""
    for path, (site, kind, status) in product(
        PATHS,
        [
            ("cross-site", "image", 403), ("same-site", "iframe", 200), ("cross-site", "iframe", 403),
            ("cross-site", "document", 200), ("same-origin", "script", 200), ("none", "document", 200),
        ],
    ):  # fmt: skip
        assert status_of(url + path, **{"Sec-Fetch-Site": site, "Sec-Fetch-Dest": kind}) == status


@pytest.mark.filterwarnings("ignore:There is no current event loop")  # of Bokeh's client
def test_requests_without_a_socket_take_no_place(monkeypatch: pytest.MonkeyPatch, url: str) -> None:
    """Ten requests of a program that opens no WebSocket leave the one place, and the pages made for them are few."""
    monkeypatch.setattr("nedbus.web.server.MAX_VIEWERS", 1)
    for _ in range(10):
        assert status_of(url) == 200
    session = pull_session(url=url)
    assert [root.text for root in session.document.roots if isinstance(root, Div)] == ["a word"]
    monkeypatch.setattr("nedbus.web.server._MAX_WAITING", 0)
    refused = pull_session(url=url)
    assert [root.text for root in refused.document.roots if isinstance(root, Div)] != ["a word"]


@pytest.fixture
def tight(monkeypatch: pytest.MonkeyPatch, timings: Timings) -> None:
    """Shorten the limits of a server that is started later."""
    timings.page_request = 0.3
    monkeypatch.setattr("nedbus.web.server._MAX_CONNECTIONS", 3)
    _log_once.cache_clear()


@pytest.mark.parametrize("start", ["", "GET / HTTP/1.1\r\nHost: ", "POST / HTTP/1.1\r\nContent-Length: 9\r\n\r\nx"])
@pytest.mark.usefixtures("tight")
def test_half_a_request_is_timed_out(url: str, start: str) -> None:
    """A client that sends nothing, half a header or half a body is disconnected."""
    with socket.create_connection(("127.0.0.1", int(url.rpartition(":")[2])), DEADLINE) as client:
        client.sendall(start.encode())
        while client.recv(1000):
            pass


@pytest.mark.usefixtures("tight")
def test_connections_beyond_the_limit_are_closed(url: str, caplog: pytest.LogCaptureFixture) -> None:
    """Each connection takes a file: those beyond the limit are closed at once, logged once, and later ones served."""
    where = ("127.0.0.1", int(url.rpartition(":")[2]))
    open_files = [socket.create_connection(where, DEADLINE) for _ in range(10)]
    wait_for(lambda: "limit of connections reached" in caplog.text, what="the warning")
    for each in open_files:
        with each:
            each.recv(1)  # the end
    assert status_of(url) == 200
    assert caplog.text.count("limit of connections reached, further ones are refused: 3") == 1


@pytest.mark.parametrize("protocols", [[], ["bokeh"], ["bokeh", "e30"], ["other", "e30"]])
def test_socket_without_a_token_leaves_no_traceback(
    url: str, protocols: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    """A WebSocket without the subprotocol or the token of a page is refused."""
    offered = [websockets.Subprotocol(each) for each in protocols]
    with pytest.raises(websockets.InvalidStatus, match="403"):
        connect(f"{url.replace('http', 'ws')}/ws", origin=websockets.Origin(url), subprotocols=offered or None)
    assert not caplog.records


def test_tab_that_closes_amid_a_message_leaves_no_traceback(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A tab may close while its message waits for the document, which an update has on a busy host."""
    ran: list[None] = []
    is_free, is_waiting = threading.Event(), threading.Event()

    class Fast(PeriodicCallback):
        """A job of Bokeh's server, a hundred times a second."""

        def __init__(self, job: Callable[[], Any], _: float) -> None:
            def run() -> Any:
                ran.append(None)
                return job()

            super().__init__(run, 10)

    async def update() -> None:
        is_waiting.set()
        while not is_free.is_set():
            await asyncio.sleep(0.01)

    said = TextInput()

    def open_page(document: Document) -> None:
        document.add_root(said)
        document.add_periodic_callback(cast("Any", update), 50)  # Bokeh awaits it

    def serve(stop: threading.Event, tell: Callable[[str], object]) -> None:
        server = WebServer(Where("127.0.0.1", 0), open_page, {})
        tell(server.url)
        server.run(stop)

    monkeypatch.setattr("bokeh.server.tornado.PeriodicCallback", Fast)
    changed = {"kind": "ModelChanged", "model": {"id": said.id}, "attr": "value", "new": "x"}
    with in_thread(serve) as url:
        with open_socket(url, url) as connection:
            connection.recv(timeout=DEADLINE)
            assert is_waiting.wait(DEADLINE)
            for part in ({"msgid": "1", "msgtype": "PATCH-DOC"}, {}, {"events": [changed]}):
                connection.send(json.dumps(part))
            connection.socket.shutdown(socket.SHUT_RDWR)
        before = len(ran)
        wait_for(lambda: len(ran) > before + 50, what="the jobs of the server")
        is_free.set()
        wait_for(lambda: said.value == "x", what="the message")
        before = len(ran)
        wait_for(lambda: len(ran) > before + 20, what="the end of the connection")
    assert not caplog.records


def test_listening_for_others_says_what_that_means(run_nedbus: Start, endpoint: str) -> None:
    """With --http 0.0.0.0 the command says who can look, --origin adds a name, and Ctrl-C ends it."""
    port = free_port()
    url, listen = f"http://127.0.0.1:{port}", f"--http=0.0.0.0:{port}"
    process = run_nedbus("web", "-c", endpoint, listen, "--origin", "ground.example:8420", coverage=False)
    wait_for(lambda: "no password protects" in process.err, what="the warning")
    assert status_of(f"{url}/healthz", Host="evil.example") == 200
    assert status_of(url, Host="ground.example:8420") == 200
    assert status_of(url, Host="evil.example:8420") == 403
    process.signal(signal.SIGINT)
    assert process.wait() in {0, 130}
    assert "Traceback" not in process.err
