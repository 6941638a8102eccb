"""`nedbus web` in a real browser: what a person sees of vehicles, of failures, and of what a hostile peer sends."""

from __future__ import annotations

import json
import queue
import re
import signal
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import pytest
import websockets
import zenoh
from playwright.sync_api import Browser
from websockets.sync.client import ClientConnection, connect

import nedbus
from nedbus.recording import RecordingWriter
from nedbus.web import Where, serve_live
from nedbus_msgs import Address, Provenance, Selection
from nedbus_msgs.arrays import to_array
from tests.browser import PATIENCE, Tab, browser, open_tabs
from tests.conftest import DEADLINE, Process, Start, free_endpoint, message, wait_for, wait_for_reader

from .test_secure import configured, pki, secure

__all__ = ["browser", "configured", "pki", "secure"]  # fixtures

VLP = "vehicle_local_position"
HOSTILE = "<img src=x onerror=window.hacked=1><script>window.hacked=1</script>"
VALID = dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"), True) | dict.fromkeys(
    ("x", "y", "z", "vx", "vy", "vz", "heading"), 0.0
)

pytestmark = pytest.mark.timeout(300)  # a browser takes its time where other programs use the processor

Open = Callable[..., Tab]


class Web(Protocol):
    """Start `nedbus web` and return it when it serves its page, with the page's address."""

    def __call__(self, *arguments: str, port: int | None = None, **environment: str) -> tuple[Process, str]: ...


@pytest.fixture
def web(run_nedbus: Start) -> Web:
    def serve(*arguments: str, port: int | None = None, **environment: str) -> tuple[Process, str]:
        port = port or int(free_endpoint().rpartition(":")[2])
        process = run_nedbus("web", "--listen", f"127.0.0.1:{port}", *arguments, **environment)
        wait_for(lambda: "open http" in process.err or process.popen.poll() is not None, what="the page")
        assert process.popen.poll() is None, process.err
        return process, f"http://127.0.0.1:{port}"

    return serve


@pytest.fixture
def tab(browser: Browser) -> Iterator[Open]:
    """Open tabs that may neither ask another host for anything nor complain."""
    with open_tabs(browser) as make:
        yield make


class Vehicle:
    """A vehicle that publishes at 10 Hz from a thread until it is told to be silent."""

    def __init__(self, bus: nedbus.Bus, name: str, **fields: object) -> None:
        self.fields = {**VALID, **fields}
        self._publisher = bus.publisher(VLP, vehicle=name)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._fly, daemon=True)
        self._thread.start()

    def silence(self) -> None:
        """Publish nothing any more, as a vehicle whose estimator has stopped."""
        self._end.set()
        self._thread.join()

    def leave(self) -> None:
        """Be switched off: its liveliness token is withdrawn too."""
        self.silence()
        self._publisher.close()

    def _fly(self) -> None:
        number = 0
        while not self._end.wait(0.1):
            number += 1
            with suppress(nedbus.ClosedError):
                self._publisher.publish(message(number * 100_000, **self.fields))


@pytest.fixture
def fly(bus: nedbus.Bus) -> Iterator[Callable[..., Vehicle]]:
    flying: list[Vehicle] = []

    def begin(name: str, **fields: object) -> Vehicle:
        flying.append(Vehicle(bus, name, **fields))
        return flying[-1]

    yield begin
    for vehicle in flying:
        vehicle.silence()


def until(condition: Callable[[], object], what: str) -> None:
    wait_for(condition, what=what, seconds=PATIENCE)


def until_states(page: Tab, **states: str) -> None:
    until(lambda: page.states == states, f"the states {states}")


def until_order(page: Tab, *vehicles: str) -> None:
    until(lambda: [row["vehicle"] for row in page.streams] == list(vehicles), f"the order {vehicles}")


# What is shown


