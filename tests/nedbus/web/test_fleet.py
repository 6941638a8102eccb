"""Vehicles and streams of the page, without a browser: states, positions, histories and silence."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from typing import Any

import pytest

from nedbus import Sample
from nedbus.client import LogStreamStatus
from nedbus.monitoring import Snapshot
from nedbus.vehicle_events import EventLog, Times
from nedbus.web.event_timeline import EventTimeline
from nedbus.web.fleet import TRUTH
from nedbus.web.stream import COLUMNS, POINTS, PageStream, Position
from nedbus_msgs import Address
from nedbus_msgs.frames import MapProjection
from tests.flights.messages import VALID, VLP, message
from tests.nedbus.web.page import NOON, QUAD, WING, SimulatedFleet, addresses_of, describe, sim
from tests.waits import DEADLINE

__all__ = ["sim"]  # a fixture

ORIGIN = {"ref_lat": 47.397742, "ref_lon": 8.545594, "ref_alt": 488.0}
ZURICH: dict[str, Any] = {"xy_global": True, "z_global": True, **ORIGIN}
SECOND_EKF = Address("wing", "estimator_local_position", 1)
GROUND_TRUTH = Address("wing", TRUTH)


def column(stream: PageStream, name: str) -> list[float]:
    values: list[float] = stream.minute.points(0, stream.minute.written)[
        :, COLUMNS.index(name)
    ].tolist()
    return values


# The states


@pytest.mark.parametrize(
    ("fields", "grade", "text", "description"),
    [
        ({}, "ok", "ok", "ok"),
        ({"xy_valid": False}, "bad", "xy not valid", "xy invalid"),
        ({"z_valid": False, "v_z_valid": False}, "bad", "z not valid", "z vz invalid"),
        ({"dead_reckoning": True}, "watch", "dead reckoning", "dead reckoning"),
        (
            {"dead_reckoning": True, "v_xy_valid": False},
            "bad",
            "vxy not valid",
            "vxy invalid, dead reckoning",
        ),
        ({"heading_good_for_control": False}, "ok", "ok", "ok"),
    ],
)
def test_state_follows_the_validity_flags(
    sim: SimulatedFleet, fields: dict[str, Any], grade: str, text: str, description: str
) -> None:
    """A vehicle has the worst state that the flags of its position imply, even in the first message."""
    sim.fly(3, **fields)
    assert (sim.vehicle().grade, sim.vehicle().state.text, describe(sim.view())) == (
        grade,
        text,
        description,
    )
    sim.fly(3)
    assert (sim.vehicle().grade, sim.vehicle().state.text, describe(sim.view())) == (
        "ok",
        "ok",
        "ok",
    )
    began = sim.time + 0.1
    sim.fly(3, **fields)
    assert (sim.vehicle().grade, sim.vehicle().state.text, describe(sim.view())) == (
        grade,
        text,
        description,
    )
    assert sim.vehicle().state.since == (
        pytest.approx(began, abs=0.01) if fields and grade != "ok" else None
    )


@pytest.mark.parametrize(
    "other", [SECOND_EKF, GROUND_TRUTH, Address("wing", "estimator_local_position", 0)], ids=str
)
@pytest.mark.parametrize("begins_later", [True, False])
def test_secondary_estimates_do_not_affect_the_vehicle_state(
    sim: SimulatedFleet, other: Address, begins_later: bool
) -> None:
    """A bad, slow or silent EKF instance, or a bad ground truth, leaves its vehicle "ok", even if it is received first.

    The description of that stream names the fault.
    """
    if not begins_later:
        sim.fly(1, other, xy_valid=False)
    sim.fly(2)
    for fields in (
        {"xy_valid": False, "dead_reckoning": True},
        {"z_valid": False, "v_z_valid": False},
    ):
        for _ in range(30):
            sim.fly(0.1)
            sim.add(other, **fields)
        row = sim.vehicle()
        assert (row.grade, row.state.text, row.state.conditions, row.main.address) == (
            "ok",
            "ok",
            (),
            WING,
        )
        assert "invalid" in describe(sim.view(other))
    sim.fly(30)
    assert sim.view(other, alive=[WING]).state.name == "gone"
    assert sim.vehicle(alive=[WING]).grade == "ok"


def test_slow_stream_does_not_affect_the_vehicle_state(sim: SimulatedFleet) -> None:
    """A stream below half its usual rate is slow; the vehicle's state depends only on its events."""
    sim.fly(20, rate=20)
    sim.fly(3, rate=5)
    assert str(sim.view().state).startswith("slow: 5.0 Hz, usually ")
    assert sim.vehicle().state == sim.event_log.state("wing", sim.time)
    assert sim.vehicle().grade == "ok"


