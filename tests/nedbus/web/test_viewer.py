"""The documents sent to a browser, without one: tracks, the list, texts, moments, live vehicles of a bus."""

from __future__ import annotations

import json
import math
import re
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any, cast

import numpy as np
import pytest
from bokeh.document import Document
from bokeh.document.events import ColumnsPatchedEvent
from bokeh.models import ColumnDataSource
from bokeh.plotting import figure
from hypothesis import given
from hypothesis import strategies as st

import nedbus
from nedbus.client import LogStreamStatus, RejectionReport
from nedbus.transport import Session, open_router
from nedbus.web.column_data import NAMES, Track, Tracks
from nedbus.web.fleet import TRUTH
from nedbus.web.map import MIN_SIDE
from nedbus.web.server import LiveFleet
from nedbus.web.stream import COLUMNS, History
from nedbus.web.style import DARK, LIGHT, Style
from nedbus_msgs import Address, Selection
from tests.flights.messages import VALID, VLP
from tests.nedbus.web.page import QUAD, WING, Shown, Sky, flying, models_of, sky
from tests.peers.ports import free_endpoint
from tests.waits import wait_for

__all__ = ["sky"]  # a fixture

HOSTILE = "<img src=x onerror=alert(1)>"
GROUND_TRUTH = Address("wing", TRUTH)
SECOND_EKF = Address("wing", "estimator_local_position", 1)


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


def write_points(history: History, count: int, *, breaks: bool) -> None:
    """Write points into a history: a break after each six, and five of ten by dead reckoning."""
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
def test_tracks_are_what_a_new_viewer_gets(
    rounds: list[tuple[int, int, int]], breaks: bool, budget: tuple[int, int]
) -> None:
    """After any number of updates a viewer has the points that one who comes now would get, in the same slots.

    Only the oldest ones may be there for longer, which one who comes now does not get any more. With a smaller budget
    of points a slot has more of them.
    """
    (limit, step), points = budget, 60
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"_MAX_POINTS": limit, "_MIN_TRACK_POINTS": 6}.items():
            patch.setattr(f"nedbus.web.column_data.{name}", value)
        kept: dict[Address, Track] = {
            Address(*name): (History(points, 0.1), number)
            for number, name in enumerate((("a", VLP), ("b", VLP), ("c", TRUTH)))
        }
        tracks, fresh = Tracks(), Tracks()
        for counts in rounds:
            for (history, _), count in zip(kept.values(), counts, strict=True):
                write_points(history, count, breaks=breaks)
            tracks.update(kept)
        tracks.update(kept)
        fresh.update(kept)
    ring = points // step + 2
    assert len(fresh.source.data["east"]) == 3 * (ring + 2)
    for index, (history, _) in enumerate(kept.values()):
        for kind in NAMES:
            old, new = (line_of(each, index, kind, ring) for each in (tracks, fresh))
            oldest = (max(0, history.written - points) - 1) // step % ring  # may be kept for longer
            del old[oldest], new[oldest]
            assert repr(old) == repr(new)


def data_sent(document: Document) -> list[Any]:
    """Return a list that gets what a document sends its browser of tables from now on."""
    sent: list[Any] = []
    document.on_change(
        lambda event: sent.append(event) if isinstance(getattr(event, "model", None), ColumnDataSource) else None
    )
    return sent


def tracks_of(sky: Sky) -> dict[Address, Track]:
    """Return the last minute of all streams, each in a colour of its own."""
    return {address: (stream.minute, number) for number, (address, stream) in enumerate(sky.fleet.streams.items())}


def test_tracks_send_only_what_is_new(sky: Sky) -> None:
    """An update patches the new points, the gap before them and nothing else; without a new point it sends nothing."""
    tracks, document, plot = Tracks(), Document(), figure()
    plot.line("east", NAMES[0], source=tracks.source)
    document.add_root(plot)
    sky.fly(30, WING, QUAD)
    tracks.update(tracks_of(sky))
    sent = data_sent(document)
    tracks.update(tracks_of(sky))
    assert not sent
    sky.fly(0.1, WING)
    tracks.update(tracks_of(sky))
    (event,) = sent
    assert isinstance(event, ColumnsPatchedEvent)
    assert 0 < sum(len(patch) for patch in event.patches.values()) <= 3 * 4