@pytest.mark.parametrize("theme", [("", "rgb(15, 20, 25)"), ("/?theme=light", "rgb(255, 255, 255)")])
def test_simulated_flight_fills_the_page(
    web: Web, tab: Open, run_nedbus: Start, endpoint: str, theme: tuple[str, str]
) -> None:
    """Every element is filled from a flight: counts, rows, the map with its track, and the plots beside the truth."""
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:?vehicle=wing")
    _, url = web("-c", endpoint)
    page = tab()
    query, ground = theme
    page.open(url + query)
    page.wait_for_text("1 vehicle")
    until(lambda: len(page.streams) == 5, "all five streams")
    topics = {"local position", "ground truth", "external INS", "EKF 0", "EKF 1"}
    assert {row["topic"] for row in page.streams} == topics
    until(lambda: {row["state"] for row in page.streams} <= {"ok", "slow"}, "all to be well")
    page.wait_for_text("external INS")
    main = next(row for row in page.streams if row["topic"] == "local position")
    assert main["source"] == "sim"
    assert float(main["Hz"]) > 0
    until(lambda: any(row["off truth"].endswith(" m") for row in page.streams), "the distance to the truth")
    assert page.marks["wing"]["shape"] == "circle"
    until(lambda: len(points(page.source("valid"))) > 10, "the track")
    until(lambda: len(page.source("climb")["time"]) > 10, "the plots")
    before = page.source("climb")["time"][-1]
    until(lambda: page.source("climb")["time"][-1] > before, "new points")
    page.wait_for_text("messages/s")
    page.wait_for_text("metres from 47.39")
    assert page.page.evaluate("getComputedStyle(document.body).backgroundColor") == ground
    canvases = page.page.locator(".bk-Figure").all()
    assert len(canvases) == 5
    assert all(box["width"] > 100 and box["height"] > 50 for each in canvases if (box := each.bounding_box()))


def points(tracks: dict[str, list[Any]], kind: str = "valid") -> list[tuple[float, float]]:
    """Return the points of all tracks that are drawn."""
    pairs = zip(tracks.get("east", []), tracks.get(kind, []), strict=True)
    return [(east, north) for east, north in pairs if "NaN" not in (east, north)]


def test_silent_vehicle_stays_where_it_was(web: Web, tab: Open, fly: Callable[..., Vehicle], endpoint: str) -> None:
    """A vehicle that is switched off is gone, one that falls silent stale; both stay on the map, open and named."""
    flying = [fly(name, x=float(number), y=2.0) for number, name in enumerate(("off", "mute", "well"), 5)]
    _, url = web("-c", endpoint)
    page = tab()
    page.open(url)
    until(lambda: set(page.states.values()) == {"ok"} and len(page.states) == 3, "three vehicles that are well")
    flying[0].leave()
    flying[1].silence()
    until(lambda: page.states == {"off": "gone", "mute": "stale", "well": "ok"}, "their states")
    assert [row["vehicle"] for row in page.streams] == ["off", "mute", "well"]
    until(lambda: page.marks["mute"]["shape"] == "square", "the marker")
    marks = page.marks
    assert {name: (mark["shape"], mark["north"], mark["east"]) for name, mark in marks.items()} == {
        "off": ("square", 5.0, 2.0),
        "mute": ("square", 6.0, 2.0),
        "well": ("circle", 7.0, 2.0),
    }
    assert marks["off"]["label"] == "off gone"
    page.wait_for_text("last message")
    page.wait_for_text("5.0 m north, 2.0 m east")


def test_invalid_position_is_not_drawn(web: Web, tab: Open, fly: Callable[..., Vehicle], endpoint: str) -> None:
    """What is not valid never appears on the map; the marker is open and stays where the vehicle was valid last."""
    vehicle = fly("wing", x=5.0, y=2.0)
    fly("never", xy_valid=False, x=70.0)
    _, url = web("-c", endpoint)
    page = tab()
    page.open(url)
    until(lambda: page.states.get("wing") == "ok", "the vehicle")
    vehicle.fields |= {"x": 500.0, "xy_valid": False}
    until(lambda: page.states["wing"] == "invalid", "its state")
    until(lambda: page.source("climb")["north"][-1:] == ["NaN"], "the plot")
    mark = page.marks["wing"]
    assert (mark["shape"], mark["north"]) == ("square", 5.0)
    assert page.marks.keys() == {"wing"}
    assert {round(north) for _, north in points(page.source("valid"))} == {5}
    page.wait_for_text("xy invalid")
    page.wait_for_text("never had a valid position: never")
    vehicle.fields |= {"x": 6.0, "xy_valid": True, "dead_reckoning": True}
    until(lambda: page.states["wing"] == "dead reckoning", "dead reckoning")
    until(lambda: points(page.source("valid"), "doubtful"), "a dashed track")