def test_overloaded_page_does_not_report_vehicles_as_silent(sim: SimulatedFleet) -> None:
    """While messages wait in the queue, vehicles keep their state: they become neither silent nor gone."""
    sim.fly(3, WING)
    sim.fly(1, QUAD, xy_valid=False)
    sim.time += 10
    for _ in range(3):
        sim.time += 0.5
        snapshot = sim.poll(alive=[], is_behind=True, behind="slow")
    assert {row.vehicle: row.state.text for row in snapshot.vehicles} == {
        "quad": "xy not valid",
        "wing": "ok",
    }
    assert sim.event_log.overload is not None
    assert not [event for event in sim.timeline.events if event.kind in ("silent", "gone")]
    sim.time += 6
    sim.poll(alive=[])
    assert sim.event_log.overload is None
    assert sim.vehicle(alive=[]).state.text.startswith("gone: ")


def test_since_is_the_start_of_the_state(sim: SimulatedFleet) -> None:
    """`since` is the start of a state; for a silent or gone vehicle it is the time of the last message."""
    sim.fly(3)
    assert (sim.vehicle().state.text, sim.vehicle().state.since) == ("ok", None)
    sim.fly(0.1, dead_reckoning=True)
    began = sim.time
    sim.fly(2, dead_reckoning=True)
    assert (sim.vehicle().state.text, sim.vehicle().state.since) == ("dead reckoning", began)
    last = sim.time
    sim.time += 2.5
    gone = sim.vehicle(alive=[])
    assert (gone.grade, gone.brief) == ("bad", "gone")
    assert gone.state.since == pytest.approx(last, abs=0.01)
    sim.time += 3
    assert sim.vehicle(alive=[]).state.since == pytest.approx(last, abs=0.01)
    assert not sim.vehicle(alive=[]).has_position
    sim.fly(2)
    assert sim.vehicle().has_position
    last = sim.time
    sim.time += 10
    silent = sim.vehicle(alive=[WING])
    assert (silent.grade, silent.brief) == ("bad", "silent")
    assert silent.state.since == pytest.approx(last, abs=0.01)
    assert describe(sim.view(alive=[WING])) == "stale: nothing for 10.0 s, 1 gap"


def test_lost_link_leaves_vehicle_states_unchanged(sim: SimulatedFleet) -> None:
    """Without a link vehicles keep their last states but have no positions, and the snapshot contains an alarm."""
    sim.fly(3)
    sim.time += 60
    row = sim.vehicle(alive=[], link="no link to tcp/ground:7447")
    assert (row.grade, row.has_position, row.main.state.name) == ("ok", False, "disconnected")
    assert sim.fleet.snapshot.alarms == ["no link to tcp/ground:7447"]


def test_losses_on_the_link_of_a_vehicle_are_in_the_count_of_the_page(sim: SimulatedFleet) -> None:
    """The page has one count of lost messages: those lost after publishing, and about those of the ULog stream."""
    sim.fly(1)
    assert sim.poll().lost == "0"
    log = LogStreamStatus("wing", "streaming", lost=740, lost_messages=5731, gaps=1)
    assert sim.poll(logs={"wing": log}).lost == "about 5,731"
    assert sim.vehicle(logs={"wing": log}).lost == 5731


def test_vehicles_are_sorted_by_severity_then_name(sim: SimulatedFleet) -> None:
    """Vehicles are sorted by severity, then by name in natural order: uav-2 before uav-10."""
    flags: dict[str, dict[str, object]] = {
        "uav-10": {}, "uav-2": {}, "uav-1": {}, "Z": {}, "uav-30": {"xy_valid": False}, "uav-4": {"z_valid": False},
        "uav-20": {"dead_reckoning": True}, "7": {}, "12": {},
    }  # fmt: skip
    for _ in range(30):
        sim.time += 0.1
        for name, fields in flags.items():
            sim.add(Address(name, VLP), **fields)
    snapshot = sim.poll()
    order = [row.vehicle for row in snapshot.vehicles]
    assert order[:3] == ["uav-4", "uav-30", "uav-20"]
    assert order[3:] == ["7", "12", "Z", "uav-1", "uav-2", "uav-10"]


def test_gone_vehicle_stays_bad(sim: SimulatedFleet) -> None:
    """A gone vehicle ranks above vehicles of severity "watch" until it is forgotten or returns."""
    sim.fly(3, WING, QUAD)
    sim.time += 2100
    sim.fly(3, WING, dead_reckoning=True)
    assert [(row.vehicle, row.grade) for row in sim.poll(alive=[WING]).vehicles] == [
        ("quad", "bad"),
        ("wing", "watch"),
    ]
    sim.fly(30, WING, QUAD)
    assert [row.grade for row in sim.poll(alive=[WING, QUAD]).vehicles] == ["ok", "ok"]


