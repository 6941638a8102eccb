"""The page's own knowledge of vehicles, without a browser: their states, their places, and silence."""

from __future__ import annotations

import math
from typing import Any

import pytest

from nedbus.events import EventLog, Times
from nedbus.web.chronicle import Chronicle
from nedbus.web.fleet import TRUTH
from nedbus.web.stream import COLUMNS, POINTS, PageStream
from nedbus_msgs import Address
from nedbus_msgs.frames import MapProjection
from tests.flights.messages import VLP, message
from tests.nedbus.web.page import NOON, QUAD, WING, Sky, addresses_of, sky

__all__ = ["sky"]  # a fixture

ORIGIN = {"ref_lat": 47.397742, "ref_lon": 8.545594, "ref_alt": 488.0}
ZURICH: dict[str, Any] = {"xy_global": True, "z_global": True, **ORIGIN}
SECOND_EKF = Address("wing", "estimator_local_position", 1)
GROUND_TRUTH = Address("wing", TRUTH)


def column(stream: PageStream, name: str) -> list[float]:
    values: list[float] = stream.minute.points(0, stream.minute.written)[:, COLUMNS.index(name)].tolist()
    return values


# The states


@pytest.mark.parametrize(
    ("fields", "grade", "text", "words"),
    [
        ({}, "ok", "ok", "ok"),
        ({"xy_valid": False}, "bad", "xy not valid", "xy invalid"),
        ({"z_valid": False, "v_z_valid": False}, "bad", "z not valid", "z vz invalid"),
        ({"dead_reckoning": True}, "watch", "dead reckoning", "dead reckoning"),
        ({"dead_reckoning": True, "v_xy_valid": False}, "bad", "vxy not valid", "vxy invalid, dead reckoning"),
        ({"heading_good_for_control": False}, "ok", "ok", "ok"),
    ],
)
def test_state_is_what_the_flags_say(sky: Sky, fields: dict[str, Any], grade: str, text: str, words: str) -> None:
    """A vehicle is in the worst state that the flags of its position say, from the first message on or later."""
    sky.fly(3, **fields)
    assert (sky.row().grade, sky.row().state.text, sky.line().words) == (grade, text, words)
    sky.fly(3)
    assert (sky.row().grade, sky.row().state.text, sky.line().words) == ("ok", "ok", "ok")
    began = sky.time + 0.1
    sky.fly(3, **fields)
    assert (sky.row().grade, sky.row().state.text, sky.line().words) == (grade, text, words)
    assert sky.row().state.since == (pytest.approx(began, abs=0.01) if fields and grade != "ok" else None)


@pytest.mark.parametrize("other", [SECOND_EKF, GROUND_TRUTH, Address("wing", "estimator_local_position", 0)], ids=str)
@pytest.mark.parametrize("begins_later", [True, False])
def test_other_estimates_do_not_speak_for_a_vehicle(sky: Sky, other: Address, begins_later: bool) -> None:
    """An EKF instance that is bad, slow or silent, or a bad ground truth, leaves the vehicle ok, also if it is first.

    The stream itself says in the details what is wrong with it.
    """
    if not begins_later:
        sky.fly(1, other, xy_valid=False)
    sky.fly(2)
    for fields in ({"xy_valid": False, "dead_reckoning": True}, {"z_valid": False, "v_z_valid": False}):
        for _ in range(30):
            sky.fly(0.1)
            sky.add(other, **fields)
        row = sky.row()
        assert (row.grade, row.state.text, row.state.conditions, row.main.address) == ("ok", "ok", (), WING)
        assert "invalid" in sky.line(other).words
    sky.fly(30)
    assert sky.line(other, alive=[WING]).state.name == "gone"
    assert sky.row(alive=[WING]).grade == "ok"


def test_slow_stream_is_no_state_of_its_vehicle(sky: Sky) -> None:
    """A stream at less than half of its usual rate is slow; the state of the vehicle is that of its events alone."""
    sky.fly(20, rate=20)
    sky.fly(3, rate=5)
    assert str(sky.line().state).startswith("slow: 5.0 Hz, usually ")
    assert sky.row().state == sky.event_log.state("wing", sky.time)
    assert sky.row().grade == "ok"


def test_page_that_is_behind_blames_no_vehicle(sky: Sky) -> None:
    """While messages wait unread no vehicle falls silent or goes, as nobody knows; what flags said before holds on."""
    sky.fly(3, WING)
    sky.fly(1, QUAD, xy_valid=False)
    sky.time += 10
    for _ in range(3):
        sky.time += 0.5
        picture = sky.look(alive=[], is_behind=True, own="slow")
    assert {row.vehicle: row.state.text for row in picture.rows} == {"quad": "xy not valid", "wing": "ok"}
    assert sky.event_log.overload is not None
    assert not [event for event in sky.chronicle.events if event.kind in ("silent", "gone")]
    sky.time += 6
    sky.look(alive=[])
    assert sky.event_log.overload is None
    assert sky.row(alive=[]).state.text.startswith("gone: ")


