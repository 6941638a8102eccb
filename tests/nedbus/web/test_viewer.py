"""The document of a viewer, without a browser: tracks, panels, map, timeline, moments, and live vehicles of a bus."""

from __future__ import annotations

import json
import math
import re
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, cast

import numpy as np
import pytest
from bokeh.document import Document
from bokeh.document.events import ColumnsPatchedEvent
from bokeh.models import ColumnDataSource
from bokeh.models.annotations import Legend
from bokeh.plotting import figure
from hypothesis import given, strategies as st

import nedbus
from nedbus.client import LogStreamStatus, RejectionReport, reply_parts
from nedbus.health import Fusion, PositionStatus, QuantityFusion
from nedbus.transport import Session, open_router
from nedbus.vehicle_events import AccountReport, Event, VehicleReport
from nedbus.web.column_data import LINE_TYPES, Track, Tracks
from nedbus.web.fleet import TRUTH
from nedbus.web.map import MIN_SIDE
from nedbus.web.server import LiveFleet
from nedbus.web.stream import COLUMNS, History
from nedbus.web.style import DARK, LIGHT, Style
from nedbus_msgs import Address, Selection
from tests.flights.messages import VALID, VLP
from tests.nedbus.web.page import QUAD, WING, RenderedPage, SimulatedFleet, flying, models_of, sim
from tests.peers.ports import free_endpoint
from tests.peers.queryables import answer_queries, reply_with
from tests.waits import wait_for

__all__ = ["sim"]  # a fixture

HOSTILE = "<img src=x onerror=alert(1)>"
GROUND_TRUTH = Address("wing", TRUTH)
SECOND_EKF = Address("wing", "estimator_local_position", 1)


# Tracks


def line_of(tracks: Tracks, index: int, kind: str, ring: int) -> list[tuple[float, float]]:
    """Return the points of a line in drawing order; check the gaps at its ends."""
    begin = index * (ring + 2)
    east, north = (
        np.asarray(tracks.source.data[name], float)[begin : begin + ring + 2].tolist()
        for name in ("east", kind)
    )
    assert math.isnan(east[-1]), "two tracks are joined"
    assert math.isnan(north[-1]), "two tracks are joined"
    assert repr((east[ring], north[ring])) == repr((east[0], north[0])) or math.isnan(north[ring])
    return list(zip(east[:ring], north[:ring], strict=True))


