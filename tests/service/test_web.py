"""What the page in the browser is made of, without a browser: states, tracks, tables, a recording's time."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bokeh.document import Document
from bokeh.models import ColumnDataSource, Model, Row
from bokeh.models.widgets import DataTable, Div, Select, Slider, Toggle
from bokeh.plotting import figure
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from nedbus.client import Monitor, RejectionReport, Sample
from nedbus.errors import ConfigError
from nedbus.recording import RecordingWriter
from nedbus.web.background import Background
from nedbus.web.fleet import MAX_STREAMS, Fleet, Line, Picture
from nedbus.web.playback import Player, Recording
from nedbus.web.stream import COLUMNS, POINTS, Origin, Stream
from nedbus.web.style import DARK, LIGHT, to_clock
from nedbus.web.tracks import Tracks
from nedbus.web.viewer import Viewer
from nedbus_msgs import Address, MapProjection, Provenance
from nedbus_msgs.arrays import to_array
from tests.conftest import message, wait_for

VLP, TRUTH = "vehicle_local_position", "vehicle_local_position_groundtruth"
WING, QUAD = Address("wing", VLP), Address("quad", VLP)
VALID = dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"), True) | dict.fromkeys(
    ("x", "y", "z", "vx", "vy", "vz", "heading"), 0.0
)
ZURICH: dict[str, Any] = {
    "xy_global": True,
    "z_global": True,
    "ref_lat": 47.397742,
    "ref_lon": 8.545594,
    "ref_alt": 488.0,
}
NOON = 1_700_000_000.0  # s since the epoch


class Sky:
    """A fleet and its health, at a time that the test sets."""

    def __init__(self) -> None:
        self.fleet = Fleet()
        self.monitor = Monitor()
        self.time = NOON

    def add(self, address: Address = WING, **fields: object) -> None:
        """Receive a message now."""
        stamp = round((self.time - NOON) * 1e6) + 1_000_000
        given = {**VALID, **fields}
        fields = {name: value for name, value in given.items() if value is not None}
        sample = Sample(message(stamp, **fields), address, round(self.time * 1e9))
        self.monitor.add(sample, received=sample.received)
        self.fleet.add(sample, self.time)

    def fly(self, seconds: float, *addresses: Address, rate: int = 10, **fields: object) -> None:
        """Receive messages for a while."""
        for _ in range(round(seconds * rate)):
            self.time += 1 / rate
            for address in addresses or (WING,):
                self.add(address, **fields)

    def look(self, **known: Any) -> Picture:
        return self.fleet.look(self.time, self.monitor.snapshot(round(self.time * 1e9)), **known)

    def line(self, address: Address = WING, **known: Any) -> Line:
        return next(line for line in self.look(**known).lines if line.address == address)

    def stream(self, address: Address = WING) -> Stream:
        return self.fleet.streams[address]


@pytest.fixture
def sky() -> Sky:
    return Sky()


def column(stream: Stream, name: str) -> list[float]:
    values: list[float] = stream.points(0, stream.written)[:, COLUMNS.index(name)].tolist()
    return values


# The states


@pytest.mark.parametrize(
    ("fields", "condition", "words"),
    [
        ({}, "ok", ""),
        ({"xy_valid": False}, "invalid", "xy invalid"),
        ({"z_valid": False, "v_z_valid": False}, "invalid", "z vz invalid"),
        ({"dead_reckoning": True}, "dead reckoning", "dead reckoning"),
        ({"dead_reckoning": True, "v_xy_valid": False}, "invalid", "vxy invalid, dead reckoning"),
        ({"heading_good_for_control": False}, "ok", ""),
    ],
)
def test_condition_is_what_the_flags_say(sky: Sky, fields: dict[str, Any], condition: str, words: str) -> None:
    """A stream that comes is in the condition that its flags of the last second say."""
    sky.fly(3, **fields)
    line = sky.line()
    assert (line.condition, line.words) == (condition, words)


def test_condition_holds_since_it_began(sky: Sky) -> None:
    """`since` is when a condition was seen first; of silence it is the last message, whatever the silence is called."""
    sky.fly(3)
    assert sky.line().condition == "ok"
    sky.fly(2.5, dead_reckoning=True)
    began = sky.time
    assert (sky.line().condition, sky.line().since) == ("dead reckoning", began)
    sky.fly(2, dead_reckoning=True)
    assert sky.line().since == began
    last = sky.time
    sky.time += 1.5
    assert sky.line().condition == "dead reckoning"
    assert sky.line(alive=[]).condition == "gone"
    assert sky.line(alive=[]).since == pytest.approx(last)
    sky.time += 3
    silent = sky.line(alive=[WING])
    assert (silent.condition, silent.words) == ("stale", "nothing for 4.5 s, dead reckoning")
    assert silent.since == pytest.approx(last)
    sky.time += 60
    cut = sky.line(link="no link")
    assert (cut.condition, cut.words.partition(",")[0]) == ("disconnected", "no link")
    assert cut.since == pytest.approx(last)
    sky.fly(3)
    assert (sky.line().condition, sky.line().since) == ("ok", sky.time)


def test_slow_stream_is_slow(sky: Sky) -> None:
    """A stream at less than half of its usual rate is slow, with both rates in words."""
    sky.fly(20, rate=20)
    sky.fly(3, rate=5)
    assert sky.line().condition == "slow"
    assert sky.line().words.startswith("5.0 Hz, usually ")


def test_worst_comes_first(sky: Sky) -> None:
    """Lines are ordered by condition, then by address; all that the page says is of one picture."""
    addresses = [Address(name, VLP) for name in ("a", "b", "c", "d")]
    for _ in range(30):
        sky.time += 0.1
        for address, fields in zip(addresses, ({}, {"xy_valid": False}, {"dead_reckoning": True}, {}), strict=True):
            sky.add(address, **fields)
    picture = sky.look(alive=addresses[:3])
    assert picture is sky.fleet.picture
    assert [line.address.vehicle for line in picture.worst_first()] == ["b", "c", "a", "d"]
    sky.time += 2
    assert [line.address.vehicle for line in sky.look(alive=addresses[:3]).worst_first()] == ["d", "b", "c", "a"]
    assert picture.rate == pytest.approx(40, rel=0.1)


def test_only_so_many_streams_are_shown(sky: Sky) -> None:
    """The 1,001st stream is counted and not shown, until one has been silent for a minute."""
    for number in range(MAX_STREAMS + 2):
        sky.add(Address(f"v{number}", VLP))
    picture = sky.look()
    assert (len(picture.lines), picture.left_out) == (MAX_STREAMS, 2)
    sky.time += 61
    sky.add(Address(f"v{MAX_STREAMS}", VLP))
    picture = sky.look()
    assert (len(picture.lines), picture.left_out) == (MAX_STREAMS, 1)
    assert f"v{MAX_STREAMS}" in {line.address.vehicle for line in picture.lines}
    assert len(sky.fleet._since) == MAX_STREAMS


def test_last_valid_place_is_told(sky: Sky) -> None:
    """Where a vehicle was last is where it was valid last; beside it its latitude and longitude, if it has them."""
    sky.fly(1, xy_valid=False, x=9.0)
    assert "never had a valid position" in sky.line().where
    sky.fly(1, x=3.0, y=-4.0, z=-5.0)
    sky.fly(1, xy_valid=False, x=77.0, y=77.0)
    assert sky.line().where == "3.0 m north, -4.0 m east, altitude 5.0 m"
    sky.fly(1, **ZURICH, x=10.0, z=-12.0)
    sky.fly(1, **ZURICH, xy_valid=False, x=77.0)
    assert sky.line().where == "10.0 m north, 0.0 m east, altitude 500.0 m (47.397832, 8.545594)"


# Places, lines and their breaks


def test_vehicles_with_origins_share_one(sky: Sky) -> None:
    """Two vehicles with different global origins are where they are; one without stays on its own."""
    north = MapProjection(ZURICH["ref_lat"], ZURICH["ref_lon"]).reproject(100.0, 50.0)
    lost = Address("lost", VLP)
    sky.fly(1, WING, **ZURICH, x=1.0, y=2.0)
    sky.fly(1, QUAD, **{**ZURICH, "ref_lat": north[0], "ref_lon": north[1]}, x=1.0, y=2.0)
    sky.fly(1, lost, x=1.0, y=2.0)
    places = {line.address.vehicle: line.stream.valid for line in sky.look().lines}
    assert all(places.values())
    assert places["wing"] == pytest.approx((2.0, 1.0, 488.0, True), abs=1e-3)
    assert places["quad"] == pytest.approx((52.0, 101.0, 488.0, True), abs=0.05)
    assert places["lost"] == (2.0, 1.0, 0.0, False)


def test_invalid_position_is_no_place(sky: Sky) -> None:
    """What is not valid is NaN in the history, each quantity by its own flag; the last valid place stays."""
    sky.fly(1, x=1.0, y=2.0, z=-3.0, vx=4.0, vz=-5.0)
    before = sky.stream().valid
    sky.fly(1, xy_valid=False, z_valid=False, v_xy_valid=False, v_z_valid=False, x=9.0, y=9.0, z=9.0, vx=9.0, vz=9.0)
    stream = sky.stream()
    for name, value in (("north", 1.0), ("east", 2.0), ("height", 3.0), ("vx", 4.0), ("climb", 5.0)):
        assert column(stream, name)[0] == value
        assert math.isnan(column(stream, name)[-1])
    assert stream.valid == before


def test_reset_breaks_the_line(sky: Sky) -> None:
    """A reset of xy or z, or a new origin, breaks the track just before it; one of xy is marked where it led."""
    sky.fly(1, x=1.0)
    sky.fly(1, x=5.0, y=1.0, xy_reset_counter=1, delta_xy=(4.0, 1.0))
    stream = sky.stream()
    norths = column(stream, "north")
    broken = norths.index(5.0) - 1
    assert math.isnan(norths[broken])
    assert norths[broken - 1] == 1.0
    assert [(east, north) for _, east, north in stream.resets] == [(1.0, 5.0)]
    written = stream.written
    sky.fly(0.1, x=5.0, z=-9.0, xy_reset_counter=1, z_reset_counter=1, delta_z=-9.0)
    sky.fly(0.1, x=5.0, z=-9.0, xy_reset_counter=1, z_reset_counter=1, **ZURICH)
    assert stream.written == written + 4
    assert len(stream.resets) == 1


def test_invalid_position_at_a_reset_is_not_marked(sky: Sky) -> None:
    """A reset to a position that is not valid breaks the line and has no mark."""
    sky.fly(1)
    sky.fly(1, xy_valid=False, xy_reset_counter=1)
    assert not sky.stream().resets


def test_history_is_of_ten_points_a_second(sky: Sky) -> None:
    """At 100 Hz the history has a minute, and a change of a flag at once, however short."""
    sky.fly(2, rate=100)
    assert 18 <= sky.stream().written <= 22
    before = sky.stream().written
    sky.fly(0.01, rate=100, xy_valid=False)
    sky.fly(0.01, rate=100)
    assert sky.stream().written == before + 2
    sky.fly(70, rate=20)
    points = sky.stream().points(0, sky.stream().written)
    assert len(points) == POINTS
    assert 58 <= (points[-1, 0] - points[0, 0]) / 1e3 <= 70


@pytest.mark.parametrize("late", [0.0, 0.2, -0.2])
def test_distance_to_the_truth_is_of_one_moment(sky: Sky, late: float) -> None:
    """The ground truth is moved with its velocity to the estimate's time; beside one that is too old there is none."""
    truth = Address("wing", TRUTH)
    sky.add(truth, x=100.0, vx=20.0, vy=-10.0, z=-50.0)
    sky.time += late
    sky.add(x=100.0 + 20.0 * late + 3.0, y=-10.0 * late, z=-54.0)
    assert sky.stream().error == pytest.approx(5.0, abs=1e-3)
    sky.time += 0.8
    sky.add(x=100.0)
    assert math.isnan(sky.stream().error)