def test_hostile_words_are_text(web: Web, tab: Open, bus: nedbus.Bus, endpoint: str, tmp_path: Path) -> None:
    """What a peer wrote in a reason, or somebody in a GeoJSON file, is shown as text and makes no element."""
    field = tmp_path / f"{HOSTILE[:24].replace('/', '')}.geojson"
    line = {"type": "LineString", "coordinates": [[8.545, 47.397], [8.546, 47.398]]}
    field.write_text(json.dumps({"type": "Feature", "properties": {"name": HOSTILE}, "geometry": line, "id": HOSTILE}))
    vehicle, raw = Vehicle(bus, "wing", xy_global=True, ref_lat=47.397, ref_lon=8.545), bus._session
    _, url = web("-c", endpoint, "--map", str(field))
    page = tab()
    page.open(url)
    key = Address("wing", VLP).rejected_key()
    wait_for_reader(raw, key)
    raw.put(key, json.dumps({"reason": HOSTILE, HOSTILE: HOSTILE}))
    until(lambda: page.source("why")["why"] == [HOSTILE], "the report")
    page.wait_for_text("<img src=x")
    page.wait_for_text("1 rejected")
    page.page.locator(".slick-row", has_text="<img src=x").click()
    raw.put(key, json.dumps({"reason": [HOSTILE]}))
    until(lambda: len(page.source("why")["why"]) == 2, "another report")
    assert page.page.evaluate("window.hacked") is None
    assert page.page.locator("img").count() == 0
    assert page.page.evaluate("document.body.innerHTML.includes('onerror')") is False
    vehicle.silence()


# Viewers


def test_three_viewers_choose_for_themselves(web: Web, tab: Open, fly: Callable[..., Vehicle], endpoint: str) -> None:
    """Three pages follow the same fleet; a click on a row chooses it there, and rows stay under the pointer."""
    fly("a")
    other = fly("b", x=3.0)
    _, url = web("-c", endpoint)
    pages = [tab() for _ in range(3)]
    for page in pages:
        page.open(url)
    for page in pages:
        until_states(page, a="ok", b="ok")
        page.wait_for_text("a/vehicle_local_position")
    first, *others = pages
    first.page.locator(".nedbus-streams .slick-row", has_text="local position").nth(1).click()
    first.wait_for_text("b/vehicle_local_position")
    until(lambda: first.source("climb")["north"][-1:] == [3.0], "the plots of b")
    other.fields["xy_valid"] = False
    for page in others:
        until_order(page, "b", "a")
        assert page.shows("a/vehicle_local_position")
    until(lambda: first.states["b"] == "invalid", "the state of b")
    assert [row["vehicle"] for row in first.streams] == ["a", "b"]
    first.page.mouse.move(200, 400)
    until_order(first, "b", "a")
    assert first.shows("b/vehicle_local_position")