def test_state_holds_since_it_began(sky: Sky) -> None:
    """`since` is when a state began; of silence it is the last message, whatever the silence is called."""
    sky.fly(3)
    assert (sky.row().state.text, sky.row().state.since) == ("ok", None)
    sky.fly(0.1, dead_reckoning=True)
    began = sky.time
    sky.fly(2, dead_reckoning=True)
    assert (sky.row().state.text, sky.row().state.since) == ("dead reckoning", began)
    last = sky.time
    sky.time += 2.5
    gone = sky.row(alive=[])
    assert (gone.grade, gone.brief) == ("bad", "gone")
    assert gone.state.since == pytest.approx(last, abs=0.01)
    sky.time += 3
    assert sky.row(alive=[]).state.since == pytest.approx(last, abs=0.01)
    assert not sky.row(alive=[]).is_here
    sky.fly(2)
    assert sky.row().is_here
    last = sky.time
    sky.time += 10
    silent = sky.row(alive=[WING])
    assert (silent.grade, silent.brief) == ("bad", "silent")
    assert silent.state.since == pytest.approx(last, abs=0.01)
    assert sky.line(alive=[WING]).words == "stale: nothing for 10.0 s, 1 gaps"


def test_link_that_is_cut_blames_no_vehicle(sky: Sky) -> None:
    """Without a link vehicles keep their last state, none of them is here, and the picture says why."""
    sky.fly(3)
    sky.time += 60
    row = sky.row(alive=[], link="no link to tcp/ground:7447")
    assert (row.grade, row.is_here, row.main.state.name) == ("ok", False, "disconnected")
    assert sky.fleet.picture.alarms == ["no link to tcp/ground:7447"]


def test_worst_comes_first(sky: Sky) -> None:
    """Vehicles are ordered by what is wrong, then by name, whose numbers count: uav-2 is before uav-10."""
    flags: dict[str, dict[str, object]] = {
        "uav-10": {}, "uav-2": {}, "uav-1": {}, "Z": {}, "uav-30": {"xy_valid": False}, "uav-4": {"z_valid": False},
        "uav-20": {"dead_reckoning": True}, "7": {}, "12": {},
    }  # fmt: skip
    for _ in range(30):
        sky.time += 0.1
        for name, fields in flags.items():
            sky.add(Address(name, VLP), **fields)
    picture = sky.look()
    order = [row.vehicle for row in picture.rows]
    assert order[:3] == ["uav-4", "uav-30", "uav-20"]
    assert order[3:] == ["7", "12", "Z", "uav-1", "uav-2", "uav-10"]


def test_vehicle_that_left_long_ago_stays_bad(sky: Sky) -> None:
    """A vehicle that is gone stays above those to be watched, until it is forgotten or comes back."""
    sky.fly(3, WING, QUAD)
    sky.time += 2100
    sky.fly(3, WING, dead_reckoning=True)
    assert [(row.vehicle, row.grade) for row in sky.look(alive=[WING]).rows] == [("quad", "bad"), ("wing", "watch")]
    sky.fly(30, WING, QUAD)
    assert [row.grade for row in sky.look(alive=[WING, QUAD]).rows] == ["ok", "ok"]