def test_distance_needs_one_frame(sky: Sky) -> None:
    """An estimate with an origin is not compared with a truth without one, nor is one that is not valid."""
    sky.add(Address("wing", TRUTH))
    sky.add(**ZURICH)
    assert math.isnan(sky.stream().error)
    sky.add(QUAD)
    assert math.isnan(sky.stream(QUAD).error)
    sky.time += 0.1
    sky.add(xy_valid=False)
    assert math.isnan(sky.stream().error)


# The tracks of a viewer


def line_of(tracks: Tracks, index: int, kind: str) -> list[tuple[float, float]]:
    """Return the points of a line in the order in which a browser draws them, from the gap of the ring on."""
    ring = tracks._slots
    begin = index * (ring + 2)
    east, north = (
        np.asarray(tracks.source.data[name], float)[begin : begin + ring + 2].tolist() for name in ("east", kind)
    )
    assert math.isnan(east[-1]), "two tracks are joined"
    assert math.isnan(north[-1]), "two tracks are joined"
    assert repr((east[ring], north[ring])) == repr((east[0], north[0])) or math.isnan(north[ring])
    return list(zip(east[:ring], north[:ring], strict=True))


def follow(tracks: Tracks, streams: Mapping[Address, Stream], counts: Sequence[Sequence[int]], breaks: int) -> None:
    """Write points into streams, and update the tracks after each round."""
    for round_ in counts:
        for stream, count in zip(streams.values(), round_, strict=True):
            for _ in range(count):
                number = float(stream.written)
                is_broken = breaks and stream.written % breaks == breaks - 1
                row = [math.nan] * len(COLUMNS) if is_broken else [number] * len(COLUMNS)
                row[COLUMNS.index("doubtful")] = float(stream.written // 50 % 2)
                stream._write(row)
        tracks.update(streams)


@settings(max_examples=60)
@given(
    counts=st.lists(st.lists(st.integers(0, 90) | st.integers(0, 700), min_size=3, max_size=3), max_size=30),
    breaks=st.sampled_from([0, 7, 50]),
    budget=st.sampled_from([12_000, 600, 10]),
)
def test_tracks_are_what_a_new_viewer_gets(counts: list[list[int]], breaks: int, budget: int) -> None:
    """After any number of updates a viewer has the points that one who comes now would get, in the same slots.

    Only the oldest ones may be there for longer, which one who comes now does not get any more.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nedbus.web.tracks._BUDGET", budget)
        compare_tracks(counts, breaks)


def compare_tracks(counts: list[list[int]], breaks: int) -> None:
    streams = {Address(name, VLP): Stream(Origin()) for name in ("a", "b", "c")}
    tracks, fresh = Tracks(), Tracks()
    follow(tracks, streams, counts, breaks)
    tracks.update(streams)
    fresh.update(streams)
    for index, stream in enumerate(streams.values()):
        for kind in ("valid", "doubtful"):
            old, new = (line_of(each, index, kind) for each in (tracks, fresh))
            oldest = (max(0, stream.written - POINTS) - 1) // fresh._step % fresh._slots  # may be kept for longer
            del old[oldest], new[oldest]
            assert repr(old) == repr(new)


def test_tracks_send_only_what_is_new(sky: Sky) -> None:
    """An update patches the new points, the gap before them and nothing else; without a new point it sends nothing."""
    tracks, patches = Tracks(), Patches()
    document = Document()
    document.add_root(figure_with(tracks.source))
    sky.fly(30, WING, QUAD)
    tracks.update(sky.fleet.streams)
    document.on_change_dispatch_to(patches)
    tracks.update(sky.fleet.streams)
    assert patches.cells == 0
    sky.fly(0.1, WING)
    tracks.update(sky.fleet.streams)
    assert 0 < patches.cells <= 3 * 4
    assert not patches.whole


class Patches:
    """Counts what a document would send to its browser."""

    def __init__(self) -> None:
        self.cells = 0
        self.whole = 0

    def _column_data_changed(self, _: object) -> None:
        self.whole += 1

    def _columns_streamed(self, event: Any) -> None:
        self.cells += sum(len(values) for values in event.data.values())

    def _columns_patched(self, event: Any) -> None:
        self.cells += sum(len(patch) for patch in event.patches.values())

    def _document_model_changed(self, event: Any) -> None:
        self.whole += event.attr == "data"

    def _document_changed(self, event: Any) -> None:
        """Take all others."""


def figure_with(source: ColumnDataSource) -> figure:
    plot = figure()
    plot.line("east", "valid", source=source)
    return plot


def test_many_tracks_have_fewer_points_each(sky: Sky) -> None:
    """With 200 vehicles a track has a point a second, so that a browser draws as many points as with 20."""
    addresses = [Address(f"v{number}", VLP) for number in range(200)]
    sky.fly(3, *addresses)
    tracks = Tracks()
    tracks.update(sky.fleet.streams)
    assert len(tracks.source.data["east"]) <= 200 * 64


# A viewer


def models_of(document: Document, kind: type[Model]) -> list[Any]:
    return list(document.select({"type": kind}))


class Page:
    """A viewer's document, read as a person reads it."""

    def __init__(self, fleet: Fleet, **options: Any) -> None:
        self.document = Document()
        self.viewer = Viewer(self.document, fleet, **options)

    def update(self) -> None:
        for _ in range(10):
            self.viewer.update()

    @property
    def text(self) -> str:
        return "\n".join(str(div.text) for div in models_of(self.document, Div))

    @property
    def rows(self) -> list[dict[str, str]]:
        return rows_of(self.viewer._streams.source)

    @property
    def marks(self) -> dict[str, dict[str, Any]]:
        return {row["label"]: row for row in rows_of(self.viewer._map.marks)}


def rows_of(source: ColumnDataSource) -> list[dict[str, Any]]:
    data = source.data
    return [dict(zip(data, values, strict=True)) for values in zip(*data.values(), strict=True)]


def test_header_and_table_say_the_same(sky: Sky) -> None:
    """Counts, sentences, rows and markers are of the same picture."""
    sky.fly(3, WING, Address("wing", TRUTH), x=5.0)
    sky.fly(3, QUAD, xy_valid=False)
    sky.look()
    page = Page(sky.fleet)
    page.update()
    assert "1 invalid" in page.text
    assert "2 vehicles" in page.text
    assert "nowhere: it never had a valid position" in page.text
    assert [(row["vehicle"], row["state"]) for row in page.rows[:1]] == [("quad", "invalid")]
    assert {row["topic"] for row in page.rows} == {"local position", "ground truth"}
    sky.fly(3, WING, QUAD, x=5.0, z=-7.0)
    sky.look(alive=[WING, QUAD])
    page.update()
    assert "1 gone" in page.text
    assert "2 vehicles" in page.text
    assert page.marks["quad"]["north"] == 5.0


def test_marker_stays_where_the_vehicle_was(sky: Sky) -> None:
    """The marker of a vehicle that is silent or invalid is open, grey or red, and where it was valid last."""
    sky.fly(3, WING, QUAD, x=4.0, y=2.0)
    sky.look()
    page = Page(sky.fleet)
    page.update()
    assert page.marks["wing"]["shape"] == "circle"
    assert page.marks["wing"]["fill"] == page.marks["wing"]["colour"] != DARK.ground
    sky.fly(3, WING, x=99.0, xy_valid=False)
    sky.look(alive=[WING])
    page.update()
    assert set(page.marks) == {"wing invalid", "quad gone"}
    for mark in page.marks.values():
        assert (mark["shape"], mark["fill"], mark["north"], mark["east"]) == ("square", DARK.ground, 4.0, 2.0)


def test_position_that_just_became_invalid_is_open_at_once(sky: Sky) -> None:
    """The marker does not wait for the second after which a condition is known."""
    sky.fly(3, x=4.0)
    sky.add(xy_valid=False)
    sky.look()
    page = Page(sky.fleet)
    page.update()
    assert [mark["shape"] for mark in page.marks.values()] == ["square"]


def test_choice_stays_while_rows_move(sky: Sky) -> None:
    """Without a choice the worst vehicle is chosen; a choice stays when the order changes, and so does its row."""
    sky.fly(3, WING, QUAD)
    sky.look()
    page = Page(sky.fleet)
    page.update()
    assert page.viewer.chosen == QUAD
    table = page.viewer._streams
    table.source.selected.indices = [1]
    assert page.viewer.chosen == WING
    sky.fly(3, WING, xy_valid=False)
    sky.fly(0.1, QUAD)
    sky.look()
    page.update()
    assert [row["vehicle"] for row in page.rows] == ["wing", "quad"]
    assert table.source.selected.indices == [0]
    assert page.viewer.chosen == WING
    table.pointing = True
    sky.fly(3, WING, Address("new", VLP))
    sky.fly(3, QUAD, xy_valid=False)
    sky.look()
    page.update()
    assert [row["vehicle"] for row in page.rows] == ["wing", "quad", "new"]
    table.pointing = False
    page.update()
    assert [row["vehicle"] for row in page.rows] == ["quad", "new", "wing"]


@pytest.mark.parametrize("indices", [[99], [-99], []])
def test_choice_of_nothing_changes_nothing(sky: Sky, indices: list[int]) -> None:
    """A row that is not there is not chosen: the browser may send any."""
    sky.fly(3)
    sky.look()
    page = Page(sky.fleet)
    page.update()
    page.viewer._streams.source.selected.indices = indices
    page.update()
    assert page.viewer.chosen == WING


def test_words_of_peers_are_escaped(sky: Sky) -> None:
    """Reasons go into a table that escapes, and never into HTML of ours; a title and a link's words are escaped."""
    evil = "<img src=x onerror=alert(1)>"
    sky.fly(3)
    sky.fleet.reject([RejectionReport(WING, evil, round(sky.time * 1e9))])
    sky.look(link=evil)
    page = Page(sky.fleet, title=evil)
    page.update()
    assert "1 rejected" in page.text
    assert "<img" not in page.text
    assert page.text.count("&lt;img") == 2
    assert page.viewer._rejections.source.data["why"] == [evil]
    for table in models_of(page.document, DataTable):
        assert {type(column.formatter).__name__ for column in table.columns} == {"StringFormatter"}


def test_viewers_share_no_model(sky: Sky) -> None:
    """Each viewer has a document of its own, also in the other theme."""
    sky.fly(3)
    sky.look()
    pages = [Page(sky.fleet) for _ in range(3)]
    for page in pages:
        page.update()
    seen: set[int] = set()
    for page in pages:
        models = {id(model) for model in page.document.models}
        assert not models & seen
        seen |= models
    assert DARK.name != LIGHT.name


def test_quiet_page_sends_little(sky: Sky) -> None:
    """Without a new message, and with nothing that changes, an update sends nothing but the time axis."""
    sky.fly(3, WING, heading=None)
    sky.look()
    page = Page(sky.fleet)
    page.update()
    patches = Patches()
    page.document.on_change_dispatch_to(patches)
    page.update()
    assert (patches.cells, patches.whole) == (0, 0)


def test_page_without_vehicles_says_so() -> None:
    """Before the first message the page says that it waits."""
    page = Page(Fleet())
    page.update()
    assert "waiting for the first message" in page.text
    assert page.rows == []


# What lies under the tracks


def drawn(plot: figure) -> Any:
    """Return what was drawn first."""
    return plot.renderers[0]


def geojson(path: Path, shape: object) -> Path:
    file = path / "field.geojson"
    file.write_text(json.dumps(shape))
    return file


RING = [[8.545, 47.397], [8.546, 47.397], [8.546, 47.398], [8.545, 47.397]]


@pytest.mark.parametrize(
    ("shape", "lengths"),
    [
        ({"type": "Point", "coordinates": RING[0]}, [1]),
        ({"type": "Point", "coordinates": [*RING[0], 488.0]}, [1]),
        ({"type": "MultiPoint", "coordinates": RING}, [4]),
        ({"type": "LineString", "coordinates": RING}, [4]),
        ({"type": "MultiLineString", "coordinates": [RING, RING]}, [4, 4]),
        ({"type": "Polygon", "coordinates": [RING, RING]}, [4, 4]),
        ({"type": "MultiPolygon", "coordinates": [[RING], [RING, RING]]}, [4, 4, 4]),
        ({"type": "GeometryCollection", "geometries": [{"type": "Point", "coordinates": RING[0]}]}, [1]),
        (
            {
                "type": "FeatureCollection",
                "features": [
                    {"type": "Feature", "geometry": None},
                    {"type": "Feature", "geometry": {"type": "LineString", "coordinates": RING}},
                ],
            },
            [4],
        ),
    ],
    ids=lambda value: value.get("type") if isinstance(value, dict) else "",
)
def test_every_kind_of_geojson_is_drawn(tmp_path: Path, shape: object, lengths: list[int]) -> None:
    """Each geometry of GeoJSON becomes lines and points in metres from the common origin."""
    background = Background(geojson(tmp_path, shape))
    assert [len(ring) for ring in background.rings] == lengths
    plot = figure()
    background.draw(plot, DARK, MapProjection(47.397, 8.545))
    lines = drawn(plot).data_source.data
    assert [len(each) for each in lines["east"]] == lengths
    assert (lines["east"][0][0], lines["north"][0][0]) == pytest.approx((0.0, 0.0), abs=1e-6)


def picture(folder: Path, *, world: str | None, size: tuple[int, int] = (40, 20)) -> Path:
    """Write a picture whose first row is red, and its world file."""
    file = folder / "field.png"
    image = Image.new("RGB", size, (0, 0, 255))
    image.paste((255, 0, 0), (0, 0, size[0], 1))
    image.save(file)
    if world is not None:
        file.with_suffix(".pgw").write_text(world)
    return file


@pytest.mark.parametrize("suffix", [".pgw", ".wld"])
def test_picture_lies_where_its_world_file_says(tmp_path: Path, suffix: str) -> None:
    """The first pixel's centre is in the world file; the picture is north up, its first row in the north."""
    file = picture(tmp_path, world="0.0001\n0\n0\n-0.0001\n8.54505\n47.39895\n")
    file.with_suffix(".pgw").rename(file.with_suffix(suffix))
    background = Background(file)
    plot = figure()
    background.draw(plot, DARK, MapProjection(47.397, 8.545))
    glyph = drawn(plot).glyph
    corner = MapProjection(47.397, 8.545).project(47.399, 8.549)
    assert (glyph.x, glyph.y) == pytest.approx((0.0, 0.0), abs=0.01)
    assert (glyph.y + glyph.dh, glyph.x + glyph.dw) == pytest.approx(corner, abs=0.05)
    assert background.pixels.shape == (20, 40)
    red, blue = 0xFF0000FF, 0xFFFF0000  # little-endian RGBA
    assert (background.pixels[-1, 0], background.pixels[0, 0]) == (red, blue)


def test_large_picture_is_made_smaller(tmp_path: Path) -> None:
    """A browser gets at most 2,000 pixels a side, over the same ground."""
    file = picture(tmp_path, world="0.00001\n0\n0\n-0.00001\n8.545\n47.398\n", size=(5000, 40))
    assert max(Background(file).pixels.shape) == 2000


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "no such file"),
        ("no JSON", "GeoJSON, or a picture with a world file"),
        ("[]", "GeoJSON, or a picture with a world file"),
        ('{"type": "Nonsense"}', "'coordinates' is missing"),
        ('{"type": "Nonsense"}', "GeoJSON, or a picture with a world file"),
        ('{"type": "Topology", "objects": {}}', "GeoJSON, or a picture with a world file"),
        ('{"type": "LineString", "coordinates": []}', "GeoJSON, or a picture with a world file"),
        ('{"type": "LineString", "coordinates": [["a", "b"]]}', "GeoJSON, or a picture with a world file"),
        ('{"type": "Point", "coordinates": [2600000, 1200000]}', "is no longitude and latitude"),
        ('{"type": "Point", "coordinates": [NaN, 1]}', "is no longitude and latitude"),
        ('{"type": "FeatureCollection", "features": []}', "it has no lines, polygons or points"),
        ("[" * 100_000, "GeoJSON, or a picture with a world file"),
        ('{"type": "LineString", "coordinates": ' + "[" * 400 + "1" + "]" * 400 + "}", "GeoJSON, or a picture"),
    ],
)
def test_file_that_is_no_map_is_named(tmp_path: Path, content: str | None, said: str) -> None:
    """What cannot be drawn is an error of --map that names the file and says what would do."""
    file = tmp_path / "field.geojson"
    if content is not None:
        file.write_text(content)
    with pytest.raises(ConfigError) as error:
        Background(file)
    assert said in str(error.value)
    assert "--map" in str(error.value)
    assert str(file) in str(error.value)