def test_only_a_vehicle_that_is_tapped_is_chosen(
    web: Web, tab: Open, fly: Callable[..., Vehicle], endpoint: str
) -> None:
    """A tap on a marker chooses the vehicle."""
    fly("a")
    fly("b", x=30.0, y=30.0)
    _, url = web("-c", endpoint)
    page = tab()
    page.open(url)
    page.wait_for_text("a/vehicle_local_position")
    until(lambda: len(page.marks) == 2, "both markers")

    def tap() -> bool:
        place = page.page.evaluate(
            """() => {
              const figure = Object.values(Bokeh.index)[0].constructor && [...Bokeh.documents[0].all_models]
                .find(model => model.type == "Figure" && model.match_aspect)
              const view = Bokeh.index.find_one ? Bokeh.index.find_one(figure) : null
              if (!view) return null
              const frame = view.frame, box = view.el.getBoundingClientRect()
              return [box.x + frame.bbox.x + frame.x_scale.compute(30) - frame.bbox.x,
                      box.y + frame.bbox.y + frame.y_scale.compute(30) - frame.bbox.y]
            }"""
        )
        if place is not None:
            page.page.mouse.click(*place)
        return page.shows("b/vehicle_local_position")

    until(tap, "the choice")


def test_browser_changes_only_its_own_page(
    web: Web, tab: Open, fly: Callable[..., Vehicle], endpoint: str, raw: zenoh.Session
) -> None:
    """Whatever a browser does to its document, other pages go on as they were, and nothing is sent to the network."""
    _, url = web("-c", endpoint)
    heard: list[str] = []
    watcher = raw.declare_subscriber("**", lambda sample: heard.append(str(sample.key_expr)))
    pages = [tab(), tab()]
    for page in pages:
        page.open(url)
        page.wait_for_text("waiting for the first message")
    assert pages[0].page.evaluate(
        """() => {
          for (const model of Bokeh.documents[0].all_models) {
            if (model.type == "Div") model.text = "changed here"
            if (model.type == "Toggle") model.active = !model.active
            if (model.type == "ColumnDataSource") model.selected.indices = [-7, 1e9]
          }
          return [...Bokeh.documents[0].all_models].some(model => model.text == "changed here")
        }"""
    )
    pages[0].page.mouse.click(400, 300)
    assert not heard
    watcher.undeclare()
    fly("wing")
    for page in pages:
        until_states(page, wing="ok")
    assert not pages[1].shows("changed here")


# Failures


@pytest.fixture
def stubborn(browser: Browser) -> Iterator[Open]:
    """Open tabs whose console may say that the server is away."""
    with open_tabs(browser, may_complain=True) as make:
        yield make


def test_page_outlives_its_server(web: Web, stubborn: Open, fly: Callable[..., Vehicle], endpoint: str) -> None:
    """When `nedbus web` is killed the page says so in red, and goes on by itself when it is back."""
    fly("wing")
    process, url = web("-c", endpoint)
    page = stubborn()
    page.open(url)
    until(lambda: page.states == {"wing": "ok"}, "the vehicle")
    process.kill()
    page.wait_for_text("nedbus web does not answer since")
    web("-c", endpoint, port=int(url.rpartition(":")[2]))
    until(lambda: not page.shows("nedbus web does not answer since"), "the page to load again")
    until(lambda: page.states == {"wing": "ok"}, "the vehicle again")
    assert all("ERR_CONNECTION" in said or "WebSocket" in said or "bokeh" in said for said in page.complaints)


def test_page_outlives_the_router(web: Web, tab: Open, run_nedbus: Start) -> None:
    """When the router is killed every vehicle is disconnected and the header says why; when it is back all goes on."""
    endpoint = free_endpoint()
    router = run_nedbus("router", "--listen", endpoint)
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:?vehicle=wing")
    _, url = web("-c", endpoint, "--wait")
    page = tab()
    page.open(url)
    until(lambda: len(page.streams) == 5, "the vehicle")
    router.kill()
    page.wait_for_text(f"no link to {endpoint} since")
    until(lambda: {row["state"] for row in page.streams} == {"disconnected"}, "its states")
    until(lambda: {mark["shape"] for mark in page.marks.values()} == {"square"}, "its marker")
    run_nedbus("router", "--listen", endpoint)
    until(lambda: not page.shows("no link to"), "the link")
    until(lambda: {row["state"] for row in page.streams} <= {"ok", "slow"}, "the vehicle again")