def test_streams_above_the_limit_are_only_counted(
    sim: SimulatedFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Streams above the limit are counted but not shown, until a shown stream has been silent for a minute."""
    monkeypatch.setattr("nedbus.limits.PAGE_STREAMS", 3)
    names = [Address(f"v{number}", VLP) for number in range(5)]
    sim.fly(1, *names)
    snapshot = sim.poll()
    assert (addresses_of(snapshot), snapshot.left_out) == (names[:3], 2)
    sim.time += 61
    sim.fly(0.1, names[3])
    snapshot = sim.poll()
    assert (addresses_of(snapshot), snapshot.left_out) == (names[1:4], 2)
    sim.time += 61
    sim.fly(0.1, names[0])
    snapshot = sim.poll()
    assert (addresses_of(snapshot), snapshot.left_out) == ([names[0], *names[2:4]], 2)


def test_streams_added_during_an_update_are_counted(
    sim: SimulatedFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Streams above the limit that arrive in another thread while the snapshot is updated are counted."""
    monkeypatch.setattr("nedbus.limits.PAGE_STREAMS", 2)
    others = [Address(f"v{number}", VLP) for number in range(2)]
    waiting, adding = list(others), list[threading.Thread]()

    class Alive(Counter[Address]):
        def __getitem__(self, shown: Address) -> int:
            for address in waiting[:1]:
                waiting.remove(address)
                adding.append(threading.Thread(target=sim.add, args=[address]))
                adding[-1].start()
                adding[-1].join(0.1)  # it ends now if it does not have to wait
            return super().__getitem__(shown)

    sim.fly(1, WING, QUAD)
    sim.fleet.update(Snapshot(sim.time, alive=Alive([WING, QUAD, *others])), {}, {})
    for thread in adding:
        thread.join(DEADLINE)
    assert len(adding) == 2
    assert sim.poll(alive=[WING, QUAD, *others]).left_out == 2


def test_position_replaces_other_streams_at_the_limit(
    sim: SimulatedFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the limit, a new position stream replaces a stream of another topic; no other new stream does."""
    monkeypatch.setattr("nedbus.limits.PAGE_STREAMS", 2)
    attitude, battery = Address("wing", "vehicle_attitude"), Address("wing", "battery_status", 0)
    sim.fly(2, attitude, battery)
    assert addresses_of(sim.poll()) == [battery, attitude]
    assert sim.vehicle().grade == "ok"
    sim.fly(2, WING, attitude, QUAD, battery)
    snapshot = sim.poll()
    assert (addresses_of(snapshot), snapshot.left_out) == ([QUAD, WING], 2)
    assert sim.stream().minute.written


def test_mode_arming_battery_and_gps_are_shown(sim: SimulatedFleet) -> None:
    """Mode and arming come from `vehicle_status`, charge from the first battery if known, and GPS from the fix."""

    def status() -> list[str]:
        return [fact.text for fact in sim.vehicle().status.values()]

    sim.fly(1)
    assert status() == ["", "", "", ""]
    sim.add(Address("wing", "vehicle_status"), nav_state=4, arming_state=2)
    sim.add(Address("wing", "battery_status", 0), remaining=0.834)
    sim.add(Address("wing", "battery_status", 1), remaining=0.1)
    sim.add(Address("wing", "sensor_gps", 0), fix_type=2, satellites_used=5)
    assert status() == ["Hold", "armed", "83 %", "2D · 5"]
    sim.add(Address("wing", "vehicle_gps_position"), fix_type=3, satellites_used=14)
    sim.add(Address("wing", "battery_status", 0), remaining=-1.0)
    sim.add(Address("wing", "vehicle_status"), nav_state=200, arming_state=1)
    assert status() == ["200", "disarmed", "", "3D · 14"]


def test_last_position_is_the_last_valid_position(sim: SimulatedFleet) -> None:
    """The last valid position is shown, with latitude and longitude if it has a global origin."""
    sim.fly(1, xy_valid=False, x=9.0)
    assert sim.vehicle().last_position == "none yet"
    sim.fly(1, x=3.0, y=-4.0, z=-5.0)
    sim.fly(1, xy_valid=False, x=77.0, y=77.0)
    assert sim.vehicle().last_position == "3.0 m north, -4.0 m east, height 5.0 m"
    sim.fly(1, **ZURICH, x=10.0, z=-12.0)
    sim.fly(1, **ZURICH, xy_valid=False, x=77.0)
    assert (
        sim.vehicle().last_position
        == "10.0 m north, 0.0 m east, altitude 500.0 m (47.397832, 8.545594)"
    )


# Positions and histories


def test_vehicles_with_global_origins_share_one_origin(sim: SimulatedFleet) -> None:
    """Positions of vehicles with global origins are relative to a common origin, others to the vehicle's own origin."""
    north = MapProjection(ZURICH["ref_lat"], ZURICH["ref_lon"]).reproject(100.0, 50.0)
    lost = Address("lost", VLP)
    sim.fly(1, WING, **ZURICH, x=1.0, y=2.0)
    sim.fly(1, QUAD, **{**ZURICH, "ref_lat": north[0], "ref_lon": north[1]}, x=1.0, y=2.0)
    sim.fly(1, lost, x=1.0, y=2.0)
    places = {row.vehicle: row.main.stream.valid for row in sim.poll().vehicles}
    assert all(places.values())
    assert places["wing"] == pytest.approx((2.0, 1.0, 488.0, True, True), abs=1e-3)
    assert places["quad"] == pytest.approx((52.0, 101.0, 488.0, True, True), abs=0.05)
    assert places["lost"] == Position(2.0, 1.0, 0.0, common=False, is_altitude_global=False)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_one_wild_origin_is_not_the_common_one(sim: SimulatedFleet, number: int) -> None:
    """The common origin is one that two successive messages of a vehicle have, also if one message was wild."""
    for each in range(4):
        fields = ZURICH | ({"ref_lat": -33.0, "ref_lon": 151.0} if each == number else {})
        sim.fly(0.1, WING, **fields, x=1.0, y=2.0)
    sim.fly(1, QUAD, **{**ZURICH, "ref_lat": 10.0})
    projection = sim.fleet.origin.projection
    assert projection == MapProjection(ZURICH["ref_lat"], ZURICH["ref_lon"])
    assert column(sim.stream(WING), "north")[-1] == pytest.approx(1.0, abs=1e-3)


def test_invalid_position_is_nan_in_the_history(sim: SimulatedFleet) -> None:
    """Invalid values are NaN in the history, each quantity by its own flag; the last valid position is kept."""
    sim.fly(1, x=1.0, y=2.0, z=-3.0, vx=4.0)
    before = sim.stream().valid
    sim.fly(
        1,
        xy_valid=False,
        z_valid=False,
        v_xy_valid=False,
        v_z_valid=False,
        x=9.0,
        y=9.0,
        z=9.0,
        vx=9.0,
    )
    stream = sim.stream()
    for name, value in (("north", 1.0), ("east", 2.0), ("height", 3.0), ("speed", 4.0)):
        assert column(stream, name)[0] == value
        assert math.isnan(column(stream, name)[-1])
    assert stream.valid == before


def test_reset_adds_a_gap_to_the_history(sim: SimulatedFleet) -> None:
    """A reset of xy or z, or a new origin, adds a gap to both histories."""
    sim.fly(1, x=1.0)
    sim.fly(1, x=5.0, y=1.0, xy_reset_counter=1, delta_xy=(4.0, 1.0))
    stream = sim.stream()
    norths = column(stream, "north")
    broken = norths.index(5.0) - 1
    assert math.isnan(norths[broken])
    assert norths[broken - 1] == 1.0
    assert [math.isnan(east) for east in stream.long.points(0, stream.long.written)[:, 1]] == [
        False,
        True,
        False,
    ]
    written = stream.minute.written
    sim.fly(0.1, x=5.0, z=-9.0, xy_reset_counter=1, z_reset_counter=1, delta_z=-9.0)
    sim.fly(0.1, x=5.0, z=-9.0, xy_reset_counter=1, z_reset_counter=1, **ZURICH)
    assert stream.minute.written == written + 4


def test_histories_have_ten_points_and_one_point_per_second(sim: SimulatedFleet) -> None:
    """The minute history has ten points per second, plus one per flag change; the long history has about one."""
    sim.fly(2, rate=100)
    minute, long = sim.stream().minute, sim.stream().long
    assert 18 <= minute.written <= 22
    before = minute.written
    sim.fly(0.01, rate=100, xy_valid=False)
    sim.fly(0.01, rate=100)
    assert minute.written == before + 2
    sim.fly(70, rate=20)
    points = minute.points(0, minute.written)
    assert len(points) == POINTS
    assert 58 <= (points[-1, 0] - points[0, 0]) / 1e3 <= 70
    assert 64 <= long.written <= 74


@pytest.mark.slow
@pytest.mark.parametrize("rate", [50, 250])
def test_changing_ref_timestamp_does_not_add_gaps_to_ground_truth(
    sim: SimulatedFleet, rate: int
) -> None:
    """PX4's simulators change ref_timestamp of the ground truth with each message, but not its origin.

    The history still covers a minute without gaps.
    """
    for number in range(70 * rate):
        sim.time += 1 / rate
        sim.add(GROUND_TRUTH, **ZURICH, x=number / rate, ref_timestamp=1_000_000 + number)
    minute = sim.stream(GROUND_TRUTH).minute
    points = minute.points(0, minute.written)
    assert len(points) == POINTS
    assert 57 <= (points[-1, 0] - points[0, 0]) / 1e3 <= 66
    assert not [north for north in column(sim.stream(GROUND_TRUTH), "north") if math.isnan(north)]


@pytest.mark.slow
def test_position_at_a_time_comes_from_both_histories(sim: SimulatedFleet) -> None:
    """The position at a time is the last valid point before it in either history; None if there is no such point."""
    begin = sim.time
    for second in range(200):
        sim.fly(1, x=float(second))
    for ago in (5, 120):
        (place,) = sim.stream().positions_at([sim.time - ago])
        assert place is not None
        assert place.north == pytest.approx(199 - ago, abs=1.1)
    assert sim.stream().positions_at([begin - 5]) == [None]


@pytest.mark.parametrize("late", [0.0, 0.2, -0.2])
def test_error_is_measured_at_the_time_of_the_estimate(sim: SimulatedFleet, late: float) -> None:
    """The ground truth is extrapolated to the time of the estimate; without a recent one the error is NaN."""
    sim.add(GROUND_TRUTH, x=100.0, vx=20.0, vy=-10.0, z=-50.0)
    sim.time += late
    sim.add(x=100.0 + 20.0 * late + 3.0, y=-10.0 * late, z=-54.0)
    assert column(sim.stream(), "error")[-1] == pytest.approx(5.0, abs=1e-3)
    sim.time += 0.8
    sim.add(x=100.0)
    assert math.isnan(column(sim.stream(), "error")[-1])


def test_position_error_requires_a_common_frame(sim: SimulatedFleet) -> None:
    """The error is NaN if only the estimate has a global origin, or if the estimate is invalid."""
    sim.add(GROUND_TRUTH)
    sim.add(**ZURICH)
    assert math.isnan(column(sim.stream(), "error")[-1])
    sim.add(QUAD)
    assert math.isnan(column(sim.stream(QUAD), "error")[-1])
    sim.time += 0.1
    sim.add(xy_valid=False)
    assert math.isnan(column(sim.stream(), "error")[-1])


def test_formatted_time_names_its_clock() -> None:
    """Live times are UTC. Those of a recording are UTC if known, else since boot (one vehicle) or since its start."""
    recorded = EventTimeline(EventLog(), times=Times())
    assert recorded.format_clock(75.25) == "75.2 s since the start of the recording"
    recorded.set_clock("1", 70.0, 10.0)
    assert (
        recorded.format_clock(75.25)
        == "135.2 s since boot, 75.2 s since the start of the recording"
    )
    recorded.times = Times(offsets={"1": NOON})
    recorded.set_clock("1", 70.0, 10.0)
    assert (
        recorded.format_clock(600.0) == "22:24:20.0 UTC, 600.0 s since the start of the recording"
    )
    live = EventTimeline(EventLog())
    assert live.format_clock(NOON) == "22:13:20.0 UTC"
    several = EventLog()
    for name in ("1", "2"):
        several.add(Address(name, VLP), message(1_000_000), 0.0)
    recorded = EventTimeline(several, times=Times())
    recorded.set_clock("1", 70.0, 10.0)
    assert recorded.format_clock(75.25) == "75.2 s since the start of the recording"


def test_stream_shows_the_newest_message_of_the_monitor(sim: SimulatedFleet) -> None:
    """The page keeps no messages; a retained one is as old as its time of sending, and a forgotten stream is gone."""
    retained = Sample(
        message(1, **VALID), QUAD, 0, retained=True, _sent=time.time_ns() - 3_600_000_000_000
    )
    sim.monitor.add(retained)
    sim.fleet.add(retained, sim.time)
    sim.fly(1, WING)
    assert (sim.view(WING).newest, sim.view(QUAD).newest) == (sim.monitor[WING], sim.monitor[QUAD])
    assert str(sim.view(QUAD).state) == "stale: nothing for 60 min"
    sim.monitor.forget(QUAD)
    assert addresses_of(sim.poll()) == [WING]
    assert sim.fleet.streams.keys() == {WING}
