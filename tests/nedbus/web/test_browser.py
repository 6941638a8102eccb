"""The page in a real browser: layout, actions, reconnection, and hostile input."""

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
from nedbus.web import PageOptions
from nedbus_msgs import Address
from tests.flights.messages import VALID, VLP, message
from tests.nedbus.web.page import flying, serving_live, write_flight
from tests.peers.browser import PAGE_TIMEOUT, VEHICLE, Tab, browser, open_tabs
from tests.peers.ports import free_port
from tests.peers.processes import Process, Start
from tests.waits import repeating, wait_for, wait_for_matching

__all__ = ["browser"]  # a fixture

HOSTILE = "<img src=x onerror=window.hacked=1><script>window.hacked=1</script>"

# A browser is slow on a busy host.
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

Open = Callable[..., Tab]
Web = Callable[..., Process]
Fly = Callable[..., dict[str, object]]


@pytest.fixture
def web(run_nedbus: Start) -> Web:
    """Start `nedbus web` on a port, and wait until it serves the page."""

    def serve(port: int, *arguments: str) -> Process:
        process = run_nedbus("web", "--http", f"127.0.0.1:{port}", *arguments)
        wait_for(
            lambda: "open http" in process.err or process.popen.poll() is not None, what="the page"
        )
        assert process.popen.poll() is None, process.err
        return process

    return serve


@pytest.fixture
def url(endpoint: str) -> Iterator[str]:
    """Serve the page of this test's router."""
    with serving_live(endpoint) as url:
        yield url


@pytest.fixture
def tab(browser: Browser) -> Iterator[Open]:
    """Open tabs; they must neither contact another host nor log errors."""
    with open_tabs(browser) as make:
        yield make


@pytest.fixture
def fly(bus: nedbus.Bus) -> Iterator[Fly]:
    """Start a vehicle that publishes; the returned fields may be changed."""
    with ExitStack() as vehicles:

        def begin(name: str, **fields: object) -> dict[str, object]:
            fields = {**VALID, **fields}
            vehicles.enter_context(flying(bus.publisher(VLP, vehicle=name), fields))
            return fields

        yield begin


def until(condition: Callable[[], object], what: str) -> None:
    wait_for(condition, what=what, seconds=PAGE_TIMEOUT)


def until_states(page: Tab, **states: str) -> None:
    until(lambda: page.states == states, f"the states {states}")


def until_order(page: Tab, *vehicles: str) -> None:
    until(
        lambda: [row["vehicle"] for row in page.listed] == list(vehicles), f"the order {vehicles}"
    )


# Display


def test_simulated_flight_fills_every_panel(
    url: str, tab: Open, run_nedbus: Start, endpoint: str
) -> None:
    """A simulated flight fills counts, row, map with track, numbers, and plots with ground truth.

    The simulator's second EKF instance does not affect them.
    """
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:?vehicle=wing")
    page = tab(width=1280, height=800)
    page.open(url)
    until(lambda: list(page.states) == ["wing"], "the vehicle")
    until(lambda: "1 ok" in page.panel("head"), "the vehicle to be ok")
    assert page.page.title() == "nedbus"
    until(lambda: page.chosen == ["wing"], "the vehicle")
    assert page.query == {}
    assert page.marks["wing"]["shape"] == "circle"
    until(lambda: len(points(page.source("valid0"), "valid0")) > 10, "the track")
    until(lambda: len(page.source("speed").get("time", ())) > 10, "the plots")
    before = page.source("speed")["time"][-1]
    until(lambda: page.source("speed")["time"][-1] > before, "new points")
    until(lambda: "NaN" not in page.source("speed")["error"][-3:], "the error to the ground truth")
    page.wait_for_text("messages/s")
    page.wait_for_text("origin 47.39")
    assert "-" not in page.panel("nums").split("\n")
    page.page.locator("[data-do=streams]").click()
    page.wait_for_text("vehicle_local_position_groundtruth")
    canvases = page.page.locator(".bk-Figure").all()
    assert len(canvases) == 5
    assert all(
        box["width"] > 100 and box["height"] > 50
        for each in canvases
        if (box := each.bounding_box())
    )


