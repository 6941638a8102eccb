"""The access rule on every path of both HTTP servers: the service's, and that of the page with its WebSocket."""

from __future__ import annotations

import gc
import re
import socket
import threading
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any, cast

import pytest
from bokeh.models.widgets import Div

import nedbus
from nedbus.monitoring import Exporter, HttpServer, Page, service_pages
from nedbus.web.server import PageOptions, WebServer
from nedbus_msgs import Selection
from tests.nedbus.web.page import in_thread
from tests.waits import DEADLINE

TEXT_PATHS = ("/metrics", "/healthz", "/readyz", "/vehicles", "/status")
ANY_NAME = ("/metrics", "/healthz", "/readyz", "/vehicles")
PAGE_PATHS = (
    "/",
    "/ws",
    "/autoload.js?bokeh-autoload-element=1000",
    "/metadata",
    "/favicon.ico",
    "/static/js/bokeh.min.js",
    "/nothing",
)
TEXTS = {path: lambda: Page.text("content") for path in TEXT_PATHS}
WEBSOCKET = (
    "Connection: Upgrade",
    "Upgrade: websocket",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: AAAA",
)


@dataclass(frozen=True)
class Server:
    """A running server; `is_local`: it listens on loopback only."""

    port: int
    is_local: bool
    is_page: bool

    @property
    def paths(self) -> tuple[str, ...]:
        """All kinds of paths."""
        return (*TEXT_PATHS, *PAGE_PATHS) if self.is_page else (*TEXT_PATHS, "/", "/nothing")

    def status(self, path: str, headers: Sequence[str], version: str = "HTTP/1.1") -> int:
        """Return the status of a request with exactly these headers; that of /ws has a valid page token."""
        if path == "/ws":
            with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/", timeout=DEADLINE) as page:
                token = re.search(r'"token":"([^"]+)"', page.read().decode())
            assert token
            headers = (*headers, *WEBSOCKET, f"Sec-WebSocket-Protocol: bokeh, {token[1]}")
        with socket.create_connection(("127.0.0.1", self.port), DEADLINE) as client:
            client.sendall("\r\n".join((f"GET {path} {version}", *headers, "", "")).encode())
            return int(client.makefile("rb").readline().split()[1])


@pytest.fixture(scope="module")
def servers() -> Iterator[list[Server]]:
    """Run both servers, on loopback and on all interfaces; the page also allows ground.example:8420."""

    def serve(host: str) -> Callable[[threading.Event, Callable[[str], object]], None]:
        def run(stop: threading.Event, on_listening: Callable[[str], object]) -> None:
            options = PageOptions(host, 0, ("ground.example:8420",))
            server = WebServer(
                options, lambda document: document.add_root(Div(text="a word")), TEXTS
            )
            on_listening(server.url)
            server.run(stop)

        return run

    with ExitStack() as running:
        # Bokeh collects garbage for each session that ends: with the objects of all tests, that takes seconds.
        gc.freeze()
        running.callback(gc.unfreeze)
        found = []
        for host in ("127.0.0.1", "0.0.0.0"):  # noqa: S104 - as in the image
            service = running.enter_context(closing(HttpServer(f"{host}:0", TEXTS)))
            url = running.enter_context(in_thread(serve(host)))
            ports = service.port, int(url.rpartition(":")[2])
            found += [Server(port, host == "127.0.0.1", port != service.port) for port in ports]
        yield found


def is_accepted(server: Server, path: str, *headers: str, version: str = "HTTP/1.1") -> bool:
    """Return whether a request is accepted; a refused one has status 403, or 400 if it is not valid HTTP."""
    status = server.status(path, headers, version)
    assert status in {101, 200, 400, 403, 404}, (server, path, headers)
    return status not in {400, 403}


def test_both_servers_have_the_tested_paths(bus: nedbus.Bus) -> None:
    """A service, an exporter and a live page serve these text pages, and no others."""
    assert tuple(service_pages(cast("Any", None))) == TEXT_PATHS
    assert tuple(Exporter(bus, Selection(), version="0").pages) == TEXT_PATHS


@pytest.mark.parametrize(
    ("host", "on_loopback", "elsewhere"),
    [
        ("127.0.0.1:9464", True, True),
        ("192.0.2.1", True, True),  # a forwarded port
        ("[::1]:9464", True, True),
        ("[fe80::1]", True, True),
        ("localhost:1234", True, True),
        ("LocalHost.", True, True),
        (f"{socket.gethostname()}:9464", True, True),
        (f"{socket.getfqdn()}:9464", True, True),
        ("vehicle-1:9464", False, True),  # a Docker container
        ("evil.example:9464", False, False),
        ("localhost.evil.example", False, False),
        ("127.0.0.1.evil.example", False, False),
    ],
)
def test_website_with_rebound_name_reads_nothing(
    servers: list[Server], host: str, on_loopback: bool, elsewhere: bool
) -> None:
    """A website whose name resolves to this host is refused on every path.

    Only /metrics, /healthz, /readyz and /vehicles are served under any name, unless the server listens on loopback.
    """
    for server in servers:
        for path in server.paths:
            is_own = on_loopback if server.is_local else elsewhere
            expected = is_own or (path in ANY_NAME and not server.is_local)
            assert is_accepted(server, path, f"Host: {host}") == expected, (server, path)


