"""What a browser is sent, without a browser: the tracks of the map, the tables, what the page says, live vehicles."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from bokeh.document import Document
from bokeh.document.events import ColumnsPatchedEvent
from bokeh.models import ColumnDataSource
from bokeh.models.widgets import DataTable, Toggle
from bokeh.plotting import figure
from hypothesis import given
from hypothesis import strategies as st

import nedbus
from nedbus.client import RejectionReport
from nedbus.transport import Session, open_router
from nedbus.web.fleet import TRUTH
from nedbus.web.live import LiveFleet
from nedbus.web.stream import COLUMNS, Origin, Stream
from nedbus.web.style import DARK
from nedbus.web.tracks import Tracks
from nedbus_msgs import Address, Selection
from tests.messages import VALID, VLP
from tests.ports import free_endpoint
from tests.waits import wait_for
from tests.web import QUAD, WING, Shown, Sky, flying, models_of, sky

__all__ = ["sky"]  # a fixture

# The tracks of a viewer


def line_of(tracks: Tracks, index: int, kind: str, ring: int) -> list[tuple[float, float]]:
    """Return the points of a line in the order in which a browser draws them, from the gap of the ring on."""
    begin = index * (ring + 2)
    east, north = (
        np.asarray(tracks.source.data[name], float)[begin : begin + ring + 2].tolist() for name in ("east", kind)
    )
    assert math.isnan(east[-1]), "two tracks are joined"
    assert math.isnan(north[-1]), "two tracks are joined"
    assert repr((east[ring], north[ring])) == repr((east[0], north[0])) or math.isnan(north[ring])
    return list(zip(east[:ring], north[:ring], strict=True))


def write_points(stream: Stream, count: int, *, breaks: bool) -> None:
    """Write points into a stream: a break after each six, and five of ten by dead reckoning."""
    for _ in range(count):
        number = stream.written
        row = np.full(len(COLUMNS), math.nan if breaks and number % 7 == 6 else float(number))
        row[COLUMNS.index("doubtful")] = number // 5 % 2
        stream.history[number % len(stream.history)] = row
        stream.written += 1


@given(
    rounds=st.lists(st.tuples(*[st.integers(0, 9) | st.integers(0, 70)] * 3), max_size=30),
    breaks=st.booleans(),
    budget=st.sampled_from([(180, 1), (60, 3), (1, 10)]),
)
def test_tracks_are_what_a_new_viewer_gets(
    rounds: list[tuple[int, int, int]], breaks: bool, budget: tuple[int, int]
) -> None:
    """After any number of updates a viewer has the points that one who comes now would get, in the same slots.

    Only the oldest ones may be there for longer, which one who comes now does not get any more. With a smaller budget
    of points a slot has more of them.
    """
    (limit, step), points = budget, 60
    with pytest.MonkeyPatch.context() as patch:
        numbers = {"stream.POINTS": points, "tracks.POINTS": points, "tracks._BUDGET": limit, "tracks._FEWEST": 6}
        for name, value in numbers.items():
            patch.setattr(f"nedbus.web.{name}", value)
        streams = {Address(*name): Stream(Origin()) for name in (("a", VLP), ("b", VLP), ("c", TRUTH))}
        tracks, fresh = Tracks(), Tracks()
        for counts in rounds:
            for stream, count in zip(streams.values(), counts, strict=True):
                write_points(stream, count, breaks=breaks)
            tracks.update(streams)
        tracks.update(streams)
        fresh.update(streams)
    ring = points // step + 2
    assert len(fresh.source.data["east"]) == 3 * (ring + 2)
    for index, stream in enumerate(streams.values()):
        for kind in ("valid", "doubtful", "truth"):
            old, new = (line_of(each, index, kind, ring) for each in (tracks, fresh))
            oldest = (max(0, stream.written - points) - 1) // step % ring  # may be kept for longer
            del old[oldest], new[oldest]
            assert repr(old) == repr(new)


def data_sent(document: Document) -> list[Any]:
    """Return a list that gets what a document sends its browser of tables from now on."""
    sent: list[Any] = []
    document.on_change(
        lambda event: sent.append(event) if isinstance(getattr(event, "model", None), ColumnDataSource) else None
    )
    return sent


def test_tracks_send_only_what_is_new(sky: Sky) -> None:
    """An update patches the new points, the gap before them and nothing else; without a new point it sends nothing."""
    tracks, document, plot = Tracks(), Document(), figure()
    plot.line("east", "valid", source=tracks.source)
    document.add_root(plot)
    sky.fly(30, WING, QUAD)
    tracks.update(sky.fleet.streams)
    sent = data_sent(document)
    tracks.update(sky.fleet.streams)
    assert not sent
    sky.fly(0.1, WING)
    tracks.update(sky.fleet.streams)
    (event,) = sent
    assert isinstance(event, ColumnsPatchedEvent)
    assert 0 < sum(len(patch) for patch in event.patches.values()) <= 3 * 4


def test_many_tracks_have_fewer_points_each(sky: Sky) -> None:
    """With 200 vehicles a track has a point a second, so that a browser draws as many points as with 20."""
    sky.fly(0.1, *[Address(f"v{number}", VLP) for number in range(200)])
    tracks = Tracks()
    tracks.update(sky.fleet.streams)
    assert len(tracks.source.data["east"]) <= 200 * 64


# A viewer


class Page(Shown):
    """What a viewer of a sky sees."""

    def __init__(self, sky: Sky, **options: Any) -> None:
        super().__init__(sky.fleet, **options)
        self._sky = sky
        self.look()

    def look(self, **known: Any) -> None:
        """Make a picture of now, and show it."""
        self._sky.look(**known)
        self.update()


def test_header_and_table_say_the_same(sky: Sky) -> None:
    """Counts, sentences, rows and markers are of the same picture; before the first message the page waits for it."""
    page = Page(sky)
    assert "waiting for the first message" in page.text
    assert page.vehicles == []
    sky.fly(3, WING, Address("wing", TRUTH), x=5.0)
    sky.fly(3, QUAD, xy_valid=False)
    page.look()
    assert "1 invalid" in page.text
    assert "2 vehicles" in page.text
    assert "nowhere: it never had a valid position" in page.text
    rows = page.rows("what is wrong")
    assert (rows[0]["vehicle"], rows[0]["state"]) == ("quad", "invalid")
    assert {row["topic"] for row in rows} == {"local position", "ground truth"}
    sky.fly(3, WING, QUAD, x=5.0, z=-7.0)
    page.look(alive=[WING, QUAD])
    assert "1 gone" in page.text
    assert "2 vehicles" in page.text
    assert page.marks["quad"]["north"] == 5.0


def test_other_messages_have_a_row_and_no_place(sky: Sky) -> None:
    """They are rows with their rate and age, without flags; who chooses one sees the plots of that vehicle's position.

    A vehicle of which nothing else comes is on no map.
    """
    attitude, battery = Address("wing", "vehicle_attitude"), Address("far", "battery_status", 0)
    sky.fly(3, WING, attitude, battery, x=4.0)
    page = Page(sky)
    rows = {row["topic"]: row for row in page.rows("what is wrong")}
    assert set(rows) == {"local position", "vehicle attitude", "battery status 0"}
    assert [rows["vehicle attitude"][name] for name in ("Hz", "age", "lost", "xy", "DR", "off truth")] == [
        "10", "<1 s", "0", "", "", ""
    ]  # fmt: skip
    assert rows["local position"]["xy"] == "●"
    assert set(page.marks) == {"wing"}
    page.source("what is wrong").selected.indices = [list(rows).index("vehicle attitude")]
    page.update()
    assert page.chosen == attitude
    assert f"<b>{WING}</b>" in page.text
    assert len(page.source("climb").data["climb"]) > 20
    sky.time += 5
    page.look(alive=[battery])
    assert page.states["far"] == "stale"


def test_marker_stays_where_the_vehicle_was(sky: Sky) -> None:
    """The marker of a vehicle that is silent or invalid is open, grey or red, and where it was valid last."""
    sky.fly(3, WING, QUAD, x=4.0, y=2.0)
    page = Page(sky)
    assert page.marks["wing"]["shape"] == "circle"
    assert page.marks["wing"]["fill"] == page.marks["wing"]["colour"] != DARK.ground
    sky.add(xy_valid=False)
    page.look()
    assert page.marks["wing"]["shape"] == "square", "at once, though its condition takes a second"
    sky.fly(3, WING, x=99.0, xy_valid=False)
    page.look(alive=[WING])
    assert set(page.marks) == {"wing invalid", "quad gone"}
    for mark in page.marks.values():
        assert (mark["shape"], mark["fill"], mark["north"], mark["east"]) == ("square", DARK.ground, 4.0, 2.0)


def test_choice_stays_while_rows_move(sky: Sky) -> None:
    """Without a choice the worst vehicle is chosen; a choice stays when the order changes, and so does its row.

    A browser may choose any row: one that is not there changes nothing. Under a pointer no row moves.
    """
    sky.fly(3, WING, QUAD)
    page = Page(sky)
    selected = page.source("what is wrong").selected
    for indices in ([99], [-99], []):
        selected.indices = indices
        assert page.chosen == QUAD
    selected.indices = [1]
    assert page.chosen == WING
    sky.fly(3, WING, xy_valid=False)
    sky.fly(0.1, QUAD)
    page.look()
    assert page.vehicles == ["wing", "quad"]
    assert selected.indices == [0]
    assert page.chosen == WING
    pointing = models_of(page.document, Toggle)[0]
    pointing.active = True
    sky.fly(3, WING, Address("new", VLP))
    sky.fly(3, QUAD, xy_valid=False)
    page.look()
    assert page.vehicles == ["wing", "quad", "new"]
    pointing.active = False
    page.update()
    assert page.vehicles == ["quad", "new", "wing"]


def test_words_of_peers_are_escaped(sky: Sky) -> None:
    """Reasons go into a table that escapes, the newest first; a title and a link's words are escaped as HTML."""
    evil = "<img src=x onerror=alert(1)>"
    sky.fly(3)
    for reason in ("the first", evil):
        sky.fleet.reject([RejectionReport(WING, reason, round(sky.time * 1e9))])
    page = Page(sky, title=evil)
    page.look(link=evil)
    assert "2 rejected" in page.text
    assert "<img" not in page.text
    assert page.text.count("&lt;img") == 2
    assert [row["why"] for row in page.rows("why")] == [evil, "the first"]
    for table in models_of(page.document, DataTable):
        assert {type(column.formatter).__name__ for column in table.columns} == {"StringFormatter"}


