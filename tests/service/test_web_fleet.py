"""What the page in the browser knows of vehicles, without a browser: their states, where they were, and when not."""

from __future__ import annotations

import math
from typing import Any

import pytest

from nedbus.web.fleet import TRUTH
from nedbus.web.stream import COLUMNS, POINTS, Stream
from nedbus.web.style import to_clock
from nedbus_msgs import Address, MapProjection
from tests.messages import VLP
from tests.web import NOON, QUAD, WING, Sky, sky

__all__ = ["sky"]  # a fixture

ORIGIN = {"ref_lat": 47.397742, "ref_lon": 8.545594, "ref_alt": 488.0}
ZURICH: dict[str, Any] = {"xy_global": True, "z_global": True, **ORIGIN}


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
    assert (sky.line().condition, sky.line().words) == (condition, words)


def test_slow_stream_is_slow(sky: Sky) -> None:
    """A stream at less than half of its usual rate is slow, with both rates in words."""
    sky.fly(20, rate=20)
    sky.fly(3, rate=5)
    assert (sky.line().condition, sky.line().words[:16]) == ("slow", "5.0 Hz, usually ")


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


def test_worst_comes_first(sky: Sky) -> None:
    """Lines are ordered by condition, then by address."""
    addresses = [Address(name, VLP) for name in ("a", "b", "c", "d")]
    for _ in range(30):
        sky.time += 0.1
        for address, fields in zip(addresses, ({}, {"xy_valid": False}, {"dead_reckoning": True}, {}), strict=True):
            sky.add(address, **fields)
    picture = sky.look(alive=addresses[:3])
    assert [line.address.vehicle for line in picture.worst_first()] == ["b", "c", "a", "d"]
    sky.time += 2
    assert [line.address.vehicle for line in sky.look(alive=addresses[:3]).worst_first()] == ["d", "b", "c", "a"]
    assert picture.rate == pytest.approx(40, rel=0.1)


def test_only_so_many_streams_are_shown(sky: Sky, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the limit streams are counted and not shown, until one has been silent for a minute and is forgotten."""
    monkeypatch.setattr("nedbus.web.fleet.MAX_STREAMS", 3)
    names = [Address(f"v{number}", VLP) for number in range(5)]
    sky.fly(1, *names)
    picture = sky.look()
    assert ([line.address for line in picture.lines], picture.left_out) == (names[:3], 2)
    sky.time += 61
    sky.fly(0.1, names[3])
    picture = sky.look()
    assert ([line.address for line in picture.lines], picture.left_out) == (names[1:4], 1)
    sky.time += 61
    sky.fly(0.1, names[0])
    picture = sky.look()
    assert ([line.address for line in picture.lines], picture.left_out) == ([names[0], *names[2:4]], 1)
    assert sky.line(names[0]).since == sky.time


def test_positions_come_before_other_messages(sky: Sky, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page that is full forgets other messages for a position, and nothing for them."""
    monkeypatch.setattr("nedbus.web.fleet.MAX_STREAMS", 2)
    attitude, battery = Address("wing", "vehicle_attitude"), Address("wing", "battery_status", 0)
    sky.fly(2, attitude, battery)
    assert [(line.address, line.condition) for line in sky.look().lines] == [(battery, "ok"), (attitude, "ok")]
    sky.fly(2, WING, attitude, QUAD, battery)
    picture = sky.look()
    assert ([line.address for line in picture.lines], picture.left_out) == ([QUAD, WING], 2)
    assert sky.stream().written


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
    """A reset of xy or z, or a new origin, breaks the track before it; a valid one of xy is marked where it led."""
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
    sky.fly(1, xy_valid=False, xy_reset_counter=2)
    assert len(stream.resets) == 1


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


def test_clock_is_of_the_recording_or_of_the_host() -> None:
    """Times since the start of a recording are minutes and seconds; others are of this host's clock."""
    assert to_clock(75.25) == "1:15.2"
    assert to_clock(119.99) == "2:00.0"
    assert to_clock(NOON).count(":") == 2