def points(tracks: dict[str, list[Any]], kind: str) -> list[tuple[float, float]]:
    """Return the drawn points of all tracks of a line type."""
    pairs = zip(tracks.get("east", []), tracks.get(kind, []), strict=True)
    return [(east, north) for east, north in pairs if "NaN" not in (east, north)]


SIZES = ((390, 844), (1280, 800), (1920, 1080))


@pytest.fixture
def fifty_vehicles(bus: nedbus.Bus) -> Iterator[None]:
    """Publish 50 vehicles at 1 Hz each; three of them have faults."""
    flags: dict[int, dict[str, object]] = {
        7: {"xy_valid": False},
        23: {"dead_reckoning": True},
        42: {"z_valid": False},
    }
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


@pytest.mark.usefixtures("fifty_vehicles")
@pytest.mark.parametrize("theme", ["dark", "light"])
def test_layout_fits_phone_laptop_and_wide_screen(url: str, tab: Open, theme: str) -> None:
    """With 50 vehicles, in both themes, no panel is empty or cut off, or covers another.

    Text has a contrast ratio of 4.5, map labels do not overlap, and the worst vehicles are first in the list and
    counted in the title.
    """
    page = tab(width=SIZES[0][0], height=SIZES[0][1])
    page.open(f"{url}/?theme={theme}")
    until(
        lambda: [row["grade"] for row in page.listed] == ["bad"] * 2 + ["watch"] + ["ok"] * 47,
        "all vehicles",
    )
    until(lambda: page.page.title() == "(2 bad) nedbus", "the title")
    names = [row["vehicle"] for row in page.listed]
    others = [f"uav-{number}" for number in range(1, 51) if number not in (7, 23, 42)]
    assert names == ["uav-7", "uav-42", "uav-23", *others]
    page.page.locator(VEHICLE).first.click()
    until(
        lambda: page.chosen == ["uav-7"] and "xy not valid from" in page.panel("why"), "its verdict"
    )
    page.page.locator("[data-do=streams]").click()
    for width, height in SIZES:
        page.page.set_viewport_size({"width": width, "height": height})
        wait_for_none(page.layout_problems, f"{width}x{height}, {theme}")
        wait_for_none(lambda: overlapping_labels(page), f"labels at {width}x{height}, {theme}")
        assert "uav-7" in [label[0] for label in page.labels()]
    texts = page.contrasts("head", "list", "why", "nums", "tool", "more")
    assert {name for name, _, _ in texts} == {"head", "list", "why", "nums", "tool", "more"}
    assert len(texts) > 300
    assert [each for each in texts if each[2] < 4.5] == []


def test_phone_shows_a_single_column(url: str, tab: Open, fly: Fly) -> None:
    """A phone, which lays pages without a viewport out as on a desktop, shows the parts below each other."""
    fly("wing")
    page = tab(width=390, height=844, is_mobile=True)
    page.open(url)
    until(lambda: list(page.states) == ["wing"], "the vehicle")
    assert page.page.evaluate("innerWidth") == 390
    wait_for_none(page.layout_problems, "phone")
    lefts = [
        page.page.locator(f"div.{name}").first.bounding_box()
        for name in ("list", "map", "nums", "plots")
    ]
    assert all(box is not None and box["x"] < 20 for box in lefts), lefts


def test_cut_off_text_has_a_visible_hint(web: Web, tab: Open, tmp_path: Path) -> None:
    """Modes and the table of streams are not cut off; a scrollable card has a bright bottom edge."""
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
        lambda: (
            [(cell.text, cell.is_cut) for cell in page.cells(".row > .mode")[1:]]
            == [("Offboard", False)]
        ),
        "mode",
    )
    page.page.set_viewport_size({"width": 1280, "height": 800})
    page.page.locator("[data-do=streams]").click()
    until(lambda: len(page.cells("td")) == 36, "the streams")
    until(lambda: not page.cells("div.more")[0].is_cut, "the table to fit")
    page.page.set_viewport_size({"width": 1280, "height": 330})
    until(lambda: page.cells("div.why")[0].is_cut, "a card to scroll")
    assert "local" in page.cells("div.why")[0].layers