def test_many_tracks_have_fewer_points_each(sky: Sky) -> None:
    """With 200 vehicles a track has a point a second, so a browser draws no more points than with 20."""
    sky.fly(0.1, *[Address(f"v{number}", VLP) for number in range(200)])
    tracks = Tracks()
    tracks.update(tracks_of(sky))
    assert len(tracks.source.data["east"]) <= 200 * 64


# A viewer


class Page(Shown):
    """The document of a viewer of a sky."""

    def __init__(self, sky: Sky, **options: Any) -> None:
        super().__init__(sky.fleet, sky.chronicle, **options)
        self._sky = sky
        self.look()

    def look(self, **known: Any) -> None:
        """Make a picture of now, and show it."""
        self._sky.look(**known)
        self.update()

    @property
    def pinned(self) -> float | None:
        return self.viewer.pinned

    def tap(self, column: str, text: str) -> None:
        """Tap the mark with these words, of what has a column of this name, as a browser says it."""
        source = next(each for each in sources(self) if column in each.data and "words" in each.data)
        source.selected.indices = [list(source.data["words"]).index(text)]
        assert source.selected.indices == [], "the same mark cannot be tapped again"
        self.update()


def sources(page: Shown) -> list[ColumnDataSource]:
    return models_of(page.document, ColumnDataSource)


def test_log_stream_is_shown_with_its_vehicle(sky: Sky) -> None:
    """The chosen vehicle has a line about its ULog stream, whose text is from a peer."""
    page = Page(sky)
    sky.fly(3)
    page.look()
    assert "ULog stream" not in page.text
    page.look(logs={"wing": LogStreamStatus(vehicle="wing", state="refused", reason="<b>another client has it")})
    assert "ULog stream" in page.text
    assert "refused, &lt;b&gt;another client has it" in page.text


def test_every_part_says_the_same(sky: Sky) -> None:
    """Counts, title, rows, badges and markers are of the same picture; before the first message the page waits."""
    page = Page(sky)
    assert "waiting for the first message" in page.part("head")
    assert page.vehicles == []
    sky.fly(3, WING, GROUND_TRUTH, x=5.0, z=-7.0)
    sky.fly(3, QUAD, x=5.0, z=-7.0, xy_valid=False)
    page.look()
    assert "■ 1 bad" in page.part("head")
    assert "● 1 ok" in page.part("head")
    assert page.document.title == "(1 bad) nedbus"
    assert page.listed["quad"]["title"] == page.states["quad"] == "xy not valid"
    assert page.grades == {"quad": "bad", "wing": "ok"}
    assert page.chosen == "quad"
    assert "■ xy not valid" in page.part("why")
    assert "last valid position: none yet" in page.part("why")
    assert "no valid position yet: quad" in page.part("tool")
    assert set(page.marks) == {"wing"}
    sky.fly(3, WING, QUAD, x=5.0, z=-7.0)
    page.look(alive=[WING, QUAD])
    assert page.grades == {"quad": "ok", "wing": "ok"}
    assert "● 2 ok" in page.part("head")
    assert page.document.title == "nedbus"
    assert page.marks["quad"]["north"] == 5.0
    assert "<span>height</span><b>7.0 m</b>" in page.part("nums")
    sky.time += 5
    page.look(alive=[])
    assert "■ 2 bad" in page.part("head")
    assert page.states == {"quad": "gone", "wing": "gone"}
    assert {mark["shape"] for mark in page.marks.values()} == {"square"}


def test_bad_estimates_beside_the_main_one_make_nothing_red(sky: Sky) -> None:
    """A vehicle whose second EKF or ground truth is invalid is ok in list, header, title and map, and says so below."""
    sky.fly(1, WING, SECOND_EKF, GROUND_TRUTH)
    for _ in range(50):
        sky.fly(0.1)
        for other in (SECOND_EKF, GROUND_TRUTH):
            sky.add(other, xy_valid=False, dead_reckoning=True)
    page = Page(sky)
    assert (page.grades, page.document.title) == ({"wing": "ok"}, "nedbus")
    assert "nothing was wrong" in page.part("why")
    assert page.marks["wing"]["shape"] == "circle"
    assert "1 bad" not in page.part("head")
    page.say("streams")
    assert page.part("more").count("xy invalid, dead reckoning") == 2


def test_page_that_is_behind_says_so(sky: Sky) -> None:
    """Messages that this reader did not read in time are the page's own fault, in the header; no vehicle changes."""
    sky.fly(3, WING, QUAD)
    page = Page(sky)
    assert "page up to date" in page.part("head")
    sky.time += 20
    own = "this page falls behind: 7000 messages queued, 12 dropped"
    page.look(alive=[WING, QUAD], is_behind=True, own=own)
    assert f'<span class="alarm">{own}</span>' in page.part("head")
    assert "page up to date" not in page.part("head")
    assert page.grades == {"quad": "ok", "wing": "ok"}
    assert page.document.title == "nedbus"