def test_viewers_share_no_model(sky: Sky) -> None:
    """Each viewer has a document of its own."""
    sky.fly(3)
    first, second = ([*page.document.models] for page in [Page(sky), Page(sky)])
    assert not set(map(id, first)) & set(map(id, second))


def test_quiet_page_sends_little(sky: Sky) -> None:
    """Without a new message, and with nothing that changes, an update sends nothing but the time axis."""
    sky.fly(3, WING, heading=None)
    page = Page(sky)
    sent = data_sent(page.document)
    page.update()
    assert not sent


# Live vehicles, of a real bus


@contextmanager
def open_page(endpoint: str) -> Iterator[tuple[Shown, Callable[[Callable[[], object], str], None]]]:
    """Give the page of a bus with one viewer, and what goes on as the server does until a condition holds."""
    stop = threading.Event()
    with nedbus.connect(endpoint) as bus, ThreadPoolExecutor(1) as pool:
        live = LiveFleet(bus, Selection(), version="0")
        page = Shown(live.fleet)

        def until(condition: Callable[[], object], what: str) -> None:
            def is_so() -> object:
                live.look()
                page.update()
                return condition()

            wait_for(is_so, what=what)

        reading = pool.submit(live.run, stop)
        try:
            yield page, until
        finally:
            stop.set()
        reading.result()