# A recording


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """Record two minutes, the second one without xy."""
    file = tmp_path / "flight.mcap"
    times = [number / 10 for number in range(1200)]
    messages = [
        message(round((seconds + 1) * 1e6), **{**VALID, "x": seconds, "xy_valid": seconds < 60}) for seconds in times
    ]
    stamps = [round((1_700_000_000 + seconds) * 1e9) for seconds in times]
    with RecordingWriter(file) as writer:
        streams = [(Address("wing", VLP), Provenance("px4-zenoh"))] * len(times)
        writer.write(to_array(messages), streams, logged=stamps, published=stamps)
    return file


def test_recording_is_played(web: Web, tab: Open, flight: Path) -> None:
    """A recording has a slider that runs, a pause, a speed, and jumps: the page shows the moment that is chosen."""
    _, url = web(str(flight))
    page = tab(width=1000, height=640)
    page.open(url)
    page.wait_for_text("flight.mcap")

    def time() -> float:
        value: float = page.page.evaluate(
            "[...Bokeh.documents[0].all_models].find(model => model.type == 'Slider')?.value ?? 0"
        )
        return value

    until(lambda: time() > 1, "the time to run")
    pause = page.page.get_by_text("pause", exact=True)
    pause.click()
    page.page.get_by_text("play", exact=True).wait_for()
    until(lambda: len(page.marks) == 1, "the vehicle")

    def jump(share: float) -> None:
        bar = page.page.locator(".noUi-base").bounding_box()  # now: what is told above it has more or fewer lines
        assert bar is not None
        page.page.mouse.click(bar["x"] + bar["width"] * share, bar["y"] + bar["height"] / 2)

    jump(0.75)
    until(lambda: page.states == {"wing": "invalid"}, "the second minute")
    assert time() == pytest.approx(90, abs=3)
    assert page.marks["wing"]["north"] == pytest.approx(59.9)
    assert page.marks["wing"]["shape"] == "square"
    page.wait_for_text("since 1:")
    jump(0.25)
    until(lambda: page.states == {"wing": "ok"}, "the first minute")
    at = time()
    assert at == pytest.approx(30, abs=3)
    assert page.marks["wing"]["north"] == pytest.approx(at, abs=0.3)
    assert {round(north) for _, north in points(page.source("valid"))} <= set(range(35))
    page.page.locator("select").select_option("10")
    page.page.get_by_text("play", exact=True).click()
    until(lambda: page.states == {"wing": "invalid"}, "time to run on")
    until(lambda: time() == pytest.approx(119.9, abs=0.2), "the end")


# Who may look


def status_of(url: str, **headers: str) -> int:
    request = urllib.request.Request(url, headers=headers)  # noqa: S310 - our own address
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


def test_foreign_pages_get_nothing(web: Web, endpoint: str) -> None:
    """A page of somebody else, also one whose name leads here, gets neither the page nor its socket nor metrics."""
    _, url = web("-c", endpoint, "--origin", "ground.example:8420")
    host = url.removeprefix("http://")
    for path in ("/", "/metrics", "/healthz"):
        assert status_of(url + path) == 200
        assert status_of(url + path, Host="ground.example:8420") == 200
        assert status_of(url + path, Host="evil.example:8420") == 403
        assert status_of(url + path, Host=host, Origin="http://evil.example") == 403
    for origin in ("http://evil.example", f"http://evil.example@{host}", "null", f"http://{host}.evil.example"):
        assert not answers(url, origin)
    assert answers(url, url)
    assert answers(url, "http://ground.example:8420")
    assert status_of(url + "/metrics", Host="localhost" + host.removeprefix("127.0.0.1")) == 200


def test_nothing_can_be_sent_to_its_paths(web: Web, endpoint: str) -> None:
    """Only reading is answered."""
    _, url = web("-c", endpoint)
    for path in ("/", "/metrics", "/healthz"):
        for method in ("POST", "PUT", "DELETE"):
            request = urllib.request.Request(url + path, data=b"x", method=method)  # noqa: S310 - our own address
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(request, timeout=DEADLINE)  # noqa: S310 - our own address
            with refused.value:
                assert refused.value.code in {403, 405}