def test_other_messages_are_streams_without_a_place(sky: Sky) -> None:
    """They are listed below with rate and state, if asked for; a vehicle of which nothing else comes is on no map."""
    attitude, battery = Address("wing", "vehicle_attitude"), Address("far", "battery_status", 0)
    sky.fly(3, WING, attitude, battery, x=4.0)
    page = Page(sky)
    assert page.vehicles == ["far", "wing"]
    assert set(page.marks) == {"wing"}
    page.say("vehicle", "far")
    assert page.chosen == "far"
    assert page.part("nums").count("<b>-</b>") == 9
    assert len(page.plotted["speed"]) == 0
    page.say("vehicle", "wing")
    assert "▸ 2 streams of wing" in page.part("more")
    assert "vehicle_attitude" not in page.part("more")
    page.say("streams")
    rows = re.findall("<tr>(.*?)</tr>", page.part("more"))
    cells = {row[0]: row[1:] for each in rows[1:] if (row := re.findall("<td>(.*?)</td>", each))}
    row = ["10", "0", "0", "-", "ok"]
    assert cells == {"vehicle_attitude": row, VLP: row}
    assert len(page.plotted["speed"]) > 20


def test_facts_of_a_vehicle_are_in_its_row_and_tiles(sky: Sky) -> None:
    """Mode, battery and GPS stand in the row; beside them in the tiles whether it is armed."""
    sky.fly(2, x=-0.01, heading=-0.001)
    sky.add(Address("wing", "vehicle_status"), nav_state=4, arming_state=2)
    sky.add(Address("wing", "battery_status", 0), remaining=0.5)
    sky.add(Address("wing", "sensor_gps", 0), fix_type=3, satellites_used=14)
    page = Page(sky)
    row = page.listed["wing"]
    assert (row["mode"], row["battery"], row["gps"]) == ("Hold", "50 %", "3D · 14")
    for name, text in (("armed", "armed"), ("mode", "Hold"), ("north", "0.0 m"), ("heading", "0°")):
        assert f"<span>{name}</span><b>{text}</b>" in page.part("nums")


def test_values_of_a_silent_stream_are_the_last_known(sky: Sky) -> None:
    """A vehicle that is gone, or one stream that is silent, has no current value: the tiles say how old theirs are."""
    status, battery = Address("wing", "vehicle_status"), Address("wing", "battery_status", 0)
    for _ in range(50):
        sky.fly(0.2, z=-7.0)
        sky.add(status, nav_state=4, arming_state=2)
        sky.add(battery, remaining=0.5)
    page = Page(sky)
    assert "ago" not in page.part("nums")
    for _ in range(50):
        sky.fly(0.2, z=-7.0)
        sky.add(status, nav_state=4, arming_state=2)
    page.look()
    assert (page.listed["wing"]["mode"], page.listed["wing"]["battery"]) == ("Hold", "-")
    assert '<b class="quiet">50 %</b> <small>10.0 s ago</small>' in page.part("nums")
    assert "<span>armed</span><b>armed</b>" in page.part("nums")
    sky.time += 2100
    page.look(alive=[])
    row = page.listed["wing"]
    assert (row["text"], row["mode"], row["battery"], row["gps"]) == ("gone", "-", "-", "-")
    for name, text in (("armed", "armed"), ("battery", "50 %"), ("height", "7.0 m"), ("heading", "0°")):
        assert f'<span>{name}</span><b class="quiet">{text}</b> <small>35 min ago</small>' in page.part("nums")


def test_slow_stream_is_told_with_its_numbers(sky: Sky) -> None:
    """The numbers of a vehicle whose position arrives at less than half of its usual rate name both rates."""
    sky.fly(20, rate=20)
    sky.fly(3, rate=5)
    page = Page(sky)
    assert re.search(r'<div class="watch">slow: 5.0 Hz, usually \d+</div>', page.part("nums"))
    assert page.grades == {"wing": "ok"}


