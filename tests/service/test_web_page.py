"""The page in a real browser: what a person sees of vehicles, of a lost server, and of what a hostile peer sends."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser

import nedbus
from nedbus.transport import Session
from nedbus.web import Where
from nedbus_msgs import Address
from tests.browser import PATIENCE, Tab, browser, open_tabs
from tests.messages import VALID, VLP
from tests.ports import free_port
from tests.processes import Process, Start
from tests.waits import wait_for, wait_for_reader
from tests.web import flying, serving_live, write_flight

__all__ = ["browser"]  # a fixture

HOSTILE = "<img src=x onerror=window.hacked=1><script>window.hacked=1</script>"

# A browser takes its time where other programs use the processor.
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

Open = Callable[..., Tab]
Web = Callable[..., Process]
Fly = Callable[..., dict[str, object]]


@pytest.fixture
def web(run_nedbus: Start) -> Web:
    """Start `nedbus web` on a port, and wait until it serves its page."""

    def serve(port: int, *arguments: str) -> Process:
        process = run_nedbus("web", "--listen", f"127.0.0.1:{port}", *arguments)
        wait_for(lambda: "open http" in process.err or process.popen.poll() is not None, what="the page")
        assert process.popen.poll() is None, process.err
        return process

    return serve


@pytest.fixture
def url(endpoint: str) -> Iterator[str]:
    """Serve the page of the router of this test."""
    with serving_live(endpoint) as url:
        yield url


@pytest.fixture
def tab(browser: Browser) -> Iterator[Open]:
    """Open tabs that may neither ask another host for anything nor complain."""
    with open_tabs(browser) as make:
        yield make


@pytest.fixture
def fly(bus: nedbus.Bus) -> Iterator[Fly]:
    """Let a vehicle publish; its fields may be changed."""
    with ExitStack() as flying_:

        def begin(name: str, **fields: object) -> dict[str, object]:
            fields = {**VALID, **fields}
            flying_.enter_context(flying(bus.publisher(VLP, vehicle=name), fields))
            return fields

        yield begin


def until(condition: Callable[[], object], what: str) -> None:
    wait_for(condition, what=what, seconds=PATIENCE)


def until_states(page: Tab, **states: str) -> None:
    until(lambda: page.states == states, f"the states {states}")


def until_order(page: Tab, *vehicles: str) -> None:
    until(lambda: [row["vehicle"] for row in page.streams] == list(vehicles), f"the order {vehicles}")


# What is shown


def test_simulated_flight_fills_the_page(url: str, tab: Open, run_nedbus: Start, endpoint: str) -> None:
    """Every element is filled from a flight: counts, rows, the map with its track, and the plots beside the truth."""
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:?vehicle=wing&topics=VehicleLocalPosition")
    page = tab()
    page.open(url)
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
    canvases = page.page.locator(".bk-Figure").all()
    assert len(canvases) == 5
    assert all(box["width"] > 100 and box["height"] > 50 for each in canvases if (box := each.bounding_box()))
    for query, ground in (("", "rgb(15, 20, 25)"), ("/?theme=light", "rgb(255, 255, 255)")):
        if query:
            page.open(url + query)
        assert page.page.evaluate("getComputedStyle(document.body).backgroundColor") == ground


def points(tracks: dict[str, list[Any]], kind: str = "valid") -> list[tuple[float, float]]:
    """Return the points of all tracks that are drawn."""
    pairs = zip(tracks.get("east", []), tracks.get(kind, []), strict=True)
    return [(east, north) for east, north in pairs if "NaN" not in (east, north)]


def test_hostile_words_are_text(fly: Fly, tab: Open, raw: Session, endpoint: str, tmp_path: Path) -> None:
    """What a peer wrote in a reason, or somebody in a GeoJSON file, is shown as text and makes no element."""
    field = tmp_path / f"{HOSTILE[:24].replace('/', '')}.geojson"
    line = {"type": "LineString", "coordinates": [[8.545, 47.397], [8.546, 47.398]]}
    field.write_text(json.dumps({"type": "Feature", "properties": {"name": HOSTILE}, "geometry": line, "id": HOSTILE}))
    fly("wing", xy_global=True, ref_lat=47.397, ref_lon=8.545)
    with serving_live(endpoint, Where("127.0.0.1", 0, background=field)) as url:
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


# Viewers


def test_viewers_choose_for_themselves(url: str, tab: Open, fly: Fly, raw: Session) -> None:
    """Two pages follow the same fleet; a click on a row, or a tap on a marker, chooses that vehicle there.

    Rows stay under the pointer. Whatever a browser does to its document, the other page goes on as it was, and nothing
    is sent to the network.
    """
    fly("a")
    other = fly("b", x=30.0, y=30.0)
    first, second = pages = tab(), tab()
    for page in pages:
        page.open(url)
    for page in pages:
        until_states(page, a="ok", b="ok")
        page.wait_for_text("a/vehicle_local_position")
    row = first.page.locator(".nedbus-streams .slick-row", has_text="local position").nth(1)

    def choose() -> bool:
        row.click()  # which a table that is drawn anew in that moment does not notice
        return first.shows("b/vehicle_local_position")

    until(choose, "the words about b")
    until(lambda: first.source("climb")["north"][-1:] == [30.0], "the plots of b")
    other["xy_valid"] = False
    until_order(second, "b", "a")
    assert second.shows("a/vehicle_local_position")
    until(lambda: first.states["b"] == "invalid", "the state of b")
    assert [row["vehicle"] for row in first.streams] == ["a", "b"]
    first.page.mouse.move(200, 400)
    until_order(first, "b", "a")
    assert first.shows("b/vehicle_local_position")

    def tap() -> bool:
        place = second.page.evaluate(
            """() => {
              const figure = [...Bokeh.documents[0].all_models].find(each => each.type == "Figure" && each.match_aspect)
              const view = Bokeh.index.find_one(figure)
              if (!view) return null
              const {x_scale, y_scale} = view.frame, box = view.el.getBoundingClientRect()
              return [box.x + x_scale.compute(30), box.y + y_scale.compute(30)]
            }"""
        )
        if place is not None:
            second.page.mouse.click(*place)
        return second.shows("b/vehicle_local_position")

    until(tap, "the choice")
    heard: set[str] = set()
    watcher = raw.declare_subscriber("**", lambda sample: heard.add(str(sample.key_expr)))
    assert second.page.evaluate(
        """() => {
          for (const model of Bokeh.documents[0].all_models) {
            if (model.type == "Div") model.text = "changed here"
            if (model.type == "Toggle") model.active = !model.active
            if (model.type == "ColumnDataSource") model.selected.indices = [-7, 1e9]
          }
          return [...Bokeh.documents[0].all_models].some(model => model.text == "changed here")
        }"""
    )
    other["xy_valid"] = True
    for page in (first, second):
        until_states(page, a="ok", b="ok")
    assert not first.shows("changed here")
    watcher.undeclare()
    assert heard == {f"nedbus/{name}/{VLP}" for name in "ab"}


# Failures


def test_page_outlives_its_server(web: Web, browser: Browser, fly: Fly, endpoint: str) -> None:
    """When `nedbus web` is killed the page says so in red, and goes on by itself when it is back."""
    fly("wing")
    port = free_port()
    process = web(port, "-c", endpoint)
    with open_tabs(browser, may_complain=True) as make:
        page = make()
        page.open(f"http://127.0.0.1:{port}")
        until_states(page, wing="ok")
        process.kill()
        page.wait_for_text("nedbus web does not answer since")
        web(port, "-c", endpoint)
        until(lambda: not page.shows("nedbus web does not answer since"), "the page to load again")
        until_states(page, wing="ok")
        assert all("ERR_CONNECTION" in said or "WebSocket" in said or "bokeh" in said for said in page.complaints)


# A recording


def test_recording_is_played(web: Web, tab: Open, tmp_path: Path) -> None:
    """A recording has a slider that runs, a pause, a speed, and jumps: the page shows the moment that is chosen."""
    port = free_port()
    web(port, str(write_flight(tmp_path, {VLP: lambda time: {"x": time, "xy_valid": time < 60}}, seconds=120)))
    page = tab(width=1000, height=640)
    page.open(f"http://127.0.0.1:{port}")
    page.wait_for_text("flight.mcap")

    def time() -> float:
        slider = "[...Bokeh.documents[0].all_models].find(model => model.type == 'Slider')"
        return float(page.page.evaluate(f"{slider}?.value ?? 0"))

    until(lambda: time() > 1, "the time to run")
    pause = page.page.get_by_text("pause", exact=True)
    pause.click()
    page.page.get_by_text("play", exact=True).wait_for()
    until(lambda: len(page.marks) == 1, "the vehicle")

    def jump(share: float) -> None:
        # It moves, as what is told above it has more or fewer lines, and is deaf for 0.3 s after each click.
        bar = page.page.locator(".noUi-target:not(.noUi-state-tap) .noUi-base")
        box = bar.bounding_box()
        assert box is not None
        bar.click(position={"x": box["width"] * share, "y": box["height"] / 2})

    jump(0.75)
    until(lambda: page.states == {"wing": "invalid"}, "the second minute")
    assert time() == pytest.approx(90, abs=3)
    assert page.marks["wing"]["north"] == pytest.approx(59.9)
    page.wait_for_text("since 1:")
    jump(0.25)
    until(lambda: page.states == {"wing": "ok"}, "the first minute")
    assert page.marks["wing"]["north"] == pytest.approx(time(), abs=0.3)
    assert {round(north) for _, north in points(page.source("valid"))} <= set(range(35))
    page.page.locator("select").select_option("50")
    page.page.get_by_text("play", exact=True).click()
    until(lambda: time() == pytest.approx(119.9, abs=0.2), "the end")