@pytest.mark.parametrize(
    ("world", "said"),
    [
        (None, "no world file field.pgw beside it"),
        ("0.5\n0\n0\n-0.5\n2600000\n1200000\n", "not north up in degrees"),
        ("0.0001\n0.1\n0.1\n-0.0001\n8.5\n47.3\n", "not north up in degrees"),
        ("0.0001\n0\n0\n0.0001\n8.5\n47.3\n", "not north up in degrees"),
        ("nan\n0\n0\nnan\nnan\nnan\n", "not north up in degrees"),
        ("0.0001\n0\n", "GeoJSON, or a picture with a world file"),
        ("words", "GeoJSON, or a picture with a world file"),
    ],
)
def test_picture_without_its_place_is_named(tmp_path: Path, world: str | None, said: str) -> None:
    """A picture needs a world file in degrees, north up; the error says how to make one."""
    file = picture(tmp_path, world=world)
    with pytest.raises(ConfigError) as error:
        Background(file)
    assert said in str(error.value)


def test_file_that_is_no_picture_is_named(tmp_path: Path) -> None:
    """A file with a picture's name and other content is an error, not a crash."""
    file = picture(tmp_path, world="0.0001\n0\n0\n-0.0001\n8.5\n47.3\n")
    file.write_bytes(b"no picture")
    with pytest.raises(ConfigError, match="--map"):
        Background(file)