def test_story_is_that_of_the_state(sky: Sky) -> None:
    """Of several conditions the story is that of the one in the badge and in the list, whichever began first."""
    gps = Address("wing", "sensor_gps", 0)
    for seconds, state, fields in ((5, 1, {}), (5, 3, {}), (5, 3, {"dead_reckoning": True})):
        for _ in range(seconds):
            sky.fly(1, **fields)
            sky.add(gps, fix_type=3, satellites_used=14, jamming_state=state)
    page = Page(sky)
    (badge,) = re.findall(r'<span class="badge \w+">. (.*?)</span>', page.part("why"))
    assert badge == page.states["wing"] == "dead reckoning"
    assert f'<div class="verdict">{badge} from' in page.part("why").replace("position valid throughout, but ", "")


def test_marker_stays_where_the_vehicle_was(sky: Sky) -> None:
    """The marker of a vehicle that is silent or invalid is open, has the shape of its state, and stays where it was."""
    sky.fly(3, WING, QUAD, x=4.0, y=2.0)
    page = Page(sky)
    assert page.marks["wing"]["shape"] == "circle"
    assert page.marks["wing"]["fill"] == page.marks["wing"]["colour"] != DARK.ground
    sky.add(xy_valid=False)
    page.look()
    assert (page.marks["wing"]["shape"], page.marks["wing"]["fill"]) == ("square", DARK.ground), "at once"
    sky.fly(3, WING, x=99.0, xy_valid=False)
    page.look(alive=[WING])
    assert page.marks["wing"]["words"] == "xy not valid"
    assert page.marks["quad"]["words"].startswith("gone")
    for mark in page.marks.values():
        assert (mark["shape"], mark["fill"], mark["north"], mark["east"]) == ("square", DARK.ground, 4.0, 2.0)
        assert mark["edge"] == DARK.grades["bad"]


def test_choice_stays_while_rows_move(sky: Sky) -> None:
    """Without a choice the worst vehicle is chosen; a choice stays when the order changes.

    It is made in the list, on the map, and by keys, which go around; a name that is not there changes nothing.
    """
    sky.fly(3, WING, QUAD)
    page = Page(sky)
    assert page.chosen == "quad"
    for action, value, chosen in (
        ("vehicle", "nobody", "quad"), ("vehicle", "wing", "wing"), ("down", "", "quad"), ("up", "", "wing"),
        ("up", "", "quad"), ("down", "", "wing"),
    ):  # fmt: skip
        page.say(action, value)
        assert page.chosen == chosen
        assert [name for name, row in page.listed.items() if row["chosen"] == "true"] == [chosen]
    sky.fly(3, QUAD, xy_valid=False)
    sky.fly(0.1, WING)
    page.look()
    assert page.vehicles == ["quad", "wing"]
    assert page.chosen == "wing"
    for name in ("quad", "wing", "quad", "quad"):
        page.tap("shape", page.marks[name]["words"])
        assert page.chosen == name


def test_search_finds_by_name_and_state(sky: Sky) -> None:
    """The list has the vehicles whose name or state has what is searched; the counts and the map stay of all."""
    sky.fly(3, WING, Address("wind", VLP), QUAD)
    sky.fly(3, Address("wind", VLP), QUAD, xy_valid=False)
    page = Page(sky)
    for text, found in ((" WIN ", ["wind", "wing"]), ("not VALID", ["quad", "wind"]), (HOSTILE, []), ("", 3)):
        page.search(text)
        assert page.vehicles == found if isinstance(found, list) else len(page.vehicles) == found
        assert "2 bad" in page.part("head")
        assert len(page.marks) == 3
    assert HOSTILE not in page.text


def test_words_of_peers_are_escaped(sky: Sky) -> None:
    """Reasons of rejections, a link's words, a title and what the address says are text wherever they are shown."""
    sky.fly(3)
    for reason in ("the first", HOSTILE):
        sky.account.reject(WING, reason, sky.time)
        sky.fleet.reject([RejectionReport(WING, reason, round(sky.time * 1e9))])
        sky.time += 20
        sky.look()
    assert any(HOSTILE in event.text for event in sky.chronicle.events)
    sky.fly(0.1)
    page = Page(sky, title=HOSTILE, asked="?view=%3Cimg&theme=%3Cimg&time=%3Cimg")
    page.say("streams")
    page.look(link=HOSTILE, own=HOSTILE)
    assert "2 rejected" in page.part("head")
    assert "<img" not in page.text
    assert page.part("head").count("&lt;img") == 3
    reasons = re.findall(r"wing/vehicle_local_position</td><td>(.*?)</td>", page.part("more"))
    assert reasons == ["&lt;img src=x onerror=alert(1)&gt;", "the first"]
    for name in ("wing<img", "<img", 'a"b', "a b", "²"):
        with pytest.raises(ValueError, match="is not valid"):
            Address(name, VLP)