def test_page_follows_its_vehicles(endpoint: str, bus: nedbus.Bus, raw: Session) -> None:
    """What is published is in the table and on the map; what is not valid any more, or switched off, stays there."""
    fields = {**VALID, "x": 5.0}
    wing, quad = (bus.publisher(VLP, vehicle=name) for name in ("wing", "quad"))
    with open_page(endpoint) as (page, until):
        with flying(wing, fields):
            with flying(quad, VALID):
                until(lambda: page.states == {"quad": "ok", "wing": "ok"}, "both vehicles")
                assert {mark["shape"] for mark in page.marks.values()} == {"circle"}
                fields |= {"x": 70.0, "xy_valid": False}
                until(lambda: page.states["wing"] == "invalid", "the flag")
                assert page.marks["wing invalid"]["north"] == 5.0
            quad.close()
            until(lambda: page.states == {"quad": "gone", "wing": "invalid"}, "the end of the other")
        assert page.marks["quad gone"]["shape"] == "square"
        raw.put(Address("wing", VLP).rejected_key(), json.dumps({"reason": "a rule"}))
        until(lambda: [row["why"] for row in page.rows("why")] == ["a rule"], "the report")


def test_page_outlives_the_router() -> None:
    """While the router is away every vehicle is disconnected and the header says why; when it is back all goes on."""
    where = free_endpoint()
    router = open_router(listen=(where,))
    with (
        open_page(where) as (page, until),
        nedbus.connect(where) as bus,
        bus.publisher(VLP, vehicle="wing") as wing,
        flying(wing, VALID),
    ):
        until(lambda: page.states == {"wing": "ok"}, "the vehicle")
        router.close()
        until(lambda: page.states == {"wing": "disconnected"}, "its state")
        assert f"no link to {where} since" in page.text
        assert page.marks["wing disconnected"]["shape"] == "square"
        router = open_router(listen=(where,))
        until(lambda: page.states == {"wing": "ok"}, "the vehicle again")
        assert "no link to" not in page.text
    router.close()