@pytest.mark.parametrize(
    "sent", [b"Content-Length: 100000000\r\n\r\n", b"Transfer-Encoding: chunked\r\n\r\n5f5e100\r\n"]
)
def test_bodies_are_not_kept(web: Web, endpoint: str, sent: bytes) -> None:
    """A request that announces 100 MB is refused before it has sent them, under whatever name it came."""
    _, url = web("-c", endpoint)
    for host in (url.removeprefix("http://"), "evil.example"):
        for method in (b"POST", b"PUT", b"GET"):
            with socket.create_connection(("127.0.0.1", int(url.rpartition(":")[2])), DEADLINE) as client:
                client.sendall(method + b" / HTTP/1.1\r\nHost: " + host.encode() + b"\r\n" + sent)
                assert client.recv(1000).startswith(b"HTTP/1.1 400 ")


def test_browser_says_little_at_a_time(web: Web, endpoint: str) -> None:
    """What comes through the socket of a page has a limit of 1 MiB, which ends it."""
    _, url = web("-c", endpoint)
    with open_socket(url, url) as connection:

        def is_closed() -> bool:
            try:
                connection.recv(timeout=0.1)
            except TimeoutError:
                return False
            except websockets.ConnectionClosed:
                return True
            return False

        connection.send(" " * 2**20)
        assert not is_closed()
        connection.send(" " * (2**20 + 1))
        wait_for(is_closed, what="the end of the page")


def test_too_many_viewers_are_told(monkeypatch: pytest.MonkeyPatch, endpoint: str, tab: Open) -> None:
    """One page more than the limit, which is 1 here, says so instead of taking the memory of all."""
    monkeypatch.setattr("nedbus.web.server.MAX_VIEWERS", 1)
    where = Where("127.0.0.1", 0)
    stop = threading.Event()
    urls: queue.SimpleQueue[str] = queue.SimpleQueue()
    with nedbus.connect(endpoint) as bus:
        options = {"version": "0", "stop": stop, "tell": urls.put}
        server = threading.Thread(target=serve_live, args=(bus, Selection(), where), kwargs=options)
        server.start()
        try:
            url = urls.get(timeout=DEADLINE)
            tab().open(url)
            page = tab()
            page.page.goto(url)
            page.wait_for_text("1 pages are open, which is the limit: close one")
        finally:
            stop.set()
            server.join(DEADLINE)


def test_reader_of_a_secure_router_sees_all(web: Web, tab: Open, run_nedbus: Start, secure: str, pki: Path) -> None:
    """Over mTLS, with a reader's certificate, the page shows what a vehicle publishes."""

    def files(name: str) -> dict[str, Any]:
        return {
            "NEDBUS_TLS_CA": str(pki / "ca.crt"),
            "NEDBUS_TLS_CERTIFICATE": str(pki / f"{name}.crt"),
            "NEDBUS_TLS_KEY": str(pki / f"{name}.key"),
        }

    run_nedbus("serve", "--connect", secure, "-s", "sim:?vehicle=1", **files("vehicle-1"))
    _, url = web("-c", secure, **files("reader"))
    page = tab()
    page.open(url)
    until(lambda: len(page.streams) == 5, "its streams")
    until(lambda: len(page.marks) == 1, "its marker")


def test_listening_for_others_says_what_that_means(run_nedbus: Start, endpoint: str) -> None:
    """With --listen 0.0.0.0 the command says who can look, and ends with 0 at Ctrl-C."""
    port = free_endpoint().rpartition(":")[2]
    process = run_nedbus("web", "-c", endpoint, "--listen", f"0.0.0.0:{port}", measured=False)
    wait_for(lambda: "without a password" in process.err, what="the warning")
    assert status_of(f"http://127.0.0.1:{port}/healthz") == 200
    process.signal(signal.SIGINT)
    assert process.wait() in {0, 130}
    assert "Traceback" not in process.err