def test_plots_come_one_by_one(sky: Sky) -> None:
    """Map and list are not held up by plots: the first one follows as soon as a browser has drawn something."""
    sky.fly(3, WING, Address("far", "vehicle_status"))
    viewer = (page := Page(sky, asked="?vehicle=wing")).viewer
    assert len(viewer._grid.children) == 3
    assert viewer._grid.visible
    page.say("vehicle", "far")
    assert not viewer._grid.visible, "it has no position, and no plot keeps a place on a phone"
    other = Shown(sky.fleet, sky.chronicle).viewer
    for drawn, count in (("", 0), ("", 0), ("1", 1), ("2", 2), ("3", 3), ("4", 3)):
        other._drawn.value = drawn
        other.update()
        assert len(other._grid.children) == count


def test_texts_of_px4_are_quoted_and_escaped(sky: Sky) -> None:
    """PX4's own texts are on the timeline and in the story, in quotes, whatever is in them; they change no state."""
    sky.fly(2)
    sky.add(Address("wing", "log_message"), severity=2, text=HOSTILE)
    sky.fly(1, xy_valid=False)
    sky.add(Address("wing", "log_message"), severity=6, text="Landing detected")
    sky.fly(1, xy_valid=False)
    page = Page(sky)
    assert page.states == {"wing": "xy not valid"}
    timeline = [(row["words"], row["marker"]) for row in page.rows("vehicle")]
    assert timeline == [
        (f'PX4: "{HOSTILE}"', "square"), ("xy not valid", "square"), ('PX4: "Landing detected"', "circle"),
    ]  # fmt: skip
    assert "PX4: &#34;&lt;img src=x onerror=alert(1)&gt;&#34;" in page.part("why")
    assert "<img" not in page.text


def test_viewers_share_no_model(sky: Sky) -> None:
    """Each viewer has a document of its own."""
    sky.fly(3)
    first, second = ([*page.document.models] for page in [Page(sky), Page(sky)])
    assert not set(map(id, first)) & set(map(id, second))


def test_quiet_page_sends_little(sky: Sky) -> None:
    """Without a new message, and with nothing that changes, an update sends nothing."""
    sky.fly(3, WING, heading=None)
    sky.fly(3, WING, heading=None, dead_reckoning=True)
    page = Page(sky)
    sent = data_sent(page.document)
    page.update()
    assert not sent


# The map


def frame_of(page: Page) -> tuple[list[float], list[float]]:
    """Return from where to where the map is, east and north [m]."""
    frame = next(each for each in sources(page) if set(each.data) == {"east", "north"})
    return list(frame.data["east"]), list(frame.data["north"])


def test_map_shows_all_or_one(sky: Sky) -> None:
    """It fits all vehicles with their trails, and never less than 20 m; it follows one, or shows the trail of one."""
    sky.fly(3, WING)
    page = Page(sky)
    east, north = frame_of(page)
    assert east[1] - east[0] >= MIN_SIDE
    assert north[1] - north[0] >= MIN_SIDE
    for number in range(30):
        sky.fly(0.1, WING, x=-2.0 * number)
        sky.fly(0.1, QUAD, x=300.0, y=-500.0)
    page.look()
    east, north = frame_of(page)
    assert east[0] < -500 < 0 < east[1] < 100
    assert -100 < north[0] < -58 < 300 < north[1] < 400
    page.say("focus:follow")
    page.say("vehicle", "wing")
    assert frame_of(page) == ([-30, 30], [-88, -28])
    page.say("focus:vehicle")
    east, north = frame_of(page)
    assert -80 < north[0] <= -58 < 0 <= north[1] < 20
    page.say("focus:nonsense")
    assert frame_of(page) == (east, north)
    assert page.address == "?vehicle=wing&view=vehicle"