def wait_for_none(problems: Callable[[], list[str]], what: str) -> None:
    """Wait until there are no problems; fail with those that remain."""
    last: list[str] = []

    def are_gone() -> bool:
        last[:] = problems()
        return not last

    try:
        wait_for(are_gone, what=what, seconds=PAGE_TIMEOUT)
    except AssertionError:
        pytest.fail(f"{what}: {'; '.join(last)}")


def overlapping_labels(page: Tab) -> list[str]:
    """Return the overlapping labels on the map."""
    labels = page.labels()
    return [
        f"{one[0]} on {other[0]}"
        for index, one in enumerate(labels)
        for other in labels[:index]
        if min(one[3], other[3]) - max(one[1], other[1]) > 1
        and min(one[4], other[4]) - max(one[2], other[2]) > 1
    ] or ([] if len(labels) > 2 else ["too few labels"])


def test_hostile_text_is_escaped(
    fly: Fly, tab: Open, zenoh_session: Session, endpoint: str, tmp_path: Path
) -> None:
    """HTML in a peer's rejection reason or in a GeoJSON file is shown as text, not as elements."""
    field = tmp_path / f"{HOSTILE[:24].replace('/', '')}.geojson"
    line = {"type": "LineString", "coordinates": [[8.545, 47.397], [8.546, 47.398]]}
    field.write_text(
        json.dumps(
            {"type": "Feature", "properties": {"name": HOSTILE}, "geometry": line, "id": HOSTILE}
        )
    )
    fly("wing", xy_global=True, ref_lat=47.397, ref_lon=8.545)
    with serving_live(endpoint, PageOptions("127.0.0.1", 0, background=field)) as url:
        page = tab()
        page.open(url)
        key = Address("wing", VLP).rejected_key()
        wait_for_matching(zenoh_session, key)
        zenoh_session.put(key, json.dumps({"reason": HOSTILE, HOSTILE: HOSTILE}))
        page.wait_for_text("1 rejected")
        page.page.locator("[data-do=streams]").click()
        until(lambda: HOSTILE in page.panel("more"), "the reason")
        until(lambda: HOSTILE[:10] in page.panel("why"), "the event")
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


def test_viewers_are_independent(url: str, tab: Open, fly: Fly, zenoh_session: Session) -> None:
    """Two pages show the same fleet; a click, tap or key selects a vehicle or a moment in that page only.

    Whatever a browser changes in its document, the other page is not affected, and nothing is sent to the bus.
    """
    fly("a")
    other = fly("b", x=30.0, y=30.0)
    first, second = pages = tab(width=1280, height=800), tab(width=1280, height=800)
    for page in pages:
        page.open(url)
        until_states(page, a="ok", b="ok")
        until(lambda page=page: page.chosen == ["a"], "the first vehicle")  # type: ignore[misc]  # bound here
    first.page.locator(VEHICLE, has_text="b").click()
    until(lambda: first.chosen == ["b"], "the selection")
    until(lambda: "30.0 m" in first.panel("nums"), "the numbers of b")
    other["xy_valid"] = False
    until_order(second, "b", "a")
    until(lambda: second.chosen == ["b"], "the worst, selected by default")
    second.page.locator(f"{VEHICLE}[data-with=a]").click()
    until(lambda: second.chosen == ["a"], "the selection")
    until_states(first, a="ok", b="xy not valid")
    assert first.page.title() == "(1 bad) nedbus"

    def tap() -> bool:
        second.tap(30, 30)  # a map ignores taps while it is redrawn
        with suppress(AssertionError):
            wait_for(lambda: second.chosen == ["b"], what="the selection", seconds=3)
        return second.chosen == ["b"]

    until(tap, "the selection by a tap")
    second.page.keyboard.press("j")
    until(lambda: second.chosen == ["a"], "the selection by a key")
    until(lambda: "xy not valid from" in first.panel("why"), "the verdict")
    other["xy_valid"] = True
    until(lambda: " to " in first.panel("why"), "the end of the condition")
    first.page.keyboard.press("p")
    first.page.get_by_text("back to now").wait_for()
    until(lambda: set(first.query) == {"vehicle", "time"}, "the URL")
    third = tab(width=1280, height=800)
    third.open(first.url)
    third.page.get_by_text("back to now").wait_for()
    until(lambda: (third.query, third.chosen) == (first.query, ["b"]), "the same moment")
    third.page.close()
    first.page.get_by_text("back to now").click()
    until(lambda: first.query == {"vehicle": "b"}, "the current time")
    until(lambda: second.query == {"vehicle": "a"}, "the other page to be unchanged")
    received: set[str] = set()
    watcher = zenoh_session.declare_subscriber(
        "**", lambda sample: received.add(str(sample.key_expr))
    )
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
    assert received == {f"nedbus/{name}/{VLP}" for name in "ab"}