# A recording


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """Record a flight of three minutes with a reset and a minute without xy."""
    file = tmp_path / "flight.mcap"
    messages, streams, times = [], [], []
    for number in range(1800):
        seconds = number / 10
        fields = {"x": seconds, "y": math.sin(seconds), "xy_valid": not 90 <= seconds < 120}
        resets = {"xy_reset_counter": int(seconds >= 150)}
        for address in (WING, Address("wing", TRUTH)):
            messages.append(message(1_000_000 + number * 100_000, **{**VALID, **ZURICH, **fields, **resets}))
            streams.append((address, Provenance("sim")))
            times.append(round((NOON + seconds) * 1e9))
    with RecordingWriter(file) as writer:
        writer.write(to_array(messages), streams, logged=times, published=times)
    return file


class Clock:
    """The time that a player sees."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


def opened(path: Path) -> Recording:
    recording = Recording(path)
    wait_for(lambda: recording.length > 179.8, what="the recording")
    return recording


@pytest.fixture
def played(flight: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], tuple[Player, Clock]]:
    """Return what makes a player of the flight with a clock of its own."""
    recording = opened(flight)
    clock = Clock()
    monkeypatch.setattr("nedbus.web.playback.time", clock)
    return lambda: (Player(recording), clock)


def pick(player: Player) -> tuple[Slider, Toggle, Select]:
    controls: Row = player.controls
    play, speed, slider = controls.children[:3]
    assert isinstance(slider, Slider)
    assert isinstance(play, Toggle)
    assert isinstance(speed, Select)
    return slider, play, speed


def run(player: Player, clock: Clock, seconds: float, step: float = 0.1) -> None:
    for _ in range(round(seconds / step)):
        clock.now += step
        player.tick()


def shown(player: Player) -> object:
    """Return what a page shows of each stream: its condition, where it is, and its last minute."""
    picture = player.fleet.picture
    end = picture.time * 1e3
    found = []
    for line in picture.lines:
        points = line.stream.points(0, line.stream.written)
        recent = points[points[:, 0] > end - 50_000]
        found.append((line.address, line.condition, line.words, line.where, len(line.stream.resets), recent.tolist()))
    return repr(found)


def test_recording_plays_at_its_speed(played: Callable[[], tuple[Player, Clock]]) -> None:
    """The time runs as the clock does, times the speed, not while it is paused, and ends with the recording."""
    player, clock = played()
    slider, play, speed = pick(player)
    run(player, clock, 10)
    assert slider.value == pytest.approx(10, abs=0.2)
    assert slider.end == pytest.approx(179.9)
    speed.value = "5"
    run(player, clock, 10)
    assert slider.value == pytest.approx(60, abs=0.6)
    play.active = False
    assert play.label == "play"
    run(player, clock, 10)
    assert slider.value == pytest.approx(60, abs=0.6)
    play.active = True
    speed.value = "50"
    run(player, clock, 10)
    assert slider.value == pytest.approx(179.9)
    assert {line.condition for line in player.fleet.picture.lines} == {"ok"}


@pytest.mark.parametrize("target", [5.0, 61.0, 100.0, 155.0, 179.9])
def test_jump_shows_what_playing_there_shows(played: Callable[[], tuple[Player, Clock]], target: float) -> None:
    """Wherever somebody jumps, back or forth, the page is the same as if the recording had been played until there."""
    player, clock = played()
    run(player, clock, target)
    expected = shown(player)
    jumped, clock = played()
    run(jumped, clock, 30)
    slider, play, _ = pick(jumped)
    play.active = False
    jumps: list[float] = []
    jumped.on_jump = lambda: jumps.append(1.0)
    for place in (179.0, 0.0, player.fleet.picture.time):
        slider.trigger("value_throttled", None, place)
        jumped.tick()
    assert len(jumps) == 3
    assert shown(jumped) == expected
    for old, new in zip(player.fleet.picture.lines, jumped.fleet.picture.lines, strict=True):
        assert new.since == pytest.approx(max(old.since, target - 60), abs=1.0)


@pytest.mark.parametrize("value", ["inf", "nan", "-5", "1e300", "fast"])
def test_any_speed_of_a_browser_is_survived(played: Callable[[], tuple[Player, Clock]], value: str) -> None:
    """A browser may send any speed and any time: its page stays within the recording."""
    player, clock = played()
    slider, _, speed = pick(player)
    run(player, clock, 1)
    speed.options = [*speed.options, value]
    speed.value = value
    run(player, clock, 1)
    assert 0 <= float(slider.value) <= 180
    slider.trigger("value_throttled", None, -1e9)
    run(player, clock, 1)
    assert 0 <= float(slider.value) <= 180


def test_damaged_recording_is_an_error(tmp_path: Path) -> None:
    """A file that is no recording is said to be none before a page is served."""
    file = tmp_path / "flight.ulg"
    file.write_bytes(b"nothing")
    with pytest.raises(Exception, match=r"flight\.ulg") as error:
        Recording(file)
    assert error.type.__module__ == "nedbus.errors"


def test_clock_is_of_the_recording_or_of_the_host() -> None:
    """Times since the start of a recording are minutes and seconds; others are of this host's clock."""
    assert to_clock(75.25) == "1:15.2"
    assert to_clock(119.99) == "2:00.0"
    assert to_clock(NOON).count(":") == 2