@pytest.mark.parametrize("size", ["340x330", "560x430", "1100x700"])
def test_labels_do_not_lie_on_each_other(sky: Sky, size: str) -> None:
    """Of 50 vehicles in a heap those have their name on the map that have room, the chosen one and bad ones first."""
    places = {f"uav-{number}": (7.0 * (number // 10), 11.0 * (number % 10)) for number in range(1, 51)}
    for _ in range(5):
        sky.time += 0.1
        for name, (x, y) in places.items():
            sky.add(Address(name, VLP), x=x, y=y, xy_valid=True, z_valid=name not in ("uav-17", "uav-50"))
    page = Page(sky, asked="?vehicle=uav-23")
    page.say("size", size)
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
            assert not is_on or mark["name"] in ("uav-23", "uav-17", "uav-50"), "it lies on another marker"


def test_trails_are_a_minute_or_long(sky: Sky) -> None:
    """The key t shows the quarter of an hour that is kept, on the map and in the plots, and the minute again."""
    for _ in range(20):
        sky.fly(10, rate=5)
    page = Page(sky)
    assert page.moments == pytest.approx((sky.time - 60, sky.time), abs=0.01)
    minute = len(page.plotted["speed"])
    page.say("trail")
    assert "trail 15 min" in page.part("tool")
    assert page.moments == pytest.approx((sky.time - 600, sky.time), abs=0.01)
    assert page.plotted["time"][0] < (sky.time - 190) * 1e3
    page.say("trail")
    assert len(page.plotted["speed"]) == minute
    assert 'data-do="truth" aria-pressed="true"' in page.part("tool")
    page.say("truth")
    assert 'data-do="truth" aria-pressed="false"' in page.part("tool")


# The timeline


def test_timeline_counts_the_vehicles_without_a_row(sky: Sky) -> None:
    """Of 50 vehicles it has rows for the chosen one, and for those with faults before others; the last row counts."""
    addresses = [Address(f"uav-{number}", VLP) for number in range(1, 51)]
    sky.fly(1, *addresses)
    sky.fly(1, addresses[29], xy_valid=False)
    sky.fly(0.1, *addresses)
    timeline = Page(sky, asked="?vehicle=uav-9").viewer._timeline.figure
    labels: dict[int, str] = cast("Any", timeline).yaxis[0].major_label_overrides
    assert [labels[row] for row in sorted(labels, reverse=True)] == [
        "uav-9", "uav-30", "uav-1", "uav-2", "uav-3", "uav-4", "+44 more",
    ]  # fmt: skip
    assert sorted(cast("Any", timeline).yaxis[0].ticker.ticks) == sorted(labels)
    assert cast("Any", timeline).y_range.start < min(labels)


def test_timeline_has_a_legend(sky: Sky) -> None:
    """Each shape in the timeline is explained in the line above it."""
    figure = cast("Any", Page(sky).viewer._timeline.figure)
    for words in ("■ bad", "▲ watch", "● phase of flight", "▬ lasting", "┊ now"):
        assert words in figure.title.text


def test_timeline_begins_with_the_first_event(sky: Sky) -> None:
    """The timeline of live vehicles is a minute long at least, and ten minutes at most."""
    sky.fly(3)
    page = Page(sky)

    def shown() -> tuple[float, float]:
        page.say("focus:all")
        span: Any = page.viewer._timeline.range
        return span.start / 1e3 - sky.time, span.end / 1e3 - sky.time

    assert shown() == pytest.approx((-61, 0), abs=0.2)
    sky.fly(1, xy_valid=False)
    sky.fly(199)
    page.look()
    assert shown() == pytest.approx((-201, 0), abs=0.2)
    sky.fly(500)
    page.look()
    assert shown() == pytest.approx((-61, 0), abs=0.2)


# Moments


@pytest.fixture
def flown(sky: Sky) -> Sky:
    """Return two vehicles: "wing" was invalid 200 s ago, for 4 s, and 50 s ago reset; "quad" was dead reckoning."""
    sky.fly(30.04, WING, QUAD)
    for seconds, wing, quad in (
        (4, {"xy_valid": False}, {}), (96, {}, {}), (4, {}, {"dead_reckoning": True}), (46, {}, {}),
        (50, {"x": 30.0, "xy_reset_counter": 1, "delta_xy": (30.0, 0.0)}, {}),
    ):  # fmt: skip
        for _ in range(seconds * 10):
            sky.time += 0.1
            sky.add(WING, **wing)
            sky.add(QUAD, **quad)
            if not round(sky.time * 10) % 5:
                sky.look(alive=[WING, QUAD])
    sky.look(alive=[WING, QUAD])
    return sky


def event_of(sky: Sky, text: str) -> float:
    """Return when this happened."""
    return next(event.time for event in sky.chronicle.events if event.text.startswith(text))


def test_tapped_event_is_shown(flown: Sky) -> None:
    """A tap on an event shows that moment: list and map stay of now, plots and sentence are of then, until "now"."""
    page = Page(flown, asked="?vehicle=quad")
    assert (page.pinned, page.address) == (None, "?vehicle=quad")
    page.tap("row", "xy not valid")
    then = event_of(flown, "xy not valid")
    assert (page.chosen, page.pinned) == ("wing", then)
    assert page.moments == pytest.approx((then - 30, then + 30), abs=0.01)
    assert "xy not valid from 22:13:50.1 to 22:13:54.1 UTC (4.0 s)" in page.part("why")
    assert page.grades["wing"] in ("ok", "watch")
    assert "back to now" in page.part("tool")
    assert f"time={then:.1f}" in page.address
    times = page.plotted["time"]
    assert times[0] / 1e3 < then < times[-1] / 1e3
    flown.fly(5, WING, QUAD, x=30.0, xy_reset_counter=1)
    page.look()
    assert page.pinned == then
    page.say("now")
    assert page.pinned is None
    assert "back to now" not in page.part("tool")
    assert "time=" not in page.address
    assert page.moments == pytest.approx((flown.time - 60, flown.time), abs=0.01)


def test_event_on_the_map_is_shown(flown: Sky) -> None:
    """An event has a mark on the map where the vehicle was then, which can be tapped, and tapped again."""
    page = Page(flown, asked="?vehicle=wing")
    source = next(each for each in sources(page) if "marker" in each.data and "row" not in each.data)
    assert source.data["words"] == ["reset of xy by 30.0 m (30.0 north, 0.0 east)"]
    for _ in range(2):
        source.selected.indices = [0]
        page.update()
        assert page.pinned == event_of(flown, "reset")
        assert "reset of xy by 30.0 m" in page.part("why")
        page.say("now")


def test_keys_go_from_event_to_event(flown: Sky) -> None:
    """P goes to the event of the chosen vehicle before, n to the next one, and escape back to now."""
    page = Page(flown, asked="?vehicle=wing")
    reset, begin = event_of(flown, "reset"), event_of(flown, "xy not valid")
    page.say("next")
    assert page.pinned is None
    for action, moment in (
        ("previous", reset), ("previous", begin), ("previous", begin), ("next", reset), ("next", reset), ("now", None),
    ):  # fmt: skip
        page.say(action)
        assert page.pinned == moment
    page.say("play")
    page.say("left")
    assert page.pinned is None


@pytest.mark.parametrize("event", ["xy not valid", "reset", None])
def test_address_shows_the_same_to_somebody_else(flown: Sky, event: str | None) -> None:
    """A page that is opened with the address of another has its vehicle, view, colours, moment and sentence."""
    page = Page(flown, asked="?theme=light")
    page.say("vehicle", "wing")
    page.say("focus:follow")
    if event is not None:
        page.say("previous")
        if event != "reset":
            page.say("previous")
    other = Page(flown, asked=page.address)
    other.update()
    assert other.address == page.address
    assert other.chosen == "wing"
    assert other.pinned == (None if event is None else pytest.approx(page.pinned, abs=0.06))
    assert other.part("tool") == page.part("tool")
    assert re.search('<div class="verdict">(.*?)</div>', other.part("why")) or event is None
    assert re.sub(r"\([^)]*\)", "", other.part("why")) == re.sub(r"\([^)]*\)", "", page.part("why"))
    assert other.marks["wing"]["colour"] in LIGHT.vehicles


ASKED = (
    "vehicle=&view=&time=&theme=", "time=nan", "time=inf", "time=-1e300", "time=99:99:99", "time=25:61",
    "time=1e18", "vehicle=nobody&view=__class__&time=0", f"vehicle={'x' * 5000}&time={'9' * 5000}",
    "time=%00&vehicle=%FF%00",
)  # fmt: skip


@pytest.mark.parametrize(
    "asked",
    [each if index % 4 == 1 else pytest.param(each, marks=pytest.mark.slow) for index, each in enumerate(ASKED)],
)
def test_any_address_is_survived(flown: Sky, asked: str) -> None:
    """Nonsense in an address is left out; where it names an unknown vehicle, another can be chosen."""
    page = Page(flown, asked=asked)
    page.update()
    assert page.vehicles == ["wing", "quad"]
    page.say("vehicle", "quad")
    page.say("now")
    assert page.address == "?vehicle=quad"


SAID = (
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


def test_whatever_a_browser_says_is_survived(flown: Sky) -> None:
    """No action, index, size, number of a picture, selection or range of a browser stops the updates of its page."""
    page = Page(flown)
    for said in SAID:
        page.say_raw(said)
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
                with suppress(ValueError):  # what Bokeh refuses from a browser as well
                    setattr(cast("Any", plot).x_range, name, value)
        page.update()
    for drawn in ("", "x", "-5", "1e9", "9" * 6000, "²", "NaN"):
        page.viewer._drawn.value = drawn
        page.update()
    page.search("x" * 10**6)
    page.search("")
    page.say("now")
    page.say("vehicle", "wing")
    page.look()
    assert page.vehicles == ["wing", "quad"]
    assert page.chosen == "wing"
    assert page.part("list").count("<div") == 4


def test_browser_that_draws_nothing_is_sent_nothing(sky: Sky) -> None:
    """A browser is sent two pictures ahead of the last one that it has drawn, and no more until it has drawn that."""
    sky.fly(3)
    page = Page(sky)
    drawn = page.viewer._sent
    for _ in range(10):
        sky.fly(0.1)
        sky.look()
        page.viewer.update()
    assert page.viewer._sent == drawn + 2
    sent = data_sent(page.document)
    page.viewer.update()
    assert not sent
    page.viewer._drawn.value = str(drawn + 1)
    page.viewer.update()
    assert sent


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colours, as WCAG 2 has it."""

    def luminance(colour: str) -> float:
        parts = [int(colour[index : index + 2], 16) / 255 for index in (1, 3, 5)]
        linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
        return sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))

    bright, dim = sorted((luminance(one), luminance(other)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


@pytest.mark.parametrize("style", [DARK, LIGHT], ids=lambda style: style.name)
def test_colours_can_be_read(style: Style) -> None:
    """Text has a contrast of 4.5 with all that is under it, marks and lines one of 3; no vehicle looks like a state."""
    for ground in (style.ground, style.panel, style.chosen):
        for text in (style.text, style.quiet, *(style.grades[grade] for grade in ("bad", "watch", "ok"))):
            assert contrast(text, ground) >= 4.5, (text, ground)
    for grade, fill in style.fills.items():
        assert contrast(style.grades[grade], fill) >= 4.5, grade
    for colour in (*style.vehicles, style.truth):
        assert contrast(colour, style.ground) >= 3, colour
    assert not set(style.vehicles) & set(style.grades.values())


# Live vehicles, of a real bus


@contextmanager
def open_page(endpoint: str) -> Iterator[tuple[Shown, Callable[[Callable[[], object], str], None]]]:
    """Give the page of a bus with one viewer, and what goes on as the server does until a condition holds."""
    stop = threading.Event()
    with nedbus.connect(endpoint) as bus, ThreadPoolExecutor(1) as pool:
        live = LiveFleet(bus, Selection(), version="0")
        page = Shown(live.fleet, live.chronicle)

        def until(condition: Callable[[], object], what: str) -> None:
            def is_so() -> object:
                page.update()
                return condition()

            wait_for(is_so, what=what)

        reading = pool.submit(live.run, stop)
        try:
            yield page, until
        finally:
            stop.set()
        reading.result()


def test_page_follows_its_vehicles(endpoint: str, bus: nedbus.Bus, zenoh_session: Session) -> None:
    """Published vehicles are in the list and on the map; those no longer valid, or switched off, stay there."""
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
            until(lambda: page.states == {"quad": "gone", "wing": "xy not valid"}, "the end of the other")
        assert page.marks["quad"]["shape"] == "square"
        zenoh_session.put(Address("wing", VLP).rejected_key(), json.dumps({"reason": "a rule"}))
        page.say("streams")
        until(lambda: "<td>a rule</td>" in page.part("more"), "the report")
        until(lambda: any("rejected: a rule" in event.text for event in page.viewer._chronicle.events), "its event")


def test_page_outlives_the_router() -> None:
    """While the router is away the header says so, markers are open, and no vehicle is blamed; then all goes on."""
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
        until(lambda: f"no link to {where}" in page.part("head"), "the words")
        assert page.grades == {"wing": "ok"}
        assert page.marks["wing"]["fill"] == DARK.ground
        router = open_router(listen=(where,))
        until(lambda: page.marks["wing"]["fill"] != DARK.ground, "the vehicle again")
        until(lambda: "no link to" not in page.part("head"), "the header to say so")
        told = [
            event.text.partition(" after")[0] for event in page.viewer._chronicle.events if event.kind == "link_down"
        ]
        assert told == [f"no link to {where}", "link is back"]
    router.close()