def write_points(history: History, count: int, *, breaks: bool) -> None:
    """Write points to a history, five valid and five dead reckoned in turn; with `breaks` every seventh is a gap."""
    for _ in range(count):
        number = history.written
        row = [math.nan if breaks and number % 7 == 6 else float(number)] * len(COLUMNS)
        row[COLUMNS.index("doubtful")] = float(number // 5 % 2)
        history.write(row)


@given(
    rounds=st.lists(st.tuples(*[st.integers(0, 9) | st.integers(0, 70)] * 3), max_size=30),
    breaks=st.booleans(),
    budget=st.sampled_from([(180, 1), (90, 2), (60, 3)]),
)
def test_incremental_tracks_equal_those_of_a_new_viewer(
    rounds: list[tuple[int, int, int]], breaks: bool, budget: tuple[int, int]
) -> None:
    """After any number of updates a viewer has the same points in the same slots as a new viewer.

    Only the oldest slot may differ: an old viewer may keep it longer. With a smaller budget of points each slot
    covers more of them.
    """
    (limit, step), points = budget, 60
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nedbus.limits.PAGE_TRACK_POINTS", limit)
        patch.setattr("nedbus.web.column_data._LEAST_POINTS", 6)
        histories = {
            Address(*name): Track(History(points, 0.1), number)
            for number, name in enumerate((("a", VLP), ("b", VLP), ("c", TRUTH)))
        }
        tracks, fresh = Tracks(), Tracks()
        for counts in rounds:
            for (history, _), count in zip(histories.values(), counts, strict=True):
                write_points(history, count, breaks=breaks)
            tracks.update(histories)
        tracks.update(histories)
        fresh.update(histories)
    ring = points // step + 2
    assert len(fresh.source.data["east"]) == 3 * (ring + 2)
    for index, (history, _) in enumerate(histories.values()):
        for kind in LINE_TYPES:
            old, new = (line_of(each, index, kind, ring) for each in (tracks, fresh))
            # an old viewer may keep it longer
            oldest = (max(0, history.written - points) - 1) // step % ring
            del old[oldest], new[oldest]
            assert repr(old) == repr(new)


def data_sent(document: Document) -> list[Any]:
    """Return a list that collects the data source events that a document sends after this call."""
    sent: list[Any] = []
    document.on_change(
        lambda event: (
            sent.append(event)
            if isinstance(getattr(event, "model", None), ColumnDataSource)
            else None
        )
    )
    return sent


def tracks_of(sim: SimulatedFleet) -> dict[Address, Track]:
    """Return the last minute of all streams, each with its own colour."""
    return {
        address: Track(stream.minute, number)
        for number, (address, stream) in enumerate(sim.fleet.streams.items())
    }


def test_track_is_a_ring_with_a_line_per_state() -> None:
    """Doubtful positions are on another line; a gap follows the newest point, and the first slot is repeated last."""
    history = History(size=4, step=0.1)
    for number in range(3):
        point = dict.fromkeys(COLUMNS, 0.0)
        point |= {"east": number, "north": 10 + number, "doubtful": float(number == 1)}
        history.write([point[name] for name in COLUMNS])
    tracks = Tracks()
    tracks.update({Address("1", VLP): Track(history, 0)})
    nan = math.nan
    lines = {name: np.array(tracks.source.data[name]) for name in ("east", "valid0", "doubtful")}
    assert lines["east"] == pytest.approx([0, 1, 2, nan, nan, nan, 0, nan], nan_ok=True)
    assert lines["valid0"] == pytest.approx([10, nan, 12, nan, nan, nan, 10, nan], nan_ok=True)
    assert lines["doubtful"][:3] == pytest.approx([nan, 11, nan], nan_ok=True)


def test_history_grows_with_its_points() -> None:
    """A history of 600 points takes under half of its memory for the first one, and always holds the newest points."""
    tracemalloc.start()
    try:
        history = History(size=600, step=0.1)
        history.write([0.0] * len(COLUMNS))
        used, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert used < 20_000
    for number in range(1, 1000):
        history.write([float(number)] * len(COLUMNS))
        first = max(0, number - 599)
        assert history.points()[:, 0].tolist() == list(range(first, number + 1))


def test_tracks_send_only_new_points(sim: SimulatedFleet) -> None:
    """An update patches only the new points and the gap; without a new point it sends nothing."""
    tracks, document, plot = Tracks(), Document(), figure()
    plot.line("east", LINE_TYPES[0], source=tracks.source)
    document.add_root(plot)
    sim.fly(30, WING, QUAD)
    tracks.update(tracks_of(sim))
    sent = data_sent(document)
    tracks.update(tracks_of(sim))
    assert not sent
    sim.fly(0.1, WING)
    tracks.update(tracks_of(sim))
    (event,) = sent
    assert isinstance(event, ColumnsPatchedEvent)
    assert 0 < sum(len(patch) for patch in event.patches.values()) <= 3 * 4


def test_points_per_track_shrink_with_the_number_of_tracks(sim: SimulatedFleet) -> None:
    """With 200 vehicles a track has one point per second, so a browser draws no more points than with 20 vehicles."""
    sim.fly(0.1, *[Address(f"v{number}", VLP) for number in range(200)])
    tracks = Tracks()
    tracks.update(tracks_of(sim))
    assert len(tracks.source.data["east"]) <= 200 * 64


# Panels


class Page(RenderedPage):
    """The document of a viewer of a simulated fleet."""

    def __init__(self, sim: SimulatedFleet, **options: Any) -> None:
        super().__init__(sim.fleet, sim.timeline, **options)
        self._sim = sim
        self.refresh()

    def refresh(self, **options: Any) -> None:
        """Poll the fleet and update the page."""
        self._sim.poll(**options)
        self.update()

    @property
    def pinned(self) -> float | None:
        return self.viewer.pinned

    def tap(self, column: str, text: str) -> None:
        """Tap the mark with this text in the first data source that has this column."""
        source = next(
            each for each in sources(self) if column in each.data and "words" in each.data
        )
        source.selected.indices = [list(source.data["words"]).index(text)]
        assert source.selected.indices == [], "the same mark cannot be tapped again"
        self.update()


def sources(page: RenderedPage) -> list[ColumnDataSource]:
    return models_of(page.document, ColumnDataSource)


@pytest.mark.slow
def test_ulog_stream_state_is_shown_escaped(sim: SimulatedFleet) -> None:
    """A line describes the ULog stream of the selected vehicle; its text comes from a peer and is escaped."""
    page = Page(sim)
    sim.fly(3)
    page.refresh()
    assert "ULog stream" not in page.text
    page.refresh(
        logs={
            "wing": LogStreamStatus(
                vehicle="wing", state="refused", reason="<b>another client has it"
            )
        }
    )
    assert "ULog stream" in page.text
    assert "refused, &lt;b&gt;another client has it" in page.text


@pytest.mark.slow
def test_use_of_an_external_position_is_shown_escaped(sim: SimulatedFleet) -> None:
    """A line tells whether the selected vehicle uses a position that it receives; it is amber if a cause is known."""
    page = Page(sim)
    sim.fly(3)
    page.refresh()
    assert "external position" not in page.text
    fused, yaw = QuantityFusion("position", "fused", 5.0), QuantityFusion("yaw", "fused", 5.0)
    page.refresh(fusion={"wing": Fusion("wing", (fused, yaw), echoed=40.0)})
    assert (
        '<div class="quiet">external position: position, yaw fused since 5.0 s; PX4 receives 40.0 Hz'
        in page.text
    )
    rejected = QuantityFusion("yaw", "rejected", 5.0, cause="q is no unit quaternion")
    sent = PositionStatus(vehicle="wing", address="mocap/vehicle_odometry", sender="<b>", sent=7)
    page.refresh(fusion={"wing": Fusion("wing", (fused, rejected), sent)})
    assert (
        '<div class="watch">external position: sent: 7 positions of mocap/vehicle_odometry sent'
        in page.text
    )
    assert (
        "from &lt;b&gt;; position fused since 5.0 s; yaw rejected since 5.0 s: q is no unit quaternion"
        in page.text
    )


@pytest.mark.slow
def test_all_panels_show_the_same_snapshot(sim: SimulatedFleet) -> None:
    """Counts, title, rows, badges and markers agree; before the first message the header shows "waiting"."""
    page = Page(sim)
    assert "waiting for the first message" in page.panel("head")
    assert page.vehicles == []
    sim.fly(3, WING, GROUND_TRUTH, x=5.0, z=-7.0)
    sim.fly(3, QUAD, x=5.0, z=-7.0, xy_valid=False)
    page.refresh()
    assert "■ 1 bad" in page.panel("head")
    assert "● 1 ok" in page.panel("head")
    assert page.document.title == "(1 bad) nedbus"
    assert page.listed["quad"]["title"] == page.states["quad"] == "xy not valid"
    assert page.grades == {"quad": "bad", "wing": "ok"}
    assert page.chosen == "quad"
    assert "■ xy not valid" in page.panel("why")
    assert "last valid position: none yet" in page.panel("why")
    assert "no valid position yet: quad" in page.panel("tool")
    assert set(page.marks) == {"wing"}
    sim.fly(3, WING, QUAD, x=5.0, z=-7.0)
    page.refresh(alive=[WING, QUAD])
    assert page.grades == {"quad": "ok", "wing": "ok"}
    assert "● 2 ok" in page.panel("head")
    assert page.document.title == "nedbus"
    assert page.marks["quad"]["north"] == 5.0
    assert "<span>height</span><b>7.0 m</b>" in page.panel("nums")
    sim.time += 5
    page.refresh(alive=[])
    assert "■ 2 bad" in page.panel("head")
    assert page.states == {"quad": "gone", "wing": "gone"}
    assert {mark["shape"] for mark in page.marks.values()} == {"square"}


@pytest.mark.slow
def test_bad_secondary_estimates_do_not_mark_the_vehicle_bad(sim: SimulatedFleet) -> None:
    """An invalid second EKF or ground truth appears in the table of streams, but not in list, header, title or map."""
    sim.fly(1, WING, SECOND_EKF, GROUND_TRUTH)
    for _ in range(50):
        sim.fly(0.1)
        for other in (SECOND_EKF, GROUND_TRUTH):
            sim.add(other, xy_valid=False, dead_reckoning=True)
    page = Page(sim)
    assert (page.grades, page.document.title) == ({"wing": "ok"}, "nedbus")
    assert "no recent faults" in page.panel("why")
    assert page.marks["wing"]["shape"] == "circle"
    assert "1 bad" not in page.panel("head")
    page.send("streams")
    assert page.panel("more").count("xy invalid, dead reckoning") == 2


@pytest.mark.slow
def test_overloaded_page_is_reported_in_the_header(sim: SimulatedFleet) -> None:
    """If the page falls behind, the header reports it, and no vehicle changes its state."""
    sim.fly(3, WING, QUAD)
    page = Page(sim)
    assert "page up to date" in page.panel("head")
    sim.time += 20
    own = "this page falls behind: 7000 messages queued, 12 dropped"
    page.refresh(alive=[WING, QUAD], is_behind=True, behind=own)
    assert f'<span class="alarm">{own}</span>' in page.panel("head")
    assert "page up to date" not in page.panel("head")
    assert page.grades == {"quad": "ok", "wing": "ok"}
    assert page.document.title == "nedbus"


@pytest.mark.slow
def test_streams_without_position_are_listed_but_not_mapped(sim: SimulatedFleet) -> None:
    """The table shows rates and states of streams without a position; a vehicle without a position has no marker."""
    attitude, battery = Address("wing", "vehicle_attitude"), Address("far", "battery_status", 0)
    sim.fly(3, WING, attitude, battery, x=4.0)
    page = Page(sim)
    assert page.vehicles == ["far", "wing"]
    assert set(page.marks) == {"wing"}
    page.send("vehicle", "far")
    assert page.chosen == "far"
    assert page.panel("nums").count("<b>-</b>") == 9
    assert len(page.plotted["speed"]) == 0
    page.send("vehicle", "wing")
    assert "▸ 2 streams of wing" in page.panel("more")
    assert "vehicle_attitude" not in page.panel("more")
    page.send("streams")
    row = ["10", "0", "0", "-", "ok"]
    assert {name: cells for name, *cells in page.table()} == {"vehicle_attitude": row, VLP: row}
    assert len(page.plotted["speed"]) > 20


@pytest.mark.slow
def test_status_values_are_in_row_and_tiles(sim: SimulatedFleet) -> None:
    """The row shows mode, battery and GPS; the tiles also show the arming state."""
    sim.fly(2, x=-0.01, heading=-0.001)
    sim.add(Address("wing", "vehicle_status"), nav_state=4, arming_state=2)
    sim.add(Address("wing", "battery_status", 0), remaining=0.5)
    sim.add(Address("wing", "sensor_gps", 0), fix_type=3, satellites_used=14)
    page = Page(sim)
    row = page.listed["wing"]
    assert (row["mode"], row["battery"], row["gps"]) == ("Hold", "50 %", "3D · 14")
    for name, text in (("armed", "armed"), ("mode", "Hold"), ("north", "0.0 m"), ("heading", "0°")):
        assert f"<span>{name}</span><b>{text}</b>" in page.panel("nums")


@pytest.mark.slow
def test_values_of_silent_streams_show_their_age(sim: SimulatedFleet) -> None:
    """The tiles show the last values of a silent stream or a gone vehicle with their age; the row shows "-"."""
    status, battery = Address("wing", "vehicle_status"), Address("wing", "battery_status", 0)
    for _ in range(50):
        sim.fly(0.2, z=-7.0)
        sim.add(status, nav_state=4, arming_state=2)
        sim.add(battery, remaining=0.5)
    page = Page(sim)
    assert "ago" not in page.panel("nums")
    for _ in range(50):
        sim.fly(0.2, z=-7.0)
        sim.add(status, nav_state=4, arming_state=2)
    page.refresh()
    assert (page.listed["wing"]["mode"], page.listed["wing"]["battery"]) == ("Hold", "-")
    assert '<b class="quiet">50 %</b> <small>10.0 s ago</small>' in page.panel("nums")
    assert "<span>armed</span><b>armed</b>" in page.panel("nums")
    sim.time += 2100
    page.refresh(alive=[])
    row = page.listed["wing"]
    assert (row["text"], row["mode"], row["battery"], row["gps"]) == ("gone", "-", "-", "-")
    for name, text in (
        ("armed", "armed"),
        ("battery", "50 %"),
        ("height", "7.0 m"),
        ("heading", "0°"),
    ):
        assert (
            f'<span>{name}</span><b class="quiet">{text}</b> <small>35 min ago</small>'
            in page.panel("nums")
        )


@pytest.mark.long
def test_attitude_is_shown_as_angles_in_degrees(sim: SimulatedFleet) -> None:
    """Below the tiles are roll, pitch and yaw of the attitude, "-" if it is unknown, with an age if it is silent."""
    attitude = Address("wing", "vehicle_attitude")
    sim.fly(3)
    assert "roll" not in Page(sim).panel("nums")
    turned = nedbus.frames.euler_to_quaternion(
        *(math.radians(degrees) for degrees in (10.0, -20.0, 90.0))
    )
    for q, text in (
        (turned, "roll 10.0°, pitch -20.0°, yaw 90.0°"),
        ((math.nan,) * 4, "roll -, pitch -, yaw -"),
    ):
        for _ in range(20):
            sim.fly(0.1)
            sim.add(attitude, q=q)
        assert f'<div class="quiet">{text}</div>' in Page(sim).panel("nums")
    sim.fly(10)
    assert "yaw -, 10.0 s ago</div>" in Page(sim).panel("nums")


@pytest.mark.slow
def test_rates_of_a_slow_stream_are_shown_below_the_numbers(sim: SimulatedFleet) -> None:
    """If positions arrive at less than half the usual rate, both rates are shown below the numbers."""
    sim.fly(20, rate=20)
    sim.fly(3, rate=5)
    page = Page(sim)
    state, health = sim.view().state, sim.view().health
    assert state.name == "slow"
    assert health.rate == pytest.approx(5)
    assert health.usual_rate is not None
    assert 2 * 5 < health.usual_rate <= 20  # smoothed
    (text,) = page.texts("nums", "watch")
    assert text == str(state)
    assert "5.0 Hz" in text
    assert f"usually {health.usual_rate:.0f}" in text
    assert page.grades == {"wing": "ok"}


@pytest.mark.slow
def test_story_explains_the_displayed_state(sim: SimulatedFleet) -> None:
    """With several active conditions, the story explains the one shown in badge and list, whichever began first."""
    gps = Address("wing", "sensor_gps", 0)
    for seconds, state, fields in ((5, 1, {}), (5, 3, {}), (5, 3, {"dead_reckoning": True})):
        for _ in range(seconds):
            sim.fly(1, **fields)
            sim.add(gps, fix_type=3, satellites_used=14, jamming_state=state)
    page = Page(sim)
    (badge,), (verdict,) = page.texts("why", "badge"), page.texts("why", "verdict")
    assert badge.split(maxsplit=1)[1] == page.states["wing"] == "dead reckoning"
    assert re.match(
        r"position valid since \d\d:\d\d:\d\d\.\d UTC, but dead reckoning from", verdict
    )


@pytest.mark.slow
def test_open_marker_stays_at_the_last_valid_position(sim: SimulatedFleet) -> None:
    """The marker of a silent or invalid vehicle is open, has the shape of its state, and stays in place."""
    sim.fly(3, WING, QUAD, x=4.0, y=2.0)
    page = Page(sim)
    assert page.marks["wing"]["shape"] == "circle"
    assert page.marks["wing"]["fill"] == page.marks["wing"]["colour"] != DARK.colours["ground"]
    sim.add(xy_valid=False)
    page.refresh()
    assert (page.marks["wing"]["shape"], page.marks["wing"]["fill"]) == (
        "square",
        DARK.colours["ground"],
    ), "at once"
    sim.fly(3, WING, x=99.0, xy_valid=False)
    page.refresh(alive=[WING])
    assert page.marks["wing"]["words"] == "xy not valid"
    assert page.marks["quad"]["words"].startswith("gone")
    for mark in page.marks.values():
        assert (mark["shape"], mark["fill"]) == ("square", DARK.colours["ground"])
        assert (mark["north"], mark["east"]) == (4.0, 2.0)
        assert mark["edge"] == DARK.colours["bad"]


@pytest.mark.slow
def test_selection_survives_reordering(sim: SimulatedFleet) -> None:
    """By default the worst vehicle is selected; a selection by the user survives a change of the order.

    Vehicles are selected in the list, on the map, or by keys, which wrap around; an unknown name is ignored.
    """
    sim.fly(3, WING, QUAD)
    page = Page(sim)
    assert page.chosen == "quad"
    for action, value, chosen in (
        ("vehicle", "unknown", "quad"), ("vehicle", "wing", "wing"), ("down", "", "quad"), ("up", "", "wing"),
        ("up", "", "quad"), ("down", "", "wing"),
    ):  # fmt: skip
        page.send(action, value)
        assert page.chosen == chosen
        assert [name for name, row in page.listed.items() if row["chosen"] == "true"] == [chosen]
    sim.fly(3, QUAD, xy_valid=False)
    sim.fly(0.1, WING)
    page.refresh()
    assert page.vehicles == ["quad", "wing"]
    assert page.chosen == "wing"
    for name in ("quad", "wing", "quad", "quad"):
        page.tap("shape", page.marks[name]["words"])
        assert page.chosen == name


@pytest.mark.slow
def test_search_filters_by_name_and_state(sim: SimulatedFleet) -> None:
    """The list shows the vehicles whose name or state contains the search text; counts and map show all vehicles."""
    sim.fly(3, WING, Address("wind", VLP), QUAD)
    sim.fly(3, Address("wind", VLP), QUAD, xy_valid=False)
    page = Page(sim)
    for text, found in (
        (" WIN ", ["wind", "wing"]),
        ("not VALID", ["quad", "wind"]),
        (HOSTILE, []),
        ("", 3),
    ):
        page.search(text)
        assert page.vehicles == found if isinstance(found, list) else len(page.vehicles) == found
        assert "2 bad" in page.panel("head")
        assert len(page.marks) == 3
    assert HOSTILE not in page.text


@pytest.mark.slow
def test_text_from_peers_is_escaped(sim: SimulatedFleet) -> None:
    """Rejection reasons, link faults, titles and URL arguments are escaped wherever they are shown."""
    sim.fly(3)
    for reason in ("the first", HOSTILE):
        sim.event_log.reject(WING, reason, sim.time)
        sim.fleet.reject([RejectionReport(WING, reason, round(sim.time * 1e9))])
        sim.time += 20
        sim.poll()
    assert any(HOSTILE in event.text for event in sim.timeline.events)
    sim.fly(0.1)
    page = Page(sim, title=HOSTILE, query="?view=%3Cimg&theme=%3Cimg&time=%3Cimg")
    page.send("streams")
    page.refresh(link=HOSTILE, behind=HOSTILE)
    assert "2 rejected" in page.panel("head")
    assert "<img" not in page.text
    assert page.panel("head").count("&lt;img") == 3
    assert [cells[1:] for cells in page.table(1)] == [
        ["wing/vehicle_local_position", HOSTILE],
        [str(WING), "the first"],
    ]
    for name in ("wing<img", "<img", 'a"b', "a b", "²"):
        with pytest.raises(ValueError, match="is not valid"):
            Address(name, VLP)


@pytest.mark.slow
def test_plots_are_added_one_by_one(sim: SimulatedFleet) -> None:
    """Plots do not delay map and list: each is added only after the browser has drawn an update."""
    sim.fly(3, WING, Address("far", "vehicle_status"))
    viewer = (page := Page(sim, query="?vehicle=wing")).viewer
    assert len(viewer._grid.children) == 3
    assert viewer._grid.visible
    page.send("vehicle", "far")
    assert not viewer._grid.visible, "without a position, empty plots would take space on a phone"
    other = RenderedPage(sim.fleet, sim.timeline).viewer
    for drawn, count in (("", 0), ("", 0), ("1", 1), ("2", 2), ("3", 3), ("4", 3)):
        other._drawn.value = drawn
        other.update()
        assert len(other._grid.children) == count


@pytest.mark.slow
def test_legend_does_not_cover_the_lines(sim: SimulatedFleet) -> None:
    """A plot with several lines names them above its frame, not inside, where the lines are."""
    sim.fly(3, WING)
    plots: list[Any] = Page(sim, query="?vehicle=wing").viewer._grid.children
    legends = [(plot, legend) for plot in plots for legend in plot.select({"type": Legend})]
    assert [[item.label.value for item in legend.items] for _, legend in legends] == [
        ["eph", "epv", "error to ground truth [m]"]
    ]
    assert all(legend in plot.above and legend not in plot.center for plot, legend in legends)


@pytest.mark.slow
def test_px4_texts_are_quoted_and_escaped(sim: SimulatedFleet) -> None:
    """PX4's texts appear quoted and escaped on the timeline and in the story, and do not change the state."""
    sim.fly(2)
    sim.add(Address("wing", "log_message"), severity=2, text=HOSTILE)
    sim.fly(1, xy_valid=False)
    sim.add(Address("wing", "log_message"), severity=6, text="Landing detected")
    sim.fly(1, xy_valid=False)
    page = Page(sim)
    assert page.states == {"wing": "xy not valid"}
    timeline = [(row["words"], row["marker"]) for row in page.rows("vehicle")]
    assert timeline == [
        (f'PX4: "{HOSTILE}"', "square"), ("xy not valid", "square"), ('PX4: "Landing detected"', "circle"),
    ]  # fmt: skip
    assert "PX4: &#34;&lt;img src=x onerror=alert(1)&gt;&#34;" in page.panel("why")
    assert "<img" not in page.text


@pytest.mark.slow
def test_viewers_share_no_model(sim: SimulatedFleet) -> None:
    """Each viewer has its own Bokeh models."""
    sim.fly(3)
    first, second = ([*page.document.models] for page in [Page(sim), Page(sim)])
    assert not set(map(id, first)) & set(map(id, second))


@pytest.mark.slow
def test_update_without_changes_sends_nothing(sim: SimulatedFleet) -> None:
    """Without new messages an update sends no data."""
    sim.fly(3, WING, heading=None)
    sim.fly(3, WING, heading=None, dead_reckoning=True)
    page = Page(sim)
    sent = data_sent(page.document)
    page.update()
    assert not sent


# Map


def frame_of(page: Page) -> tuple[list[float], list[float]]:
    """Return the extent of the map: [west, east], [south, north] [m]."""
    frame = next(each for each in sources(page) if set(each.data) == {"east", "north"})
    return list(frame.data["east"]), list(frame.data["north"])


@pytest.mark.slow
def test_map_fits_all_vehicles_or_follows_one(sim: SimulatedFleet) -> None:
    """The map shows all vehicles with trails, or the selected one centred, or its whole trail, and at least 20 m."""
    sim.fly(3, WING)
    page = Page(sim)
    east, north = frame_of(page)
    assert east[1] - east[0] >= MIN_SIDE
    assert north[1] - north[0] >= MIN_SIDE
    for number in range(30):
        sim.fly(0.1, WING, x=-2.0 * number)
        sim.fly(0.1, QUAD, x=300.0, y=-500.0)
    page.refresh()
    east, north = frame_of(page)
    assert east[0] < -500 < 0 < east[1] < 100
    assert -100 < north[0] < -58 < 300 < north[1] < 400
    page.send("focus:follow")
    page.send("vehicle", "wing")
    assert frame_of(page) == ([-30, 30], [-88, -28])
    page.send("focus:vehicle")
    east, north = frame_of(page)
    assert -80 < north[0] <= -58 < 0 <= north[1] < 20
    page.send("focus:nonsense")
    assert frame_of(page) == (east, north)
    assert page.url_query == "?vehicle=wing&view=vehicle"


@pytest.mark.slow
@pytest.mark.parametrize("size", ["340x330", "560x430", "1100x700"])
def test_labels_do_not_overlap(sim: SimulatedFleet, size: str) -> None:
    """With 50 vehicles close together only labels that fit are shown, selected and bad vehicles first."""
    places = {
        f"uav-{number}": (7.0 * (number // 10), 11.0 * (number % 10)) for number in range(1, 51)
    }
    for _ in range(5):
        sim.time += 0.1
        for name, (x, y) in places.items():
            sim.add(
                Address(name, VLP),
                x=x,
                y=y,
                xy_valid=True,
                z_valid=name not in ("uav-17", "uav-50"),
            )
    page = Page(sim, query="?vehicle=uav-23")
    page.send("size", size)
    width, height = map(int, size.split("x"))
    east, north = frame_of(page)
    scale = max((east[1] - east[0]) / width, (north[1] - north[0]) / height)
    shown = [mark for mark in page.marks.values() if mark["label"]]
    boxes = []
    for mark in shown:
        wide = 6 * len(mark["label"])
        left = mark["offset"] - wide * (mark["align"] == "right")
        boxes.append((mark["east"] / scale + left, mark["north"] / scale, wide))
    for index, (x, y, wide) in enumerate(boxes):
        for other_x, other_y, other_wide in boxes[:index]:
            assert abs(y - other_y) >= 12 or x + wide < other_x or other_x + other_wide < x
    assert {"uav-23", "uav-17"} <= {mark["label"] for mark in shown}
    assert all(mark["label"] == mark["name"] for mark in shown)
    for mark, (x, y, wide) in zip(shown, boxes, strict=True):
        for other in page.marks.values():
            is_on = 1 < other["north"] / scale - y < 21 and x < other["east"] / scale < x + wide
            assert not is_on or mark["name"] in ("uav-23", "uav-17", "uav-50"), (
                "it covers another marker"
            )


@pytest.mark.slow
def test_trail_length_toggles_between_one_and_fifteen_minutes(sim: SimulatedFleet) -> None:
    """The action "trail" shows 15 minutes on map and plots, then a minute again."""
    for _ in range(20):
        sim.fly(10, rate=5)
    page = Page(sim)
    assert page.plot_range == pytest.approx((sim.time - 60, sim.time), abs=0.01)
    minute = len(page.plotted["speed"])
    page.send("trail")
    assert "trail 15 min" in page.panel("tool")
    assert page.plot_range == pytest.approx((sim.time - 600, sim.time), abs=0.01)
    assert page.plotted["time"][0] < (sim.time - 190) * 1e3
    page.send("trail")
    assert len(page.plotted["speed"]) == minute
    assert 'data-do="truth" aria-pressed="true"' in page.panel("tool")
    page.send("truth")
    assert 'data-do="truth" aria-pressed="false"' in page.panel("tool")


# Timeline


@pytest.mark.slow
def test_timeline_counts_hidden_vehicles(sim: SimulatedFleet) -> None:
    """The selected vehicle and those with faults come first; with 50 vehicles, the last row counts the hidden ones."""
    addresses = [Address(f"uav-{number}", VLP) for number in range(1, 51)]
    sim.fly(1, *addresses)
    sim.fly(1, addresses[29], xy_valid=False)
    sim.fly(0.1, *addresses)
    timeline = Page(sim, query="?vehicle=uav-9").viewer._timeline_plot.figure
    labels: dict[int, str] = cast("Any", timeline).yaxis[0].major_label_overrides
    assert [labels[row] for row in sorted(labels, reverse=True)] == [
        "uav-9", "uav-30", "uav-1", "uav-2", "uav-3", "uav-4", "+44 more",
    ]  # fmt: skip
    assert sorted(cast("Any", timeline).yaxis[0].ticker.ticks) == sorted(labels)
    assert cast("Any", timeline).y_range.start < min(labels)


@pytest.mark.slow
def test_timeline_has_a_legend(sim: SimulatedFleet) -> None:
    """The title of the timeline explains each symbol."""
    figure = cast("Any", Page(sim).viewer._timeline_plot.figure)
    for words in ("■ bad", "▲ watch", "● flight phase", "▬ duration", "┊ now"):
        assert words in figure.title.text


@pytest.mark.slow
def test_timeline_begins_with_the_first_event(sim: SimulatedFleet) -> None:
    """The live timeline begins with the first event, but covers at least one minute and at most ten."""
    sim.fly(3)
    page = Page(sim)

    def shown() -> tuple[float, float]:
        page.send("focus:all")
        span: Any = page.viewer._timeline_plot.range
        return span.start / 1e3 - sim.time, span.end / 1e3 - sim.time

    assert shown() == pytest.approx((-61, 0), abs=0.2)
    sim.fly(1, xy_valid=False)
    sim.fly(199)
    page.refresh()
    assert shown() == pytest.approx((-201, 0), abs=0.2)
    sim.fly(500)
    page.refresh()
    assert shown() == pytest.approx((-61, 0), abs=0.2)


# Moments


@pytest.fixture
def faulty_fleet(sim: SimulatedFleet) -> SimulatedFleet:
    """Return two vehicles: xy of "wing" was invalid 200 s ago, and reset 50 s ago; "quad" was dead reckoning."""
    sim.fly(30.04, WING, QUAD)
    for seconds, wing, quad in (
        (4, {"xy_valid": False}, {}), (96, {}, {}), (4, {}, {"dead_reckoning": True}), (46, {}, {}),
        (50, {"x": 30.0, "xy_reset_counter": 1, "delta_xy": (30.0, 0.0)}, {}),
    ):  # fmt: skip
        for _ in range(seconds * 10):
            sim.time += 0.1
            sim.add(WING, **wing)
            sim.add(QUAD, **quad)
            if not round(sim.time * 10) % 5:
                sim.poll(alive=[WING, QUAD])
    sim.poll(alive=[WING, QUAD])
    return sim


def event_of(sim: SimulatedFleet, text: str) -> float:
    """Return the time of the first event with this text."""
    return next(event.time for event in sim.timeline.events if event.text.startswith(text))


@pytest.mark.slow
def test_tapped_event_pins_plots_to_its_time(faulty_fleet: SimulatedFleet) -> None:
    """A tapped event pins plots and story to its time until "back to now"; list and map stay current."""
    page = Page(faulty_fleet, query="?vehicle=quad")
    assert (page.pinned, page.url_query) == (None, "?vehicle=quad")
    page.tap("row", "xy not valid")
    then = event_of(faulty_fleet, "xy not valid")
    assert (page.chosen, page.pinned) == ("wing", then)
    assert page.plot_range == pytest.approx((then - 30, then + 30), abs=0.01)
    assert "xy not valid from 22:13:50.1 to 22:13:54.1 UTC (4.0 s)" in page.panel("why")
    assert page.grades["wing"] in ("ok", "watch")
    assert "back to now" in page.panel("tool")
    assert f"time={then:.1f}" in page.url_query
    times = page.plotted["time"]
    assert times[0] / 1e3 < then < times[-1] / 1e3
    faulty_fleet.fly(5, WING, QUAD, x=30.0, xy_reset_counter=1)
    page.refresh()
    assert page.pinned == then
    page.send("now")
    assert page.pinned is None
    assert "back to now" not in page.panel("tool")
    assert "time=" not in page.url_query
    assert page.plot_range == pytest.approx((faulty_fleet.time - 60, faulty_fleet.time), abs=0.01)


@pytest.mark.slow
def test_tapped_map_event_pins_plots_to_its_time(faulty_fleet: SimulatedFleet) -> None:
    """An event is marked on the map at the vehicle's position at that time; the mark can be tapped repeatedly."""
    page = Page(faulty_fleet, query="?vehicle=wing")
    source = next(
        each for each in sources(page) if "marker" in each.data and "row" not in each.data
    )
    assert source.data["words"] == ["reset of xy by 30.0 m (30.0 north, 0.0 east)"]
    for _ in range(2):
        source.selected.indices = [0]
        page.update()
        assert page.pinned == event_of(faulty_fleet, "reset")
        assert "reset of xy by 30.0 m" in page.panel("why")
        page.send("now")


@pytest.mark.slow
def test_keys_step_through_events(faulty_fleet: SimulatedFleet) -> None:
    """The key p shows the previous event of the selected vehicle, n the next one, and Escape the current time."""
    page = Page(faulty_fleet, query="?vehicle=wing")
    reset, begin = event_of(faulty_fleet, "reset"), event_of(faulty_fleet, "xy not valid")
    page.send("next")
    assert page.pinned is None
    for action, moment in (
        ("previous", reset), ("previous", begin), ("previous", begin), ("next", reset), ("next", reset), ("now", None),
    ):  # fmt: skip
        page.send(action)
        assert page.pinned == moment
    page.send("play")
    page.send("left")
    assert page.pinned is None


@pytest.mark.slow
@pytest.mark.parametrize("event", ["xy not valid", "reset", None])
def test_url_restores_the_page(faulty_fleet: SimulatedFleet, event: str | None) -> None:
    """A page opened with another page's URL shows the same vehicle, view, theme, moment and verdict."""
    page = Page(faulty_fleet, query="?theme=light")
    page.send("vehicle", "wing")
    page.send("focus:follow")
    if event is not None:
        page.send("previous")
        if event != "reset":
            page.send("previous")
    other = Page(faulty_fleet, query=page.url_query)
    other.update()
    assert other.url_query == page.url_query
    assert other.chosen == "wing"
    assert other.pinned == (None if event is None else pytest.approx(page.pinned, abs=0.06))
    assert other.panel("tool") == page.panel("tool")
    assert len(other.texts("why", "verdict")) == 1
    # no durations
    shown, restored = (
        re.sub(r"\([^)]*\)", "", each.texts("why", "body")[0]) for each in (page, other)
    )
    assert restored == shown
    assert other.marks["wing"]["colour"] in LIGHT.vehicles


QUERIES = (
    "vehicle=&view=&time=&theme=", "time=nan", "time=inf", "time=-1e300", "time=99:99:99", "time=25:61",
    "time=1e18", "vehicle=unknown&view=__class__&time=0", f"vehicle={'x' * 5000}&time={'9' * 5000}",
    "time=%00&vehicle=%FF%00",
)  # fmt: skip


@pytest.mark.parametrize(
    "query",
    [
        each if index % 4 == 1 else pytest.param(each, marks=pytest.mark.slow)
        for index, each in enumerate(QUERIES)
    ],
)
def test_invalid_url_arguments_are_ignored(faulty_fleet: SimulatedFleet, query: str) -> None:
    """Invalid URL arguments are ignored; if the vehicle is unknown, another can be selected."""
    page = Page(faulty_fleet, query=query)
    page.update()
    assert page.vehicles == ["wing", "quad"]
    page.send("vehicle", "quad")
    page.send("now")
    assert page.url_query == "?vehicle=quad"


MALFORMED = (
    "", "null", "7", "[]", "[1, 2]", "[1, 2, 3]", '["vehicle"]', '["event", "-1", 1]', '["event", "²", 1]', "[" * 200,
    f'["event", "{"9" * 250}", 1]', f'["event", {"9" * 250}, 1]', '["event", "1e9", 1]', '["event", null, 1]',
    '["size", "0x0", 1]', '["size", "-5x5", 1]', '["size", "99999999999x1", 1]', '["size", "x", 1]', '["size", {}, 1]',
    '["size", "1x1", 1]', '["left:999", "", 1]', '["Left", "x", 1]', '["LEFT:", "", 1]', '["right:x", [], 1]',
    '["__class__", "", 1]', '["focus:__class__", "", 1]', '["focus", ["all"], 1]', '["vehicle", {"a": 1}, 1]',
    '{"a": 1, "b": 2, "c": 3}', '["\\ud800", "\\ud800", 1]', '["vehicle:\\u0000", "", 1]', '["TRAIL", NaN, 1]',
    "x" * 9**6,
    '["play", "", 1]', '["next", "", 1]', '["previous", "", 1]', '["now", "", 1]', '["theme", "", 1]',
    '["act", "[]", 1]',
)  # fmt: skip


@pytest.mark.slow
def test_malformed_input_from_the_browser_is_ignored(faulty_fleet: SimulatedFleet) -> None:
    """No action, index, size, update number, selection or range from a browser stops the updates of its page."""
    page = Page(faulty_fleet)
    for message in MALFORMED:
        page.send_raw(message)
    for source in sources(page):
        for indices in ([99], [-99], [-1], [10**18], [0, 5], []):
            source.selected.indices = indices
            page.update()
    figures = list(page.document.select({"type": figure}))
    ranges: list[Any] = [
        (0.0, 5e-324),
        (math.nan, math.nan),
        (-math.inf, math.inf),
        (5.0, -5.0),
        ("a", 7.0),
        (None, 1.0),
    ]
    for start, end in ranges:
        for plot in figures:
            for name, value in (("start", start), ("end", end)):
                with suppress(ValueError):  # Bokeh also rejects it from a browser
                    setattr(cast("Any", plot).x_range, name, value)
        page.update()
    for drawn in ("", "x", "-5", "1e9", "9" * 6000, "²", "NaN"):
        page.viewer._drawn.value = drawn
        page.update()
    page.search("x" * 10**6)
    page.search("")
    page.send("now")
    page.send("vehicle", "wing")
    page.refresh()
    assert page.vehicles == ["wing", "quad"]
    assert page.chosen == "wing"
    assert page.panel("list").count("<div") == 4


@pytest.mark.slow
def test_updates_pause_while_the_browser_does_not_draw(sim: SimulatedFleet) -> None:
    """At most two updates are sent ahead of the last one that the browser has drawn."""
    sim.fly(3)
    page = Page(sim)
    drawn = page.viewer._sent
    for _ in range(10):
        sim.fly(0.1)
        sim.poll()
        page.viewer.update()
    assert page.viewer._sent == drawn + 2
    sent = data_sent(page.document)
    page.viewer.update()
    assert not sent
    page.viewer._drawn.value = str(drawn + 1)
    page.viewer.update()
    assert sent


def contrast(one: str, other: str) -> float:
    """Return the contrast ratio of two colours (WCAG 2)."""

    def luminance(colour: str) -> float:
        parts = [int(colour[index : index + 2], 16) / 255 for index in (1, 3, 5)]
        linear = [
            part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts
        ]
        return sum(
            weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True)
        )

    bright, dim = sorted((luminance(one), luminance(other)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


@pytest.mark.parametrize("style", [DARK, LIGHT], ids=lambda style: style.name)
def test_colours_have_sufficient_contrast(style: Style) -> None:
    """Text has a contrast ratio of 4.5 to its background, marks and lines 3; no vehicle has the colour of a state."""
    colours = style.colours
    for ground in ("ground", "panel", "chosen"):
        for text in ("text", "quiet", "bad", "watch", "ok"):
            assert contrast(colours[text], colours[ground]) >= 4.5, (text, ground)
    for grade in ("bad", "watch", "ok"):
        assert contrast(colours[grade], colours[f"{grade}-fill"]) >= 4.5, grade
    for colour in (*style.vehicles, colours["truth"]):
        assert contrast(colour, colours["ground"]) >= 3, colour
    assert not set(style.vehicles) & set(colours.values())


# Live vehicles of a real bus


@contextmanager
def open_page(
    endpoint: str,
) -> Iterator[tuple[RenderedPage, Callable[[Callable[[], object], str], None]]]:
    """Yield the page of a bus, and a function that updates it like the server until a condition holds."""
    stop = threading.Event()
    with nedbus.connect(endpoint) as bus, ThreadPoolExecutor(1) as pool:
        live = LiveFleet(bus, Selection(), version="0")
        page = RenderedPage(live.fleet, live.timeline)

        def until(condition: Callable[[], object], what: str) -> None:
            def is_met() -> object:
                page.update()
                return condition()

            wait_for(is_met, what=what)

        reading = pool.submit(live.run, stop)
        try:
            yield page, until
        finally:
            stop.set()
        reading.result()


def test_past_loss_of_a_link_is_on_the_page_once(
    endpoint: str, bus: nedbus.Bus, zenoh_session: Session
) -> None:
    """A loss of the link that a service reports for each of its vehicles is one event of the page, not one of each."""
    now = time.time()
    with ExitStack() as answering:
        for vehicle in ("quad", "wing"):
            key = f"nedbus/@service/{vehicle}/x/status"
            event = Event(vehicle, "link_down", "begin", "bad", "no link", now - 60)
            own = Event(vehicle, "takeoff", "once", "info", f"takeoff of {vehicle}", now - 50)
            report = AccountReport(
                "x", "h", now, {vehicle: VehicleReport("info", "ok")}, (event, own)
            )
            [payload] = reply_parts(report)
            answering.enter_context(answer_queries(zenoh_session, key, reply_with({key: payload})))
        events = LiveFleet(bus, Selection(), version="0").timeline.events
        only = LiveFleet(bus, Selection(vehicle="wing"), version="0").timeline.events
    shown = sorted((event.vehicle, event.text) for event in events)
    assert shown == [("*", "no link"), ("quad", "takeoff of quad"), ("wing", "takeoff of wing")]
    assert sorted(event.text for event in only) == ["no link", "takeoff of wing"]


@pytest.mark.slow
def test_page_follows_published_vehicles(
    endpoint: str, bus: nedbus.Bus, zenoh_session: Session
) -> None:
    """Published vehicles are in the list and on the map, and stay there when invalid or gone."""
    fields = {**VALID, "x": 5.0}
    wing, quad = (bus.publisher(VLP, vehicle=name) for name in ("wing", "quad"))
    with open_page(endpoint) as (page, until):
        with flying(wing, fields):
            with flying(quad, VALID):
                until(lambda: page.grades == {"quad": "ok", "wing": "ok"}, "both vehicles")
                assert {mark["shape"] for mark in page.marks.values()} == {"circle"}
                fields |= {"x": 70.0, "xy_valid": False}
                until(lambda: page.states["wing"] == "xy not valid", "the flag")
                assert page.marks["wing"]["north"] == 5.0
            quad.close()
            until(
                lambda: page.states == {"quad": "gone", "wing": "xy not valid"},
                "the end of the other",
            )
        assert page.marks["quad"]["shape"] == "square"
        zenoh_session.put(Address("wing", VLP).rejected_key(), json.dumps({"reason": "a rule"}))
        page.send("streams")
        until(lambda: "<td>a rule</td>" in page.panel("more"), "the report")
        until(
            lambda: any("rejected: a rule" in event.text for event in page.viewer._timeline.events),
            "its event",
        )


@pytest.mark.slow
def test_page_survives_a_router_restart() -> None:
    """While the router is down, the header shows an alarm, markers are hollow, and states do not change."""
    where = free_endpoint()
    router = open_router(listen=(where,))
    with (
        open_page(where) as (page, until),
        nedbus.connect(where) as bus,
        bus.publisher(VLP, vehicle="wing") as wing,
        flying(wing, VALID),
    ):
        until(lambda: page.grades == {"wing": "ok"}, "the vehicle")
        router.close()
        until(lambda: f"no link to {where}" in page.panel("head"), "the alarm")
        assert page.grades == {"wing": "ok"}
        assert page.marks["wing"]["fill"] == DARK.colours["ground"]
        router = open_router(listen=(where,))
        until(lambda: page.marks["wing"]["fill"] != DARK.colours["ground"], "the vehicle again")
        until(lambda: "no link to" not in page.panel("head"), "the alarm to end")
        texts = [
            event.text.partition(" after")[0]
            for event in page.viewer._timeline.events
            if event.kind == "link_down"
        ]
        assert texts == [f"no link to {where}", "link restored"]
    router.close()