# Failures


def test_page_reconnects_after_a_server_restart(
    web: Web, browser: Browser, fly: Fly, endpoint: str
) -> None:
    """When `nedbus web` is killed, the page shows a red bar, and reloads once the server is back."""
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
        until(
            lambda: not page.shows("nedbus web has not responded since"), "the page to load again"
        )
        until_states(page, wing="ok")
        assert all(
            "ERR_CONNECTION" in error or "WebSocket" in error or "bokeh" in error
            for error in page.console_errors
        )


# Recordings


def test_playback_controls_move_through_the_recording(web: Web, tab: Open, tmp_path: Path) -> None:
    """Slider, pause, speed, keys and events control the playback; the page shows the state at the playback position."""
    port = free_port()
    web(
        port,
        str(
            write_flight(
                tmp_path, {VLP: lambda time: {"x": time, "xy_valid": time < 60}}, seconds=120
            )
        ),
    )
    page = tab(width=1280, height=800)
    page.open(f"http://127.0.0.1:{port}")
    page.wait_for_text("flight.mcap")

    def time() -> float:
        slider = "[...Bokeh.documents[0].all_models].find(model => model.type == 'Slider')"
        return float(page.page.evaluate(f"{slider}?.value ?? 0"))

    until(lambda: time() > 1, "playback")
    page.page.get_by_text("pause", exact=True).click()
    page.page.get_by_text("play", exact=True).wait_for()
    until(lambda: len(page.marks) == 1, "the vehicle")
    wait_for_none(page.layout_problems, "the layout")

    def seek(fraction: float) -> None:
        # The slider ignores input for 0.3 s after each click.
        bar = page.page.locator(".noUi-target:not(.noUi-state-tap) .noUi-base")
        box = bar.bounding_box()
        assert box is not None
        bar.click(position={"x": box["width"] * fraction, "y": box["height"] / 2})

    seek(0.75)
    until(lambda: page.states == {"wing": "xy not valid"}, "the second minute")
    assert time() == pytest.approx(90, abs=3)
    assert page.marks["wing"]["north"] == pytest.approx(59.9)
    page.wait_for_text("xy not valid from")
    seek(0.25)
    until(lambda: page.states == {"wing": "ok"}, "the first minute")
    assert page.marks["wing"]["north"] == pytest.approx(time(), abs=0.3)
    assert {round(north) for _, north in points(page.source("valid0"), "valid0")} <= set(range(35))
    page.page.locator(".strip [data-do=event]").click()
    until(lambda: time() == pytest.approx(60, abs=0.1), "the moment of the event")
    until_states(page, wing="xy not valid")
    until(lambda: "time" in page.query, "the URL")
    # moves the focus from the button, so that keys reach the page
    page.page.get_by_text("flight.mcap").click()
    for key, seconds in (("ArrowLeft", 59), ("Shift+ArrowLeft", 49), ("ArrowRight", 50), ("n", 60)):
        page.page.keyboard.press(key)
        until(lambda seconds=seconds: time() == pytest.approx(seconds, abs=0.1), key)  # type: ignore[misc]  # bound here
    page.page.locator("[data-do='focus:follow']").press("Enter")
    until(lambda: page.query.get("view") == "follow", "the button to be pressed by a key")
    other = tab(width=1280, height=800)
    other.open(page.url)
    until(lambda: other.states == {"wing": "xy not valid"}, "the same moment")
    other.page.close()
    page.page.locator("select").select_option("50")
    page.page.get_by_text("play", exact=True).click()
    until(lambda: time() == pytest.approx(119.9, abs=0.2), "the end")