def test_only_so_many_streams_are_shown(sky: Sky, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the limit streams are counted and not shown, until one has been silent for a minute and is forgotten."""
    monkeypatch.setattr("nedbus.web.fleet.MAX_STREAMS", 3)
    names = [Address(f"v{number}", VLP) for number in range(5)]
    sky.fly(1, *names)
    picture = sky.look()
    assert (addresses_of(picture), picture.left_out) == (names[:3], 2)
    sky.time += 61
    sky.fly(0.1, names[3])
    picture = sky.look()
    assert (addresses_of(picture), picture.left_out) == (names[1:4], 1)
    sky.time += 61
    sky.fly(0.1, names[0])
    picture = sky.look()
    assert (addresses_of(picture), picture.left_out) == ([names[0], *names[2:4]], 1)


def test_positions_come_before_other_messages(sky: Sky, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page that is full forgets other messages for a position, and nothing for them."""
    monkeypatch.setattr("nedbus.web.fleet.MAX_STREAMS", 2)
    attitude, battery = Address("wing", "vehicle_attitude"), Address("wing", "battery_status", 0)
    sky.fly(2, attitude, battery)
    assert addresses_of(sky.look()) == [battery, attitude]
    assert sky.row().grade == "ok"
    sky.fly(2, WING, attitude, QUAD, battery)
    picture = sky.look()
    assert (addresses_of(picture), picture.left_out) == ([QUAD, WING], 2)
    assert sky.stream().minute.written


def test_other_messages_tell_facts(sky: Sky) -> None:
    """Mode, arming, battery and GPS are of a vehicle's own messages; another battery, or an unknown charge, is none."""

    def facts() -> list[str]:
        return [fact.text for fact in sky.row().facts.values()]

    sky.fly(1)
    assert facts() == ["", "", "", ""]
    sky.add(Address("wing", "vehicle_status"), nav_state=4, arming_state=2)
    sky.add(Address("wing", "battery_status", 0), remaining=0.834)
    sky.add(Address("wing", "battery_status", 1), remaining=0.1)
    sky.add(Address("wing", "sensor_gps", 0), fix_type=2, satellites_used=5)
    assert facts() == ["Hold", "armed", "83 %", "2D · 5"]
    sky.add(Address("wing", "vehicle_gps_position"), fix_type=3, satellites_used=14)
    sky.add(Address("wing", "battery_status", 0), remaining=-1.0)
    sky.add(Address("wing", "vehicle_status"), nav_state=200, arming_state=1)
    assert facts() == ["200", "disarmed", "", "3D · 14"]


def test_last_valid_place_is_told(sky: Sky) -> None:
    """Where a vehicle was last is where it was valid last; beside it its latitude and longitude, if it has them."""
    sky.fly(1, xy_valid=False, x=9.0)
    assert sky.row().where == "none yet"
    sky.fly(1, x=3.0, y=-4.0, z=-5.0)
    sky.fly(1, xy_valid=False, x=77.0, y=77.0)
    assert sky.row().where == "3.0 m north, -4.0 m east, altitude 5.0 m"
    sky.fly(1, **ZURICH, x=10.0, z=-12.0)
    sky.fly(1, **ZURICH, xy_valid=False, x=77.0)
    assert sky.row().where == "10.0 m north, 0.0 m east, altitude 500.0 m (47.397832, 8.545594)"


# Places, lines and their breaks


def test_vehicles_with_origins_share_one(sky: Sky) -> None:
    """Two vehicles with different global origins are where they are; one without stays on its own."""
    north = MapProjection(ZURICH["ref_lat"], ZURICH["ref_lon"]).reproject(100.0, 50.0)
    lost = Address("lost", VLP)
    sky.fly(1, WING, **ZURICH, x=1.0, y=2.0)
    sky.fly(1, QUAD, **{**ZURICH, "ref_lat": north[0], "ref_lon": north[1]}, x=1.0, y=2.0)
    sky.fly(1, lost, x=1.0, y=2.0)
    places = {row.vehicle: row.main.stream.valid for row in sky.look().rows}
    assert all(places.values())
    assert places["wing"] == pytest.approx((2.0, 1.0, 488.0, True), abs=1e-3)
    assert places["quad"] == pytest.approx((52.0, 101.0, 488.0, True), abs=0.05)
    assert places["lost"] == (2.0, 1.0, 0.0, False)


def test_invalid_position_is_no_place(sky: Sky) -> None:
    """Invalid values are NaN in the history, each quantity by its own flag; the last valid place stays."""
    sky.fly(1, x=1.0, y=2.0, z=-3.0, vx=4.0)
    before = sky.stream().valid
    sky.fly(1, xy_valid=False, z_valid=False, v_xy_valid=False, v_z_valid=False, x=9.0, y=9.0, z=9.0, vx=9.0)
    stream = sky.stream()
    for name, value in (("north", 1.0), ("east", 2.0), ("height", 3.0), ("speed", 4.0)):
        assert column(stream, name)[0] == value
        assert math.isnan(column(stream, name)[-1])
    assert stream.valid == before


def test_reset_breaks_the_line(sky: Sky) -> None:
    """A reset of xy or z, or a new origin, breaks both histories before it."""
    sky.fly(1, x=1.0)
    sky.fly(1, x=5.0, y=1.0, xy_reset_counter=1, delta_xy=(4.0, 1.0))
    stream = sky.stream()
    norths = column(stream, "north")
    broken = norths.index(5.0) - 1
    assert math.isnan(norths[broken])
    assert norths[broken - 1] == 1.0
    assert [math.isnan(east) for east in stream.long.points(0, stream.long.written)[:, 1]] == [False, True, False]
    written = stream.minute.written
    sky.fly(0.1, x=5.0, z=-9.0, xy_reset_counter=1, z_reset_counter=1, delta_z=-9.0)
    sky.fly(0.1, x=5.0, z=-9.0, xy_reset_counter=1, z_reset_counter=1, **ZURICH)
    assert stream.minute.written == written + 4


def test_history_is_of_ten_points_a_second(sky: Sky) -> None:
    """At 100 Hz the history has a minute, and a change of a flag at once; the longer one about a point a second."""
    sky.fly(2, rate=100)
    minute, long = sky.stream().minute, sky.stream().long
    assert 18 <= minute.written <= 22
    before = minute.written
    sky.fly(0.01, rate=100, xy_valid=False)
    sky.fly(0.01, rate=100)
    assert minute.written == before + 2
    sky.fly(70, rate=20)
    points = minute.points(0, minute.written)
    assert len(points) == POINTS
    assert 58 <= (points[-1, 0] - points[0, 0]) / 1e3 <= 70
    assert 64 <= long.written <= 74


@pytest.mark.parametrize("rate", [50, 250])
def test_truth_with_a_new_reference_time_each_message_is_whole(sky: Sky, rate: int) -> None:
    """PX4's simulators give the ground truth a ref_timestamp that changes with each message: it has a minute, unbroken.

    The origin, which is the same, neither breaks the line nor makes a point of each message.
    """
    for number in range(70 * rate):
        sky.time += 1 / rate
        sky.add(GROUND_TRUTH, **ZURICH, x=number / rate, ref_timestamp=1_000_000 + number)
    minute = sky.stream(GROUND_TRUTH).minute
    points = minute.points(0, minute.written)
    assert len(points) == POINTS
    assert 57 <= (points[-1, 0] - points[0, 0]) / 1e3 <= 66
    assert not [north for north in column(sky.stream(GROUND_TRUTH), "north") if math.isnan(north)]


def test_place_of_a_moment_is_of_the_histories(sky: Sky) -> None:
    """The place of an event is the nearest valid point, of the last minute or of the longer history, if any."""
    begin = sky.time
    for second in range(200):
        sky.fly(1, x=float(second))
    for ago in (5, 120):
        (place,) = sky.stream().places_at([sky.time - ago])
        assert place is not None
        assert place.north == pytest.approx(199 - ago, abs=1.1)
    assert sky.stream().places_at([begin - 5]) == [None]


@pytest.mark.parametrize("late", [0.0, 0.2, -0.2])
def test_distance_to_the_truth_is_of_one_moment(sky: Sky, late: float) -> None:
    """The ground truth is moved with its velocity to the estimate's time; beside one that is too old there is none."""
    sky.add(GROUND_TRUTH, x=100.0, vx=20.0, vy=-10.0, z=-50.0)
    sky.time += late
    sky.add(x=100.0 + 20.0 * late + 3.0, y=-10.0 * late, z=-54.0)
    assert column(sky.stream(), "error")[-1] == pytest.approx(5.0, abs=1e-3)
    sky.time += 0.8
    sky.add(x=100.0)
    assert math.isnan(column(sky.stream(), "error")[-1])


def test_distance_needs_one_frame(sky: Sky) -> None:
    """An estimate with an origin is not compared with a truth without one, nor is one that is not valid."""
    sky.add(GROUND_TRUTH)
    sky.add(**ZURICH)
    assert math.isnan(column(sky.stream(), "error")[-1])
    sky.add(QUAD)
    assert math.isnan(column(sky.stream(QUAD), "error")[-1])
    sky.time += 0.1
    sky.add(xy_valid=False)
    assert math.isnan(column(sky.stream(), "error")[-1])


def test_each_time_names_its_clock() -> None:
    """Times are UTC live, and of a recording that has it; else since boot if only one vehicle booted, or the start."""
    recorded = Chronicle(EventLog(), times=Times())
    assert recorded.clock(75.25) == "75.2 s since the start of the recording"
    recorded.set_start("1", 70.0, 10.0)
    assert recorded.clock(75.25) == "135.2 s since boot, 75.2 s since the start of the recording"
    recorded.times = Times(offsets={"1": NOON})
    recorded.set_start("1", 70.0, 10.0)
    assert recorded.clock(600.0) == "22:24:20.0 UTC, 600.0 s since the start of the recording"
    live = Chronicle(EventLog())
    assert live.clock(NOON) == "22:13:20.0 UTC"
    several = EventLog()
    for name in ("1", "2"):
        several.add(Address(name, VLP), message(1_000_000), 0.0)
    recorded = Chronicle(several, times=Times())
    recorded.set_start("1", 70.0, 10.0)
    assert recorded.clock(75.25) == "75.2 s since the start of the recording"
