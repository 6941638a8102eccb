"""The page in a real browser: what a person sees of vehicles, of a lost server, and of what a hostile peer sends."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser

import nedbus
from nedbus.transport import Session
from nedbus.web import Where
from nedbus_msgs import Address
from tests.flights.messages import VALID, VLP, message
from tests.nedbus.web.page import flying, serving_live, write_flight
from tests.peers.browser import PAGE_TIMEOUT, VEHICLE, Tab, browser, open_tabs
from tests.peers.ports import free_port
from tests.peers.processes import Process, Start
from tests.waits import repeating, wait_for, wait_for_matching

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
        process = run_nedbus("web", "--http", f"127.0.0.1:{port}", *arguments)
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
    wait_for(condition, what=what, seconds=PAGE_TIMEOUT)


def until_states(page: Tab, **states: str) -> None:
    until(lambda: page.states == states, f"the states {states}")


def until_order(page: Tab, *vehicles: str) -> None:
    until(lambda: [row["vehicle"] for row in page.listed] == list(vehicles), f"the order {vehicles}")


# What is shown


def test_simulated_flight_fills_the_page(url: str, tab: Open, run_nedbus: Start, endpoint: str) -> None:
    """Every part is filled from a flight: counts, the row, the map with its track, numbers, and plots with the truth.

    `nedbus serve` flies its simulator, whose second EKF is none of the vehicle's.
    """
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:?vehicle=wing")
    page = tab(width=1280, height=800)
    page.open(url)
    until(lambda: list(page.states) == ["wing"], "the vehicle")
    until(lambda: "1 ok" in page.part("head"), "it to be well")
    assert page.page.title() == "nedbus"
    until(lambda: page.chosen == ["wing"], "the vehicle")
    assert page.query == {}
    assert page.marks["wing"]["shape"] == "circle"
    until(lambda: len(points(page.source("valid0"), "valid0")) > 10, "the track")
    until(lambda: len(page.source("speed").get("time", ())) > 10, "the plots")
    before = page.source("speed")["time"][-1]
    until(lambda: page.source("speed")["time"][-1] > before, "new points")
    until(lambda: "NaN" not in page.source("speed")["error"][-3:], "the distance to the truth")
    page.wait_for_text("messages/s")
    page.wait_for_text("origin 47.39")
    assert "-" not in page.part("nums").split("\n")
    page.page.locator("[data-do=streams]").click()
    page.wait_for_text("vehicle_local_position_groundtruth")
    canvases = page.page.locator(".bk-Figure").all()
    assert len(canvases) == 5
    assert all(box["width"] > 100 and box["height"] > 50 for each in canvases if (box := each.bounding_box()))


def points(tracks: dict[str, list[Any]], kind: str) -> list[tuple[float, float]]:
    """Return the points of all tracks of a kind that are drawn."""
    pairs = zip(tracks.get("east", []), tracks.get(kind, []), strict=True)
    return [(east, north) for east, north in pairs if "NaN" not in (east, north)]


SIZES = ((390, 844), (1280, 800), (1920, 1080))


@pytest.fixture
def fifty(bus: nedbus.Bus) -> Iterator[None]:
    """Fly 50 vehicles at one message a second each; some of them are not well."""
    flags: dict[int, dict[str, object]] = {7: {"xy_valid": False}, 23: {"dead_reckoning": True}, 42: {"z_valid": False}}
    publishers = [bus.publisher(VLP, vehicle=f"uav-{number}") for number in range(1, 51)]
    ticks = count(1)

    def publish() -> None:
        tick = next(ticks)
        number, index = tick % 50 + 1, tick % 50
        place = {"x": 8.0 * (index // 10), "y": 12.0 * (index % 10), "vx": 3.0}
        wrong = flags.get(number, {}) if tick > 100 else {}
        publishers[index].publish(message(20_000 * tick, **{**VALID, **place, **wrong}))

    with repeating(publish):
        yield


@pytest.mark.usefixtures("fifty")
@pytest.mark.parametrize("theme", ["dark", "light"])
def test_page_fits_every_screen(url: str, tab: Open, theme: str) -> None:
    """With 50 vehicles, on a phone, a laptop and a wide screen, dark and light: nothing is cut off, or on another.

    All parts have something in them, all text has a contrast of 4.5, and labels on the map do not lie on each other.
    The worst vehicles are first in the list, and counted in the title.
    """
    page = tab(width=SIZES[0][0], height=SIZES[0][1])
    page.open(f"{url}/?theme={theme}")
    until(lambda: [row["grade"] for row in page.listed] == ["bad"] * 2 + ["watch"] + ["ok"] * 47, "all vehicles")
    until(lambda: page.page.title() == "(2 bad) nedbus", "the title")
    names = [row["vehicle"] for row in page.listed]
    others = [f"uav-{number}" for number in range(1, 51) if number not in (7, 23, 42)]
    assert names == ["uav-7", "uav-42", "uav-23", *others]
    page.page.locator(VEHICLE).first.click()
    until(lambda: page.chosen == ["uav-7"] and "xy not valid from" in page.part("why"), "its sentence")
    page.page.locator("[data-do=streams]").click()
    for width, height in SIZES:
        page.page.set_viewport_size({"width": width, "height": height})
        wait_for_none(page.layout_problems, f"{width}x{height}, {theme}")
        wait_for_none(lambda: on_each_other(page), f"labels at {width}x{height}, {theme}")
        assert "uav-7" in [label[0] for label in page.labels()]
    texts = page.contrasts("head", "list", "why", "nums", "tool", "more")
    assert {name for name, _, _ in texts} == {"head", "list", "why", "nums", "tool", "more"}
    assert len(texts) > 300
    assert [each for each in texts if each[2] < 4.5] == []


def test_nothing_is_cut_off_without_a_hint(web: Web, tab: Open, tmp_path: Path) -> None:
    """Modes are whole, the table of streams is, and a card that goes on below has a bright edge."""
    others = "vehicle_attitude", "home_position", "vehicle_land_detected", "vehicle_global_position"
    topics: dict[str, Callable[[float], Mapping[str, object]]] = {
        "vehicle_status": lambda _: {"nav_state": 14, "arming_state": 2},
        VLP: lambda time: {"xy_valid": time < 5, "z_valid": time < 6},
        **dict.fromkeys(others, lambda _: {}),
    }
    port = free_port()
    web(port, str(write_flight(tmp_path, topics, seconds=20)))
    page = tab(width=1920, height=1080)
    page.open(f"http://127.0.0.1:{port}/?time=15")
    until_states(page, wing="xy not valid")
    until(
        lambda: [(cell.text, cell.is_cut) for cell in page.cells(".row > .mode")[1:]] == [("Offboard", False)], "mode"
    )
    page.page.set_viewport_size({"width": 1280, "height": 800})
    page.page.locator("[data-do=streams]").click()
    until(lambda: len(page.cells("td")) == 36, "the streams")
    until(lambda: not page.cells("div.more")[0].is_cut, "room for them")
    page.page.set_viewport_size({"width": 1280, "height": 330})
    until(lambda: page.cells("div.why")[0].is_cut, "a card that goes on")
    assert "local" in page.cells("div.why")[0].layers


def wait_for_none(problems: Callable[[], list[str]], what: str) -> None:
    """Wait until there is no problem, and tell those that stay."""
    last: list[str] = []

    def are_none() -> bool:
        last[:] = problems()
        return not last

    try:
        wait_for(are_none, what=what, seconds=PAGE_TIMEOUT)
    except AssertionError:
        pytest.fail(f"{what}: {'; '.join(last)}")


def on_each_other(page: Tab) -> list[str]:
    """Return the labels on the map that lie on each other."""
    labels = page.labels()
    return [
        f"{one[0]} on {other[0]}"
        for index, one in enumerate(labels)
        for other in labels[:index]
        if min(one[3], other[3]) - max(one[1], other[1]) > 1 and min(one[4], other[4]) - max(one[2], other[2]) > 1
    ] or ([] if len(labels) > 2 else ["too few labels"])


def test_hostile_words_are_text(fly: Fly, tab: Open, zenoh_session: Session, endpoint: str, tmp_path: Path) -> None:
    """Text of a peer in a reason, or in a GeoJSON file, is shown as text and makes no element."""
    field = tmp_path / f"{HOSTILE[:24].replace('/', '')}.geojson"
    line = {"type": "LineString", "coordinates": [[8.545, 47.397], [8.546, 47.398]]}
    field.write_text(json.dumps({"type": "Feature", "properties": {"name": HOSTILE}, "geometry": line, "id": HOSTILE}))
    fly("wing", xy_global=True, ref_lat=47.397, ref_lon=8.545)
    with serving_live(endpoint, Where("127.0.0.1", 0, background=field)) as url:
        page = tab()
        page.open(url)
        key = Address("wing", VLP).rejected_key()
        wait_for_matching(zenoh_session, key)
        zenoh_session.put(key, json.dumps({"reason": HOSTILE, HOSTILE: HOSTILE}))
        page.wait_for_text("1 rejected")
        page.page.locator("[data-do=streams]").click()
        until(lambda: HOSTILE in page.part("more"), "the reason")
        until(lambda: HOSTILE[:10] in page.part("why"), "the event")
        until(lambda: HOSTILE[:20] in str(page.source("row").get("words")), "its mark")
        page.page.get_by_placeholder("search").fill(HOSTILE)
        until(lambda: page.states == {}, "the list to be empty")
        page.page.get_by_placeholder("search").fill("")
        zenoh_session.put(key, json.dumps({"reason": [HOSTILE]}))
        page.wait_for_text("2 rejected")
        assert page.page.evaluate("window.hacked") is None
        assert page.page.locator("img").count() == 0
        assert page.page.evaluate("document.body.innerHTML.includes('onerror')") is False


# Viewers


def test_viewers_choose_for_themselves(url: str, tab: Open, fly: Fly, zenoh_session: Session) -> None:
    """Two pages follow the same fleet; a click in the list, a tap on a marker, or a key chooses a vehicle there alone.

    What happened before can be looked at, in one page as well. Whatever a browser does to its document, the other page
    goes on as it was, and nothing is sent to the network.
    """
    fly("a")
    other = fly("b", x=30.0, y=30.0)
    first, second = pages = tab(width=1280, height=800), tab(width=1280, height=800)
    for page in pages:
        page.open(url)
        until_states(page, a="ok", b="ok")
        until(lambda page=page: page.chosen == ["a"], "the first vehicle")  # type: ignore[misc]  # bound here
    first.page.locator(VEHICLE, has_text="b").click()
    until(lambda: first.chosen == ["b"], "the choice")
    until(lambda: "30.0 m" in first.part("nums"), "the numbers of b")
    other["xy_valid"] = False
    until_order(second, "b", "a")
    until(lambda: second.chosen == ["b"], "the worst, where nobody has chosen")
    second.page.locator(f"{VEHICLE}[data-with=a]").click()
    until(lambda: second.chosen == ["a"], "the choice there")
    until_states(first, a="ok", b="xy not valid")
    assert first.page.title() == "(1 bad) nedbus"

    def tap() -> bool:
        second.tap(30, 30)  # which a map that is drawn anew in that moment does not notice
        with suppress(AssertionError):
            wait_for(lambda: second.chosen == ["b"], what="the choice", seconds=3)
        return second.chosen == ["b"]

    until(tap, "the choice by a tap")
    second.page.keyboard.press("j")
    until(lambda: second.chosen == ["a"], "the choice by a key")
    until(lambda: "xy not valid from" in first.part("why"), "the sentence")
    other["xy_valid"] = True
    until(lambda: " to " in first.part("why"), "the end of it")
    first.page.keyboard.press("p")
    first.page.get_by_text("back to now").wait_for()
    until(lambda: set(first.query) == {"vehicle", "time"}, "the address")
    third = tab(width=1280, height=800)
    third.open(first.url)
    third.page.get_by_text("back to now").wait_for()
    until(lambda: (third.query, third.chosen) == (first.query, ["b"]), "the same moment")
    third.page.close()
    first.page.get_by_text("back to now").click()
    until(lambda: first.query == {"vehicle": "b"}, "the present")
    until(lambda: second.query == {"vehicle": "a"}, "the other page to be as it was")
    heard: set[str] = set()
    watcher = zenoh_session.declare_subscriber("**", lambda sample: heard.add(str(sample.key_expr)))
    assert second.page.evaluate(
        """() => {
          for (const model of Bokeh.documents[0].all_models) {
            if (model.type == "Div") model.text = "changed here"
            if (model.type == "TextInput") model.value = "changed here"
            if (model.type == "ColumnDataSource") model.selected.indices = [-7, 1e9]
          }
          return [...Bokeh.documents[0].all_models].some(model => model.text == "changed here")
        }"""
    )
    other["xy_valid"] = False
    for page in pages:
        until(lambda page=page: page.states.get("b") == "xy not valid", "the state")  # type: ignore[misc]  # as above
    assert not first.shows("changed here")
    watcher.undeclare()
    assert heard == {f"nedbus/{name}/{VLP}" for name in "ab"}


# Failures


def test_page_outlives_its_server(web: Web, browser: Browser, fly: Fly, endpoint: str) -> None:
    """When `nedbus web` is killed the page says so in red, and goes on by itself when it is back."""
    fly("wing")
    port = free_port()
    process = web(port, "-c", endpoint)
    with open_tabs(browser, allow_console_errors=True) as make:
        page = make()
        page.open(f"http://127.0.0.1:{port}")
        until_states(page, wing="ok")
        process.kill()
        page.wait_for_text("nedbus web has not responded since")
        web(port, "-c", endpoint)
        until(lambda: not page.shows("nedbus web has not responded since"), "the page to load again")
        until_states(page, wing="ok")
        assert all("ERR_CONNECTION" in said or "WebSocket" in said or "bokeh" in said for said in page.console_errors)


# A recording


def test_recording_is_played(web: Web, tab: Open, tmp_path: Path) -> None:
    """A recording has a slider that runs, a pause, a speed, jumps, and events: the page shows what was then."""
    port = free_port()
    web(port, str(write_flight(tmp_path, {VLP: lambda time: {"x": time, "xy_valid": time < 60}}, seconds=120)))
    page = tab(width=1280, height=800)
    page.open(f"http://127.0.0.1:{port}")
    page.wait_for_text("flight.mcap")

    def time() -> float:
        slider = "[...Bokeh.documents[0].all_models].find(model => model.type == 'Slider')"
        return float(page.page.evaluate(f"{slider}?.value ?? 0"))

    until(lambda: time() > 1, "the time to run")
    page.page.get_by_text("pause", exact=True).click()
    page.page.get_by_text("play", exact=True).wait_for()
    until(lambda: len(page.marks) == 1, "the vehicle")
    wait_for_none(page.layout_problems, "the layout")

    def jump(share: float) -> None:
        # It is deaf for 0.3 s after each click.
        bar = page.page.locator(".noUi-target:not(.noUi-state-tap) .noUi-base")
        box = bar.bounding_box()
        assert box is not None
        bar.click(position={"x": box["width"] * share, "y": box["height"] / 2})

    jump(0.75)
    until(lambda: page.states == {"wing": "xy not valid"}, "the second minute")
    assert time() == pytest.approx(90, abs=3)
    assert page.marks["wing"]["north"] == pytest.approx(59.9)
    page.wait_for_text("xy not valid from")
    jump(0.25)
    until(lambda: page.states == {"wing": "ok"}, "the first minute")
    assert page.marks["wing"]["north"] == pytest.approx(time(), abs=0.3)
    assert {round(north) for _, north in points(page.source("valid0"), "valid0")} <= set(range(35))
    page.page.locator(".strip [data-do=event]").click()
    until(lambda: time() == pytest.approx(60, abs=0.1), "the moment of the event")
    until_states(page, wing="xy not valid")
    until(lambda: "time" in page.query, "the address")
    page.page.get_by_text("flight.mcap").click()  # so that keys are for the page, not for a button
    for key, seconds in (("ArrowLeft", 59), ("Shift+ArrowLeft", 49), ("ArrowRight", 50), ("n", 60)):
        page.page.keyboard.press(key)
        until(lambda seconds=seconds: time() == pytest.approx(seconds, abs=0.1), key)  # type: ignore[misc]  # bound here
    page.page.locator("[data-do='focus:follow']").press("Enter")
    until(lambda: page.query.get("view") == "follow", "a button to be pressed by a key")
    other = tab(width=1280, height=800)
    other.open(page.url)
    until(lambda: other.states == {"wing": "xy not valid"}, "the same moment, from which on it is played")
    other.page.close()
    page.page.locator("select").select_option("50")
    page.page.get_by_text("play", exact=True).click()
    until(lambda: time() == pytest.approx(119.9, abs=0.2), "the end")