@pytest.mark.parametrize(
    "host",
    [
        "evil.example:9464@127.0.0.1",
        "[evil.example]",
        "[::1].evil.example",
        "127.0.0.1:evil.example",
        "127.0.0.1 evil.example",
        ":9464",
        "",
    ],
)
def test_malformed_host_header_is_refused(servers: list[Server], host: str) -> None:
    """A Host header that names no host is refused where a foreign name is."""
    for server in servers:
        for path in server.paths:
            if server.is_local or path not in ANY_NAME:
                assert not is_accepted(server, path, f"Host: {host}"), (server, path)


@pytest.mark.slow
def test_allowed_name_opens_every_path_of_the_page(servers: list[Server]) -> None:
    """Every path of the page accepts the names of --origin as Host and as Origin, with exactly this port."""
    for server in filter(lambda each: each.is_page, servers):
        for path in server.paths:
            name = "ground.example:8420"
            assert is_accepted(server, path, f"Host: {name}", f"Origin: http://{name}")
            assert is_accepted(server, path, "Host: 127.0.0.1:8420", f"Origin: https://{name}")
            if server.is_local or path not in ANY_NAME:
                assert not is_accepted(server, path, "Host: ground.example:8421")
            assert not is_accepted(
                server, path, "Host: 127.0.0.1:8420", "Origin: http://ground.example:8421"
            )


@pytest.mark.parametrize(
    "hosts",
    [("127.0.0.1", "evil.example"), ("evil.example", "127.0.0.1"), ("127.0.0.1", "127.0.0.1")],
)
def test_duplicated_host_header_is_refused(servers: list[Server], hosts: tuple[str, ...]) -> None:
    """A request with two Host headers is refused on every path, because a proxy may have checked the other one."""
    for server in servers:
        for path in server.paths:
            assert not is_accepted(server, path, *(f"Host: {host}" for host in hosts)), (
                server,
                path,
            )


def test_missing_host_header_is_accepted_without_origin(servers: list[Server]) -> None:
    """A request of HTTP/1.0 without a Host header, which no browser sends, is accepted unless it has an Origin."""
    for server in servers:
        for path in server.paths:
            if path != "/ws":  # needs HTTP/1.1
                assert is_accepted(server, path, version="HTTP/1.0"), (server, path)
                for origin in ("null", "http://127.0.0.1", "http://evil.example"):
                    assert not is_accepted(server, path, f"Origin: {origin}", version="HTTP/1.0"), (
                        server,
                        path,
                    )


@pytest.mark.parametrize(
    ("origins", "accepted"),
    [
        (["http://127.0.0.1:9464"], True),
        (["https://127.0.0.1:9464"], True),  # a proxy with TLS
        (["http://127.0.0.1:9465"], False),
        (["http://evil.example"], False),
        (["http://evil.example@127.0.0.1:9464"], False),
        (["http://127.0.0.1:9464.evil.example"], False),
        (["http://192.0.2.1:9464"], False),
        (["null"], False),
        ([""], False),
        (["http://127.0.0.1:9464", "http://evil.example"], False),
    ],
)
def test_request_from_page_of_other_origin_is_refused(
    servers: list[Server], origins: list[str], accepted: bool
) -> None:
    """A request whose Origin differs from its Host is refused on every path, including the WebSocket."""
    for server in servers:
        for path in server.paths:
            headers = ("Host: 127.0.0.1:9464", *(f"Origin: {origin}" for origin in origins))
            assert is_accepted(server, path, *headers) == accepted, (server, path)


@pytest.mark.parametrize(
    ("site", "kind", "accepted"),
    [
        ("cross-site", "image", False), ("same-site", "iframe", True), ("cross-site", "iframe", False),
        ("cross-site", "document", True), ("same-origin", "script", True), ("none", "document", True),
    ],
)  # fmt: skip
def test_cross_site_subresources_are_refused(
    servers: list[Server], site: str, kind: str, accepted: bool
) -> None:
    """Cross-site images, scripts and frames are refused, based on Sec-Fetch-Site; links from other sites work."""
    for server in servers:
        for path in server.paths:
            headers = ("Host: 127.0.0.1:9464", f"Sec-Fetch-Site: {site}", f"Sec-Fetch-Dest: {kind}")
            if path == "/ws" and accepted:  # neither a link nor a frame
                continue
            assert is_accepted(server, path, *headers) == accepted, (server, path)
