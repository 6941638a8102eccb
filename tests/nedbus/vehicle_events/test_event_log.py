"""Events of an event log, from synthetic messages."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import example, given

from nedbus import limits
from nedbus.timings import TIMINGS
from nedbus.vehicle_events import (
    ALL,
    KINDS,
    RECENT,
    WINDOW,
    Event,
    EventLog,
)
from nedbus.vehicle_events.rules import KIND_CHANGES, PAUSE
from nedbus_msgs import RESET_COUNTERS, Address
from tests.flights.messages import VALID, message

from .flight import ARMED, DISARMED, GOOD_GPS, POSITION, Flight


@pytest.fixture
def flight() -> Flight:
    """Return a vehicle that has sent one position."""
    flight = Flight()
    assert flight.send() == []
    return flight


def brief(events: Iterable[Event]) -> list[tuple[str, str, str]]:
    return [(event.kind, event.change, event.severity) for event in events]


def test_conditions_in_first_message_are_not_events() -> None:
    """Conditions active in the first message set the state without an event; only their end is an event."""
    flight = Flight()
    assert flight.send(xy_valid=False, dead_reckoning=True) == []
    assert (flight.severity, flight.kinds) == ("bad", ["xy_invalid", "dead_reckoning"])
    ended = flight.wait(0.1).send()
    assert [(event.text, event.lasted) for event in ended] == [
        ("xy valid for the first time", None), ("dead reckoning ended", None),
    ]  # fmt: skip
    assert (flight.severity, flight.kinds) == ("info", [])


@pytest.mark.parametrize("kind", ["xy", "z", "v_xy", "v_z"])
def test_invalid_flag_begins_and_ends_condition(flight: Flight, kind: str) -> None:
    """A cleared validity flag is a condition of severity "bad" until a message sets the flag again."""
    begun = flight.wait(0.1).send(**dict[str, Any]({f"{kind}_valid": False}))
    assert brief(begun) == [(f"{kind}_invalid", "begin", "bad")]
    ended = flight.wait(2.5).send()
    assert brief(ended) == [(f"{kind}_invalid", "end", "info")]
    assert ended[0].lasted == pytest.approx(2.5)
    assert ended[0].text.endswith("valid again after 2.5 s")
    assert ended[0].time == flight.now
    assert ended[0].boot == pytest.approx(flight.now - flight.booted)


def test_reboot_is_reported_once(flight: Flight) -> None:
    """When several streams step back in time, one reboot is reported, and conditions end without an event."""
    flight.status(ARMED, failsafe=True)
    flight.gps(satellites_used=12)
    flight.wait(0.1).send(xy_valid=False)
    flight.wait(0.1).gps(satellites_used=3)
    assert {"xy_invalid", "few_satellites", "failsafe"} <= set(flight.kinds)
    flight.booted = flight.now
    assert flight.wait(1.0).send() == []
    reported = flight.wait(0.1).send()
    assert brief(reported) == [("reboot", "once", "bad")]
    assert reported[0].text == "reboot (up for 1.1 s, before it for 10.1 s)"
    assert flight.kinds == ["reboot"]
    assert flight.wait(1.0).gps() == []  # neither a second reboot nor the end of few_satellites
    flight.fly(20)
    assert flight.status(DISARMED) == []
    assert [each.kind for each in flight.event_log.events].count("reboot") == 1


def test_stream_resuming_long_after_reboot_is_not_another_reboot(flight: Flight) -> None:
    """Streams that step back later, in any order, belong to the same reboot, and the vehicle stays armed."""
    streams: list[Callable[[], list[Event]]] = [
        flight.send,
        flight.gps,
        lambda: flight.status(ARMED),
    ]
    for first in range(3):
        flight.wait(1000.0)
        for send in streams:
            send()
        flight.new_events()
        flight.booted = flight.now
        reported = []
        for index in range(3):
            flight.wait(8.0)
            reported += streams[(first + index) % 3]()
        assert [each.kind for each in reported if each.kind not in ("silent", "gone")] == ["reboot"]
        assert flight.event_log.vehicles["1"].armed is True


def test_delayed_message_from_before_reboot_is_not_a_reboot(flight: Flight) -> None:
    """A delayed message of another stream, from before a reboot, is not a reboot: streams have no common order."""
    flight.gps()
    flight.booted, before = flight.now, flight.booted
    assert brief([*flight.wait(0.1).send(), *flight.wait(0.1).send()]) == [
        ("reboot", "once", "bad")
    ]
    flight.booted, after = before, flight.booted
    assert flight.wait(0.1).gps() == []
    flight.booted = after
    assert flight.wait(0.1).gps() == []


def test_reordered_message_is_not_a_reboot(flight: Flight) -> None:
    """A step back in time of up to a second is a reordered message, not a reboot."""
    flight.wait(5.0).send()
    flight.booted += 1.0
    assert flight.send() == []


def test_silence_is_reported_until_next_position(flight: Flight) -> None:
    """Silence dates from the last position, turns into "gone" without a publisher, and ends with the next position."""
    flight.fly(1)
    last = flight.now
    assert flight.wait(2.0).update() == []
    begun = flight.wait(2.0).update("stale")
    assert brief(begun) == [("silent", "begin", "bad")]
    assert begun[0].text == "silent: no vehicle_local_position for 4.0 s"
    assert flight.update("stale") == []
    assert brief(flight.wait(1.0).update("gone")) == [("gone", "begin", "bad")]
    assert flight.event_log.state("1", flight.now).since == last
    assert flight.update("stale") == []  # "gone" does not turn back into "silent"
    back = flight.wait(1.0).send()
    assert brief(back) == [("gone", "end", "info")]
    assert back[0].lasted == pytest.approx(6.0)
    assert flight.severity == "info"


def test_vehicle_without_stream_states_is_silent_after_3_s(flight: Flight) -> None:
    """If stream states are not observed, a vehicle is silent after 3 s without a position, whatever else arrives."""
    assert flight.wait(2.9).update(None) == []
    flight.gps()
    assert brief(flight.wait(0.2).update(None)) == [("silent", "begin", "bad")]


def test_burst_of_losses_is_one_event(flight: Flight) -> None:
    """A burst of losses is one event with the number of lost messages, at the time of the first loss."""
    flight.wait(1.0).send(lost=2)
    first = flight.now
    flight.wait(1.0).gps()
    flight.wait(1.0).send("vehicle_gps_position", lost=3, **GOOD_GPS)
    assert flight.update() == []
    reported = flight.wait(6.0).update()
    assert [(event.text, event.severity, event.time) for event in reported] == [
        ("5 messages lost in 2.0 s (vehicle_gps_position, vehicle_local_position)", "watch", first)
    ]
    assert flight.wait(6.0).update() == []


def test_continuous_loss_is_reported_every_20_s(flight: Flight) -> None:
    """Continuous losses are reported every 20 s, and the state stays "watch"."""
    reported = []
    for second in range(100):
        flight.wait(1.0).send(lost=1)
        reported += flight.update()
        assert second <= 21 or flight.severity == "watch"
    assert [event.numbers["messages"] for event in reported] == [22, 22, 22, 22]


def test_consecutive_rejections_are_one_condition(flight: Flight) -> None:
    """The first rejected message begins the condition, with its reason; 5 s without a rejection end it."""
    begun = flight.reject("x is NaN")
    assert brief(begun) == [("rejected", "begin", "watch")]
    assert begun[0].text == "vehicle_local_position rejected: x is NaN"
    assert flight.wait(1.0).reject("y is NaN") == []
    last = flight.now
    assert flight.severity == "watch"
    ended = flight.wait(6.0).update()
    assert [(event.kind, event.text, event.time) for event in ended] == [
        ("rejected", "rejections stopped (2 messages) after 1.0 s", last)
    ]
    assert flight.severity == "info"


def test_vehicle_is_not_silent_while_link_is_down(flight: Flight) -> None:
    """While the link is down no vehicle becomes silent, and the outage is an event of all vehicles."""
    flight.fly(1)
    flight.link = "no link to tcp/host:7447"
    begun = flight.update()
    assert [(event.vehicle, event.text) for event in begun] == [(ALL, "no link to tcp/host:7447")]
    assert flight.wait(60.0).update("disconnected") == []
    flight.link = ""
    ended = flight.wait(60.0).update("unknown")
    assert [(event.vehicle, event.kind, event.change, event.text) for event in ended] == [
        (ALL, "link_down", "end", "link restored after 2 min")
    ]
    assert flight.wait(1.0).send() == []
    assert flight.severity == "info"


def test_message_before_link_update_prevents_silence(flight: Flight) -> None:
    """A vehicle does not become silent if its message arrives before the restored link is polled."""
    flight.fly(1)
    flight.link = "no link"
    flight.update()
    assert flight.wait(60.0).send() == []
    flight.link = ""
    assert [event.kind for event in flight.update()] == ["link_down"]


def test_vehicle_missing_after_link_is_restored_is_silent(flight: Flight) -> None:
    """A vehicle that does not resume is silent 3 s after the link is restored, with the link as evidence."""
    flight.fly(1)
    flight.link = "no link"
    flight.update()
    flight.link = ""
    assert [event.kind for event in flight.wait(60.0).update("unknown")] == ["link_down"]
    assert flight.wait(2.0).update("unknown") == []
    reported = flight.wait(1.5).update("stale")
    assert brief(reported) == [("silent", "begin", "bad")]
    assert [each.text for each in reported[0].evidence] == ["link restored after 60.0 s"]


def test_flapping_link_is_suppressed(flight: Flight) -> None:
    """After four changes of the link in 10 s, only the last is reported, with the number of suppressed changes."""
    reported = []
    for index in range(9):
        flight.link = "no link" if index % 2 == 0 else ""
        reported += flight.wait(0.5).update("unknown")
    assert brief(reported) == [("link_down", "begin", "bad"), ("link_down", "end", "info")] * 2
    reported = flight.wait(6.0).update("unknown")
    assert [event.text for event in reported] == ["no link, the last of 5 suppressed changes"]
    flight.link = ""
    assert brief(flight.wait(10.0).update("unknown")) == [("link_down", "end", "info")]


def test_overload_ends_after_5_s_without_drops(flight: Flight) -> None:
    """The first drop begins an overload, and 5 s without a drop end it; the end event has the number of drops."""
    assert flight.update(dropped=0) == []
    begun = flight.update(dropped=10)
    assert [(event.vehicle, event.kind, event.change) for event in begun] == [
        (ALL, "overload", "begin")
    ]
    flight.fly(2)
    assert flight.update(dropped=25) == []
    flight.fly(4.9)
    assert flight.update(dropped=25) == []
    flight.fly(0.2)
    ended = flight.update(dropped=25)
    assert [(event.change, event.numbers) for event in ended] == [("end", {"messages": 25})]
    assert ended[0].lasted == pytest.approx(2.0)


def test_vehicle_is_not_silent_right_after_an_overload(flight: Flight) -> None:
    """A vehicle without messages is silent only once the reader has kept up for 3 s: they may be in its backlog."""
    flight.fly(1)
    for seconds in (0.0, 4.0, 1.5):  # the overload ends at the last update
        flight.wait(seconds).update(None, dropped=10)
    assert flight.event_log.overload is None
    assert flight.wait(1.4).update(None, dropped=10) == []
    assert [each.kind for each in flight.wait(0.2).update(None, dropped=10)] == ["silent"]


def test_overload_is_evidence_for_loss(flight: Flight) -> None:
    """An active condition of all vehicles is evidence for an event of one vehicle, however long ago it began."""
    for dropped in range(1, 31):
        flight.fly(1)
        flight.update(dropped=dropped)
    flight.wait(0.1).send(lost=3)
    flight.fly(4.5)
    flight.update(dropped=31)
    flight.fly(1)
    (lost,) = flight.update(dropped=32)
    assert [each.kind for each in lost.evidence] == ["overload"]


def test_battery_warning_is_a_condition(flight: Flight) -> None:
    """A low battery has severity "watch", a critical one "bad"; a warning is active until `warning` is 0."""
    assert flight.wait(1.0).battery(0) == []
    assert brief(flight.wait(1.0).battery(1)) == [("battery", "begin", "watch")]
    critical = flight.wait(1.0).battery(2)
    assert brief(critical) == [("battery", "begin", "bad")]
    assert critical[0].text == "battery critical, 20 % left"
    assert flight.severity == "bad"
    assert flight.wait(1.0).battery(2) == []
    assert brief(flight.wait(1.0).battery(0)) == [("battery", "end", "info")]
    assert flight.severity == "info"


def test_gps_conditions_have_hysteresis(flight: Flight) -> None:
    """Satellites, jamming and spoofing begin and end at different thresholds; unknown values are ignored."""
    assert flight.gps() == []
    assert brief(flight.gps(fix_type=4)) == [("gps_fix", "once", "info")]
    assert brief(flight.gps(fix_type=2)) == [("gps_fix_lost", "begin", "watch")]
    assert brief(flight.gps()) == [("gps_fix_lost", "end", "info")]
    assert brief(flight.gps(satellites_used=5)) == [("few_satellites", "begin", "watch")]
    assert flight.gps(satellites_used=6) == []
    assert flight.gps(satellites_used=255) == []  # unknown
    assert brief(flight.gps(satellites_used=7)) == [("few_satellites", "end", "info")]
    assert flight.gps(satellites_used=6) == []
    assert flight.gps(jamming_indicator=79) == []
    assert brief(flight.gps(jamming_indicator=80)) == [("jamming", "begin", "watch")]
    assert flight.gps(jamming_indicator=60) == []
    assert brief(flight.gps(jamming_indicator=59)) == [("jamming", "end", "info")]
    assert flight.gps(jamming_state=1) == []
    assert brief(flight.gps(jamming_state=2)) == [("jamming", "begin", "watch")]
    assert brief(flight.gps()) == [("jamming", "end", "info")]
    assert brief(flight.gps(spoofing_state=2)) == [("spoofing", "begin", "watch")]
    assert flight.gps(spoofing_state=3) == []
    assert brief(flight.gps(spoofing_state=1)) == [("spoofing", "end", "info")]


def test_no_fix_in_the_first_message_is_info(flight: Flight) -> None:
    """A missing fix in the first message has severity "info" and causes no event; the first fix is an event."""
    assert flight.gps(fix_type=0, satellites_used=0) == []
    assert flight.severity == "info"
    assert brief(flight.gps()) == [
        ("gps_fix_lost", "end", "info"),
        ("few_satellites", "end", "info"),
    ]


def test_flags_of_a_kind_set_in_one_message_are_one_event(flight: Flight) -> None:
    """Flags of one kind that are set in one message are one event that names them; each flag ends separately."""
    names = [
        "reject_hor_pos",
        "reject_hor_vel",
        "fs_bad_hdg",
        "cs_baro_fault",
        "cs_gnss_pos",
        "cs_baro_hgt",
    ]

    def send(**changed: Any) -> list[Event]:
        return flight.wait(0.1).send(
            "estimator_status_flags", **dict.fromkeys(names, False) | changed
        )

    assert send() == []
    begun = send(reject_hor_pos=True, reject_hor_vel=True)
    assert brief(begun) == [("innovation_rejected", "begin", "watch")]
    assert begun[0].text == "EKF rejects horizontal velocity, horizontal position"
    assert set(begun[0].names) == {"reject_hor_pos", "reject_hor_vel"}
    ended = send(reject_hor_pos=True)
    assert [(event.kind, event.change, event.names) for event in ended] == [
        ("innovation_rejected", "end", ("reject_hor_vel",))
    ]
    assert flight.severity == "watch"
    assert brief(send()) == [("innovation_rejected", "end", "info")]
    assert flight.severity == "info"
    assert brief(send(fs_bad_hdg=True, cs_baro_fault=True)) == [
        ("estimator_fault", "begin", "watch")
    ]
    assert brief(send(cs_gnss_pos=True, cs_baro_hgt=True))[0] == ("estimator_fault", "end", "info")
    # another height source is fused
    assert brief(send(cs_gnss_pos=True)) == [("not_fused", "begin", "info")]
    assert brief(send()) == [("not_fused", "begin", "watch")]


def test_missing_fix_and_reference_of_a_whole_flight_are_no_conditions() -> None:
    """A fix or global reference missing since the first message is usual in this flight: evidence, but no state."""
    flight, since = Flight(), 100.0
    assert flight.gps(fix_type=0, satellites_used=0) == flight.send(xy_global=False) == []
    assert flight.wait(1.0).status(DISARMED) == []
    # the first initial finding is few_satellites
    assert (flight.severity, flight.event_log.vehicles["1"].initial[1:]) == ("info", [])
    assert brief(flight.wait(1.0).status(ARMED)) == [("armed", "once", "info")]
    assert flight.wait(PAUSE + 0.1).update() == []
    assert flight.kinds == []
    vehicle = flight.event_log.vehicles["1"]
    assert [(each.text, each.severity, each.since, each.initial) for each in vehicle.usual.values()] == [
        ("no GPS fix, 0 satellites", "watch", since, True), ("xy has no global reference", "watch", since, True),
    ]  # fmt: skip
    assert vehicle.held_from_start == ""
    [lost] = flight.wait(1.0).send(xy_global=False, xy_valid=False)
    assert [each.kind for each in lost.evidence] == ["gps_fix_lost"]
    flight.wait(1.0).send(xy_global=False)
    assert brief(flight.gps(satellites_used=0)) == [("gps_fix_lost", "end", "info")]
    flight.wait(1.0).status(DISARMED)
    assert flight.severity == "info"
    flight.booted = flight.now
    flight.wait(1.0).send()
    flight.wait(1.0).status(ARMED)
    flight.wait(PAUSE).update()
    assert flight.kinds == ["reboot"]


def test_fix_acquired_before_arming_leaves_no_condition() -> None:
    """A fix and a global reference acquired before arming leave no condition."""
    flight = Flight()
    flight.status(DISARMED)
    flight.gps(fix_type=0, satellites_used=0)
    flight.send(xy_global=False, z_global=False)
    flight.wait(5.0).gps()
    flight.send()
    flight.wait(5.0).status(ARMED)
    flight.wait(PAUSE).update()
    assert flight.kinds == []


def test_flag_labels_are_words_not_field_names() -> None:
    """Labels of flags are words, not field names."""
    for kind in KINDS.values():
        for name, label in kind.flags.items():
            assert "_" not in label
            assert not re.match(r"(fd|cs|fs|reject) |.*relaxed$", label), name


def test_gcs_loss_is_info_while_disarmed(flight: Flight) -> None:
    """A lost GCS connection has severity "info" while the vehicle is disarmed, and "watch" while it is armed."""
    flight.status(DISARMED, gcs_connection_lost=False)
    assert brief(flight.wait(0.1).status(DISARMED, gcs_connection_lost=True)) == [
        ("gcs_lost", "begin", "info")
    ]
    assert brief(flight.wait(0.1).status(ARMED, gcs_connection_lost=True)) == [
        ("armed", "once", "info")
    ]
    flight.wait(0.1).status(ARMED, gcs_connection_lost=False)
    assert brief(flight.wait(0.1).status(ARMED, gcs_connection_lost=True)) == [
        ("gcs_lost", "begin", "watch")
    ]
    assert flight.severity == "watch"
    flight.wait(0.1).status(DISARMED, gcs_connection_lost=True)
    assert flight.severity == "info"


def test_flag_not_provided_is_not_an_event() -> None:
    """A field that the source does not provide is neither valid nor invalid, whatever its value."""
    flight = Flight()
    missing = (
        "z_valid",
        "v_z_valid",
        "heading_good_for_control",
        "dist_bottom_valid",
        "dead_reckoning",
    )
    flight.send(missing=missing, z_valid=False, v_z_valid=False, dead_reckoning=True)
    assert flight.kinds == []
    assert flight.wait(0.1).send(missing=missing, heading_good_for_control=True) == []
    reported = flight.wait(0.1).send(
        missing=missing, xy_valid=False, z_valid=False, v_z_valid=False
    )
    assert brief(reported) == [("xy_invalid", "begin", "bad")]


@pytest.mark.parametrize(
    ("topic", "instance"),
    [
        ("vehicle_local_position_groundtruth", None), ("estimator_local_position", 1), ("estimator_local_position", 0),
    ],
)  # fmt: skip
def test_other_estimates_are_ignored(flight: Flight, topic: str, instance: int | None) -> None:
    """Other EKFs and the ground truth neither cause events nor change the state."""
    fields = message(1, **VALID).model_dump() | {
        "xy_valid": False,
        "dead_reckoning": True,
        "x": 500.0,
    }
    for step in range(5):
        fields["timestamp"] = 100 - step
        assert flight.wait(0.1).send(topic, instance=instance, **fields) == []
        assert flight.send() == []
    assert flight.severity == "info"
    assert flight.event_log.vehicles["1"].main == POSITION


def test_estimator_position_is_used_without_vehicle_position() -> None:
    """Without vehicle_local_position the first EKF is used, until the vehicle's own position arrives."""
    flight = Flight()
    fields = message(1, **VALID).model_dump() | {"xy_valid": False}
    flight.send("estimator_local_position", instance=1, **fields)
    flight.send("estimator_local_position", instance=0, **fields)
    assert flight.event_log.vehicles["1"].main == Address("1", "estimator_local_position", 0)
    assert flight.kinds == ["xy_invalid"]
    assert flight.send() == []
    assert flight.kinds == []
    assert flight.send("estimator_local_position", instance=0, **fields) == []


def test_second_receiver_and_battery_are_ignored(flight: Flight) -> None:
    """Only instance 0 of a sensor is used, and vehicle_gps_position is preferred to sensor_gps."""
    flight.send("sensor_gps", instance=0, **GOOD_GPS)
    assert flight.send("sensor_gps", instance=1, **GOOD_GPS | {"fix_type": 0}) == []
    assert flight.send("battery_status", instance=1, warning=3, remaining=0.0, connected=True) == []
    assert flight.gps() == []
    assert flight.send("sensor_gps", instance=0, **GOOD_GPS | {"fix_type": 0}) == []
    assert brief(flight.gps(fix_type=0)) == [("gps_fix_lost", "begin", "watch")]
    assert flight.severity == "watch"


@pytest.mark.parametrize("direction", [1, -1])
def test_origin_beyond_the_antimeridian_is_wrapped(direction: int) -> None:
    """An origin that PX4 up to 1.15 sets beyond 180 degrees is wrapped, and has not moved if it is sent wrapped."""
    flight = Flight()
    flight.send(xy_global=False, z_global=False)
    origin: dict[str, Any] = {
        "xy_global": True,
        "z_global": True,
        "ref_lat": -17.0,
        "ref_alt": 488.0,
    }
    reported = flight.wait(0.1).send(**origin, ref_lon=direction * 180.5)
    [event] = [event for event in reported if event.kind == "origin_set"]
    assert event.text == f"origin set at -17.000000, {direction * -179.5:.6f}"
    assert event.numbers == {"latitude": -17.0, "longitude": direction * -179.5}
    assert flight.wait(0.1).send(**origin, ref_lon=direction * -179.5) == []


def test_new_timestamp_alone_does_not_move_origin() -> None:
    """The origin is set once; later changes of less than 1 cm, or of ref_timestamp alone, are not events."""
    flight = Flight()
    flight.send(xy_global=False, z_global=False)
    origin: dict[str, Any] = {
        "xy_global": True,
        "z_global": True,
        "ref_lat": 47.397744,
        "ref_lon": 8.545594,
        "ref_alt": 488.0,
    }
    reported = flight.wait(0.1).send(**origin, ref_timestamp=1)
    assert [event.kind for event in reported if event.kind.startswith("origin")] == ["origin_set"]
    for stamp in range(2, 20):
        assert flight.wait(0.1).send(**origin, ref_timestamp=stamp) == []
    assert flight.wait(0.1).send(**origin | {"ref_alt": 488.005}, ref_timestamp=20) == []
    moved = flight.wait(0.1).send(**origin | {"ref_lat": 47.397754}, ref_timestamp=21)
    assert [event.kind for event in moved] == ["origin_moved"]
    assert moved[0].numbers["distance"] == pytest.approx(1.112, abs=1e-3)


def test_motion_unexplained_by_velocity_is_a_jump(flight: Flight) -> None:
    """Motion that the velocity does not explain is one jump, even over several messages, reported when it ends."""
    for step in range(1, 20):
        assert flight.wait(0.1).send(x=2.0 * step, vx=20.0) == []
    flight = Flight()
    flight.send()
    begin = flight.now - flight.booted
    assert flight.wait(0.1).send(x=10.0, y=-10.0) == []
    assert flight.wait(0.1).send(x=30.0, y=-30.0) == []
    reported = flight.wait(0.1).send(x=30.0, y=-30.0)
    assert brief(reported) == [("jump", "once", "watch")]
    assert reported[0].numbers == pytest.approx(
        {"distance": math.hypot(30, 30), "north": 30.0, "east": -30.0, "begin": begin}
    )


@pytest.mark.parametrize(("before", "after"), [(12.0, 0.0), (0.0, 12.0)])
def test_motion_at_the_mean_velocity_is_not_a_jump(
    flight: Flight, before: float, after: float
) -> None:
    """A vehicle that brakes or accelerates hard between two messages moves at the mean of both velocities."""
    flight.wait(0.1).send(vx=before, vy=-before)
    assert flight.wait(0.5).send(x=3.0, y=-3.0, vx=after, vy=-after) == []
    assert flight.wait(0.1).send(x=3.0, y=-3.0, vx=after, vy=-after) == []


def test_jump_with_reset_counter_is_a_reset(flight: Flight) -> None:
    """A jump with a change of the reset counter is reported as a reset with its size, not as a jump."""
    reported = flight.wait(0.1).send(
        x=30.0, z=-4.0, xy_reset_counter=1, z_reset_counter=1, delta_xy=(30.0, 0.0), delta_z=-4.0
    )
    assert brief(reported) == [("reset", "once", "watch")]
    assert reported[0].names == ("xy", "z")
    assert reported[0].numbers == pytest.approx({"north": 30.0, "east": 0.0, "up": 4.0}, abs=1e-3)
    assert (
        flight.wait(0.1).send(
            x=30.0, z=-4.0, xy_reset_counter=1, z_reset_counter=1, delta_xy=(30.0, 0.0)
        )
        == []
    )


def test_single_wild_position_is_no_jump(flight: Flight) -> None:
    """One position far away among others that agree is no jump, unlike a position that stays there."""
    flight.wait(0.1).send(x=500.0)
    assert flight.fly(1) == []
    for _ in range(3):
        flight.wait(0.1).send(x=50.0)
    assert [each.kind for each in flight.event_log.events] == ["jump"]


@pytest.mark.parametrize(
    ("seconds", "fields", "size"),
    [
        (
            0.1,
            {"z": -10.0, "z_reset_counter": 1, "delta_z": -6.0},
            "height by 10.0 m",
        ),  # the data contradicts the delta
        # an origin is set
        (0.1, {"z": 0.0, "z_reset_counter": 1, "delta_z": -489.6}, "height by 0.0 m"),
        (
            0.1,
            {"z": -12.0, "vz": -20.0, "z_reset_counter": 1, "delta_z": -10.2},
            "height by 11.0 m",
        ),  # minus the motion at the mean velocity
        (0.1, {"z": -12.0, "z_reset_counter": 1, "delta_z": math.nan}, "height by 12.0 m"),
        (
            0.1,
            {"x": 3.0, "y": 4.0, "xy_reset_counter": 2, "delta_xy": (1.0, 0.0)},
            "xy by 5.0 m (3.0 north, 4.0 east)",
        ),
        (
            2.0,
            {"x": 3.0, "y": 4.0, "xy_reset_counter": 2, "delta_xy": (1.0, 0.0)},
            "xy by 5.0 m (3.0 north, 4.0 east)",
        ),
        # minus the motion
        (2.0, {"x": 7.0, "vx": 2.0, "xy_reset_counter": 2}, "xy by 5.0 m (5.0 north, 0.0 east)"),
        (
            3.5,
            {"x": 3.0, "y": 4.0, "xy_reset_counter": 2, "delta_xy": (1.0, 0.0)},
            "xy by an unknown amount",
        ),
        # its rate is unknown
        (2.0, {"heading": 3.0, "heading_reset_counter": 2}, "heading by an unknown amount"),
        (
            2.0,
            {"x": 6.0, "xy_reset_counter": 1, "delta_xy": (3.0, 0.0)},
            "xy by 3.0 m (3.0 north, 0.0 east)",
        ),
        (
            2.0,
            {"x": 8.0, "xy_reset_counter": 1, "delta_xy": (3.0, 0.0)},
            "xy by 8.0 m (8.0 north, 0.0 east)",
        ),
        (
            0.5,
            {"x": 9.0, "vx": 8.0, "xy_reset_counter": 1, "delta_xy": (3.0, 0.0)},
            "xy by 3.0 m (3.0 north, 0.0 east)",
        ),
        (0.1, {"vz": -3.0, "vz_reset_counter": 1, "delta_vz": -3.0}, "vz by 3.0 m/s"),
        (
            0.1,
            {"heading": 3.0, "heading_reset_counter": 1, "delta_heading": 1.0},
            "heading by 172 deg",
        ),
        (0.1, {"xy_valid": False, "x": math.nan, "xy_reset_counter": 2}, "xy by an unknown amount"),
    ],
)
def test_reset_size_is_delta_or_observed_step(
    flight: Flight, seconds: float, fields: dict[str, Any], size: str
) -> None:
    """The size of a reset is its delta if the samples before and after it agree with the delta.

    Otherwise it is their difference minus the motion, or unknown if they are too far apart in time.
    """
    reset = next(each for each in flight.wait(seconds).send(**fields) if each.kind == "reset")
    assert reset.text == f"reset of {size}"


def test_reset_counter_wraps_from_255_to_0(flight: Flight) -> None:
    """PX4's reset counters are uint8: a step from 255 to 0 is one reset, whose size is its delta."""
    flight.wait(0.1).send(xy_reset_counter=255)
    wrapped = flight.wait(2.0).send(x=6.0, xy_reset_counter=0, delta_xy=(3.0, 0.0))
    assert [each.text for each in wrapped] == ["reset of xy by 3.0 m (3.0 north, 0.0 east)"]


def test_missing_fields_are_neither_a_reset_nor_an_origin(flight: Flight) -> None:
    """Where messages change between streamed and converted ones, missing counters and origins are no events."""
    counters: dict[str, Any] = dict.fromkeys(RESET_COUNTERS.values(), 3)
    flight.send(**counters)
    reported = []
    for _ in range(3):
        reported += flight.wait(0.1).send(
            missing=[*counters, "xy_global", "z_global", "ref_lat", "ref_lon"]
        )
        reported += flight.wait(0.1).send(**counters)
    assert reported == []


def test_flapping_flag_is_reported_after_it_settles(flight: Flight) -> None:
    """After four changes in 10 s, only the last is reported, 5 s later and with the number of suppressed changes."""
    reported, times = [], []
    for index in range(21):
        reported += flight.wait(0.2).send(xy_valid=index % 2 == 1)
        times.append(flight.now)
        reported += flight.update()
    assert [event.time for event in reported] == times[:4]
    assert flight.kinds == ["xy_invalid"]  # the state is never suppressed
    for _ in range(60):
        reported += flight.wait(0.1).send(xy_valid=False)
        reported += flight.update()
    assert [event.time for event in reported[4:]] == [times[-1]]
    assert reported[-1].text == "xy not valid, the last of 17 suppressed changes"
    assert reported[-1].change == "begin"


def test_flapping_combinations_of_flags_are_suppressed(flight: Flight) -> None:
    """If flags of one kind keep changing in new combinations, twenty changes are reported, then the settled state."""
    names = list(KINDS["failsafe_flag"].flags)[:8]
    flags: dict[str, Any] = dict.fromkeys(names, False)
    reported = flight.send("failsafe_flags", **flags)
    for number in range(1, 256):
        gray = number ^ number >> 3
        flags |= {name: bool(gray >> bit & 1) for bit, name in enumerate(names)}
        reported += flight.wait(0.1).send("failsafe_flags", **flags)
        reported += flight.update()
    assert KIND_CHANGES <= len(reported) < 2 * KIND_CHANGES
    reported += flight.wait(PAUSE + 0.1).update()
    assert "suppressed changes" in reported[-1].text
    assert len(reported) < 2 * KIND_CHANGES


def test_flapping_of_one_kind_does_not_suppress_another(flight: Flight) -> None:
    """Changes are counted separately for each kind, so flapping of one kind does not suppress another."""
    for index in range(20):
        flight.wait(0.1).send(xy_valid=index % 2 == 1)
    assert brief(flight.wait(0.1).send(z_valid=False)) == [("z_invalid", "begin", "bad")]


def test_evidence_is_at_most_10_s_old(flight: Flight) -> None:
    """Events of related kinds up to 10 s before are evidence; older and unrelated events are not."""
    flight.gps()
    flight.gps(jamming_indicator=100)
    flight.gps()
    flight.send("vehicle_land_detected", landed=False)
    flight.send("vehicle_land_detected", landed=True)
    flight.fly(WINDOW - 0.5)
    flight.gps(fix_type=0, satellites_used=3)
    near = flight.wait(0.1).send(xy_valid=False)
    assert [each.kind for each in near[0].evidence] == ["jamming", "gps_fix_lost", "few_satellites"]
    assert all(each.time <= near[0].time for each in near[0].evidence)
    flight.gps(fix_type=0, spoofing_state=2)
    flight.wait(0.1).send()
    flight.gps()
    flight.fly(WINDOW + 0.5)
    far = flight.wait(0.1).send(xy_valid=False)
    assert far[0].evidence == ()


def test_active_condition_is_evidence(flight: Flight) -> None:
    """An active condition is evidence, however long ago it began."""
    flight.gps()
    flight.gps(fix_type=0)
    flight.fly(10 * WINDOW)
    reported = flight.wait(0.1).send(dead_reckoning=True)
    assert [each.kind for each in reported[0].evidence] == ["gps_fix_lost"]


def test_events_of_other_vehicles_are_not_evidence(flight: Flight) -> None:
    """Events of other vehicles are not evidence."""
    flight.send("vehicle_gps_position", vehicle="2", **GOOD_GPS)
    flight.send("vehicle_gps_position", vehicle="2", **GOOD_GPS | {"fix_type": 0})
    assert flight.wait(0.1).send(xy_valid=False)[0].evidence == ()


def test_evidence_is_not_nested(flight: Flight) -> None:
    """Events listed as evidence omit their own evidence, so that chains do not grow."""
    flight.gps()
    flight.gps(fix_type=0)
    flight.wait(0.1).send(dead_reckoning=True)
    reported = flight.wait(0.1).send(dead_reckoning=True, xy_valid=False)
    assert [each.kind for each in reported[0].evidence] == ["gps_fix_lost", "dead_reckoning"]
    assert all(each.evidence == () for each in reported[0].evidence)


def test_state_lists_the_worst_condition_first(flight: Flight) -> None:
    """Conditions of severity "bad" precede "watch"; a single "watch" event affects the state for a minute."""
    flight.wait(0.1).send(xy_reset_counter=1, delta_xy=(5.0, 0.0), x=5.0)
    assert (flight.severity, flight.kinds) == ("watch", ["reset"])
    flight.gps()
    flight.gps(fix_type=0)
    flight.wait(0.1).send(x=5.0, xy_reset_counter=1, xy_valid=False)
    assert (flight.severity, flight.kinds[0]) == ("bad", "xy_invalid")
    flight.wait(0.1).send(x=5.0, xy_reset_counter=1)
    flight.gps()
    assert flight.severity == "watch"
    flight.wait(RECENT - 1)
    assert flight.severity == "watch"
    flight.wait(1.5)
    state = flight.event_log.state("1", flight.now)
    assert (state.severity, state.text, state.since, state.conditions) == ("info", "ok", None, ())
    assert flight.event_log.state("nobody", flight.now).severity == "info"


@pytest.mark.slow
def test_number_of_vehicles_streams_and_events_is_bounded() -> None:
    """An event log keeps the latest 2,000 events, 1,000 vehicles, and 1,000 streams per vehicle."""
    flight = Flight()
    for number in range(1100):
        flight.send(vehicle=f"v{number}")
    assert len(flight.event_log.vehicles) == 1000
    for number in range(1100):
        flight.send(f"unknown_{number}", vehicle="v1")
    known = flight.event_log.vehicles["v1"]
    assert len(known._detectors) <= 1000
    assert len(known.topics) <= 1000
    for number in range(limits.EVENTS + 100):
        flight.wait(0.1).status(DISARMED, vehicle="v2", nav_state=number % 20)
    new, reported = flight.event_log.events_since(0)
    assert (len(new), reported) == (limits.EVENTS, limits.EVENTS + 99)
    assert flight.event_log.events_since(reported - 1) == ([new[-1]], reported)


def update(event_log: EventLog, now: float, *present: str, link: str = "") -> set[str]:
    """Update an event log with these vehicles present; return the remembered vehicles."""
    event_log.update(now, {}, link=link, present=present)
    return set(event_log.vehicles)


def test_vehicle_beyond_limit_replaces_longest_gone_one(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A vehicle beyond the limit is logged once, and has no events until it replaces the longest gone vehicle."""
    flight = Flight()
    for number in range(limits.VEHICLES):
        flight.send(vehicle=f"v{number}")
    for _ in range(3):
        flight.send(vehicle="more")
    event_log = flight.event_log
    assert event_log.state("more", flight.now).text == "no events: more than 1000 vehicles"
    assert (event_log.refused, len(event_log.vehicles), len(caplog.records)) == (
        3,
        limits.VEHICLES,
        1,
    )
    flight.wait(RECENT + 1).send(vehicle="v0")
    flight.send(vehicle="more")
    assert {"v0", "more"} <= event_log.vehicles.keys()
    assert "v1" not in event_log.vehicles
    assert event_log.state("more", flight.now).text == "ok"


def test_gone_vehicle_is_forgotten_after_an_hour() -> None:
    """After an hour without a publisher, with the link up, a vehicle and its counts are forgotten; its events stay."""
    flight = Flight()
    for vehicle in ("here", "gone"):
        flight.send(vehicle=vehicle)
        flight.send(vehicle=vehicle, xy_valid=False)
    event_log, start = flight.event_log, flight.now
    assert update(event_log, start + TIMINGS.forgotten, "here") == {"here", "gone"}
    assert update(event_log, start + TIMINGS.forgotten + 1, link="no link") == {"here", "gone"}
    assert update(event_log, start + 2 * TIMINGS.forgotten, "here") == {"here", "gone"}
    assert update(event_log, start + 2 * TIMINGS.forgotten + 2, "here") == {"here"}
    assert {name for name, _ in event_log.counts} == {ALL, "here"}
    assert [each.vehicle for each in event_log.events if each.kind == "xy_invalid"] == [
        "here",
        "gone",
    ]
    event_log.update(start + 9 * TIMINGS.forgotten, {})  # without vehicles, as for a file
    assert set(event_log.vehicles) == {"here"}


@pytest.mark.long
def test_last_fifty_gone_vehicles_are_remembered() -> None:
    """The last fifty gone vehicles, and all that left within the last minute, are remembered."""
    flight = Flight()
    for number in range(3000):
        flight.wait(2.0).send(vehicle=f"v{number}")
        known = update(flight.event_log, flight.now, f"v{number}")
    assert known == {f"v{number}" for number in range(3000 - limits.GONE_VEHICLES - 31, 3000)}
    assert len(flight.event_log.counts) <= 3 * len(known)


def test_fleet_that_vanishes_at_once_is_remembered() -> None:
    """300 vehicles that vanish together while the link is up are remembered for an hour."""
    flight, fleet = Flight(), [f"v{number}" for number in range(300)]
    for vehicle in fleet:
        flight.send(vehicle=vehicle)
    assert update(flight.event_log, flight.now, *fleet) == set(fleet)
    assert update(flight.event_log, flight.now + TIMINGS.forgotten - 1) == set(fleet)
    assert update(flight.event_log, flight.now + TIMINGS.forgotten + 1) == set()


def test_rejection_reasons_are_not_kept(flight: Flight) -> None:
    """The reasons of ended rejections are discarded, because their number is unlimited."""
    for number in range(200):
        flight.wait(20.0).reject(f"x is {number}")
        flight.wait(6.0).update()
    assert len(flight.event_log.vehicles["1"]._frequency._events) < 5


def test_active_condition_precedes_single_events(flight: Flight) -> None:
    """The state names an active condition, or if there is none the largest single event of the last minute."""
    flight.send()
    flight.wait(1.0).send(xy_reset_counter=1, delta_xy=(20.0, 0.0), x=20.0)
    flight.wait(1.0).send(xy_reset_counter=2, delta_xy=(3.0, 0.0), x=23.0)
    assert flight.event_log.state("1", flight.now).text.startswith("reset of xy by 20.0 m")
    flight.wait(1.0).send(xy_reset_counter=2, x=23.0, dead_reckoning=True)
    assert flight.event_log.state("1", flight.now).text == "dead reckoning"


FLAGS = (
    "xy_valid",
    "z_valid",
    "v_xy_valid",
    "v_z_valid",
    "dead_reckoning",
    "heading_good_for_control",
    "xy_global",
)
ACTIONS: dict[str, tuple[Callable[[Flight, Any], object], st.SearchStrategy[Any]]] = {
    "send": (
        lambda flight, flags: flight.send(
            **dict[str, Any](
                {name: name in flags for name in FLAGS} | {"ref_lat": 1.0, "ref_lon": 1.0}
            )
        ),
        st.sets(st.sampled_from(FLAGS)),
    ),
    "gps": (
        lambda flight, seen: flight.gps(
            fix_type=seen[0], satellites_used=seen[1], jamming_indicator=seen[2]
        ),
        st.tuples(st.integers(0, 6), st.integers(0, 12), st.integers(0, 120)),
    ),
    "status": (
        lambda flight, seen: flight.status(seen[0], failsafe=seen[1]),
        st.tuples(st.sampled_from([DISARMED, ARMED]), st.booleans()),
    ),
    "battery": (Flight.battery, st.integers(0, 3)),
    "reject": (Flight.reject, st.sampled_from("ab")),
    "lose": (lambda flight, count: flight.send(lost=count), st.integers(1, 5)),
    "update": (Flight.update, st.sampled_from([None, "stale", "gone", "ok"])),
    "link": (lambda flight, link: setattr(flight, "link", link), st.sampled_from(["", "no link"])),
    "reboot": (lambda flight, ago: setattr(flight, "booted", flight.now - ago), st.just(0.001)),
    "wait": (Flight.wait, st.floats(0.01, 30.0)),
}
STEPS = st.lists(
    st.one_of([st.tuples(st.just(name), values) for name, (_, values) in ACTIONS.items()]), max_size=60
)  # fmt: skip
OUTLIVING = ("silent", "gone", "rejected", "link_down", "overload")
FLAGGED = ("_invalid", "heading_not_good", "_not_global", "dead_reckoning", "failsafe")


@given(STEPS)
@example(
    [
        ("send", {"xy_valid"}),
        ("send", set()),
        ("lose", 1),
        *[("send", set()), ("send", {"xy_valid"})] * 2,
    ]
)
def test_begin_and_end_events_are_paired(steps: list[tuple[str, Any]]) -> None:
    """For any messages, each end event follows a begin event or, at most once since boot, an initial condition.

    The last event of flapping may repeat an end, if an even number of changes was suppressed.
    No condition ends before it began, its end is info, and evidence precedes the event.
    """
    flight = Flight()
    for name, value in steps:
        ACTIONS[name][0](flight.wait(0.05), value)
    flight.link = ""
    for _ in range(3):  # reports ended flapping and losses
        flight.wait(20.0).update()
    begun: dict[tuple[str, str], Event] = {}
    initial: set[tuple[str, str]] = set()  # ended without a begin event, which is possible once
    for event in sorted(flight.event_log.events, key=lambda each: each.time):
        assert event.kind in KINDS
        assert all(each.time <= event.time for each in event.evidence)
        assert event.lasted is None or event.lasted >= 0
        assert event.change != "end" or event.severity == "info"
        assert event.boot is None or math.isfinite(event.boot)
        if event.kind == "reboot":
            begun = {key: each for key, each in begun.items() if key[0] in OUTLIVING}
            initial.clear()
        for name in event.names if event.kind.endswith(FLAGGED) else ("",):
            key = event.kind, name
            if event.change == "begin":
                begun[key] = event
            elif event.change == "end":
                known = begun.pop(key, None)
                suppressed = re.search(r"the last of (\d+) suppressed changes$", event.text)
                is_repeated = suppressed is not None and int(suppressed[1]) % 2 == 0
                assert (
                    known is not None
                    or is_repeated
                    or (key not in initial and event.lasted is None)
                )
                initial |= {key} if known is None else set()


def fly_with_gps(
    flight: Flight, seconds: float, *, rate: float = 5.0, topic: str = "vehicle_gps_position"
) -> None:
    """Send positions at 10 Hz, and GPS messages at `rate` Hz, 0 for none; update twice a second."""
    for index in range(round(10 * seconds)):
        flight.wait(0.1).send()
        if rate and index % round(10 / rate) == 0:
            flight.send(topic, **GOOD_GPS)
        if index % 5 == 0:
            flight.update()


def no_messages(flight: Flight) -> list[tuple[str, str, float]]:
    found = [each for each in flight.event_log.events if each.kind == "no_messages"]
    return [(each.change, each.text, round(flight.now - each.time)) for each in found]


def test_gps_without_messages_is_a_condition_until_it_resumes(flight: Flight) -> None:
    """A GPS without a message for 4 s, while positions arrive, is a condition that began at its last message."""
    fly_with_gps(flight, 10)
    fly_with_gps(flight, 3.5, rate=0)
    assert no_messages(flight) == []
    fly_with_gps(flight, 1.5, rate=0)
    assert no_messages(flight) == [("begin", "no GPS message", 5)]
    assert flight.kinds == ["no_messages"]
    fly_with_gps(flight, 1)
    assert no_messages(flight)[1][:2] == ("end", "GPS messages resumed after 5.1 s")
    assert flight.severity == "info"


def test_silence_of_a_topic_follows_its_rate(flight: Flight) -> None:
    """A GPS with a message every 5 s is silent after 15 s without one, and one second for a replacement."""
    fly_with_gps(flight, 40, rate=0.2)
    fly_with_gps(flight, 10, rate=0)
    assert no_messages(flight) == []
    fly_with_gps(flight, 3, rate=0)
    assert no_messages(flight) == [("begin", "no GPS message", 18)]


def test_other_gps_topic_replaces_a_silent_one(flight: Flight) -> None:
    """If `vehicle_gps_position` stops, events come from `sensor_gps`, and from the former again once it resumes."""
    for _ in range(50):
        flight.send("sensor_gps", instance=0, **GOOD_GPS)
        fly_with_gps(flight, 0.2)
    for _ in range(50):
        fly_with_gps(flight, 0.2, topic="sensor_gps")
    assert no_messages(flight) == []
    assert flight.kinds == []
    flight.new_events()
    flight.send("sensor_gps", instance=0, **GOOD_GPS | {"fix_type": 0})
    assert brief(flight.new_events() or flight.event_log.events[-1:]) == [
        ("gps_fix_lost", "begin", "watch")
    ]
    flight.gps()
    flight.send("sensor_gps", instance=0, **GOOD_GPS | {"fix_type": 0})
    assert flight.kinds == []


def test_pause_of_all_messages_is_the_silence_of_no_topic(flight: Flight) -> None:
    """After a pause of the link, the first position does not make topics silent whose messages follow it."""
    fly_with_gps(flight, 10)
    flight.wait(20).send()
    for _ in range(4):
        flight.wait(0.5).send()
        flight.update()
    fly_with_gps(flight, 2)
    assert no_messages(flight) == []


def test_single_wild_timestamp_makes_no_topic_silent(flight: Flight) -> None:
    """One position or GPS message with a wild timestamp does not make the GPS silent."""
    fly_with_gps(flight, 10)
    for topic, seconds in ((POSITION.topic, 60.0), ("vehicle_gps_position", -60.0)):
        flight.booted -= seconds
        flight.send(topic, **GOOD_GPS if topic != POSITION.topic else {})
        flight.booted += seconds
        flight.update()
        fly_with_gps(flight, 2)
    assert no_messages(flight) == []


def test_equal_single_events_are_suppressed_after_ten() -> None:
    """Of alike resets, and of equal texts, ten in ten seconds are reported, then the last one with their number."""
    flight = Flight()
    flight.send()
    texts, resets = list[Event](), list[Event]()
    for number in range(1, 60):
        flight.wait(0.1)
        texts += flight.send(
            "log_message", severity=2, text="ODOMETRY: unsupported estimator_type 8"
        )
        resets += flight.send(xy_reset_counter=number)
    assert [len(texts), len(resets)] == [10, 10]
    other = flight.send("log_message", severity=2, text="Engine on fire")
    assert [event.text for event in other] == ["Engine on fire"]
    last = flight.wait(PAUSE + 0.1).update()
    assert [event.words for event in last if event.kind == "text"] == [
        'PX4: "ODOMETRY: unsupported estimator_type 8", the last of 49 suppressed texts'
    ]
    [reset] = [event for event in last if event.kind == "reset"]
    assert reset.text.endswith(", the last of 49 suppressed changes")


def test_overload_names_who_is_overloaded() -> None:
    """A reader's own overload, and that of the service with the vehicle's link, have different texts."""
    for event_log, name in ((EventLog(), "reader"), (EventLog(reader="service"), "service")):
        event_log.update(1.0, {}, is_behind=True)
        event_log.update(10.0, {})
        assert [event.text for event in event_log.events] == [
            f"{name} overloaded: messages are delayed or dropped",
            f"messages dropped so far: 0; {name} caught up after 0 ms",
        ]  # fmt: skip


def test_estimated_losses_are_labelled() -> None:
    """Losses of a ULog stream are an estimate, of no topic in particular; those of a key are exact."""
    flight = Flight()
    flight.send()
    address = Address("1", "vehicle_attitude")
    for is_estimate, text in (
        (True, "about 7 messages lost (the ULog stream)"),
        (False, "7 messages lost (vehicle_attitude)"),
    ):
        flight.event_log.add(address, {"timestamp": 1}, flight.now, lost=7, is_estimate=is_estimate)
        assert [event.text for event in flight.wait(PAUSE + 0.1).update()] == [text]


def test_transition_of_a_vtol_is_an_event_and_evidence() -> None:
    """A VTOL's transition and the vehicle type that it changes are info, and evidence for what happens meanwhile."""
    flight = Flight()
    flight.send()

    def status(**fields: Any) -> list[Event]:
        return flight.wait(1.0).status(
            ARMED, **{"in_transition_mode": False, "vehicle_type": 1} | fields
        )

    status()
    begun = status(in_transition_mode=True, in_transition_to_fw=True)
    assert [(event.severity, event.text) for event in begun] == [
        ("info", "VTOL transition to fixed wing")
    ]
    [lost] = flight.wait(1.0).send(xy_valid=False)
    assert [event.text for event in lost.evidence] == ["VTOL transition to fixed wing"]
    ended = status(vehicle_type=2)
    assert [event.text for event in ended] == [
        "VTOL transition ended after 2.0 s", "vehicle type changed from rotary wing to fixed wing",
    ]  # fmt: skip
    [back] = status(vehicle_type=2, in_transition_mode=True, in_transition_to_fw=False)
    assert back.text == "VTOL transition to rotary wing"


AID = "estimator_aid_src_ev_pos"


def test_rejected_and_unused_measurements_are_conditions() -> None:
    """A measurement that the EKF does not fuse for half a second begins a condition, which fusion or silence ends."""
    flight = Flight()
    flight.status(ARMED)

    def send(seconds: float, *, fused: bool, rejected: bool = False) -> list[tuple[str, str, str]]:
        reported: list[Event] = []
        for _ in range(round(seconds * 10)):
            flight.wait(0.1).send()
            reported += flight.send(
                AID, instance=0, fused=fused, innovation_rejected=rejected, estimator_instance=0
            )
        return [(event.change, event.severity, event.text) for event in reported]

    assert send(3, fused=True) == send(0.3, fused=False, rejected=True) == send(3, fused=True) == []
    assert send(2, fused=False, rejected=True) == [
        ("begin", "watch", "EKF rejects vision position")
    ]
    assert flight.kinds == ["aid_rejected"]
    [ended] = send(2, fused=True)
    assert ended == ("end", "info", "EKF accepts vision position again after 2.0 s")
    assert send(2, fused=False) == [
        ("begin", "info", "EKF receives vision position, but does not fuse it")
    ]
    reported: list[Event] = []
    for _ in range(20):
        flight.wait(0.1).send()
        reported += flight.update()
    assert [event.text for event in reported] == [
        "EKF no longer receives vision position after 1.9 s"
    ]


@pytest.mark.parametrize(("state", "severity"), [(ARMED, "watch"), (DISARMED, "info")])
def test_vision_that_stops_is_a_condition_until_it_resumes(state: int, severity: str) -> None:
    """Vision of which no message arrives for a second is a condition that began at its last message."""
    flight = Flight()
    flight.status(state)

    def fly(seconds: float, *, with_vision: bool) -> list[tuple[str, str, float]]:
        reported: list[Event] = []
        for _ in range(round(seconds * 10)):
            flight.wait(0.1).send()
            if with_vision:
                reported += flight.send("vehicle_visual_odometry")
            reported += flight.update()
        return [
            (event.text, event.severity, round(flight.now - event.time, 1)) for event in reported
        ]

    assert (
        fly(3, with_vision=False) == fly(3, with_vision=True) == fly(0.9, with_vision=False) == []
    )
    assert fly(0.5, with_vision=False) == [("no vision message", severity, 1.4)]
    [resumed] = fly(0.1, with_vision=True)
    assert resumed[:2] == ("vision messages resumed after 1.5 s", "info")
    assert fly(2, with_vision=True) == []


def test_measurement_of_another_ekf_is_ignored() -> None:
    """Only the primary EKF's measurements count."""
    flight = Flight()
    for _ in range(30):
        flight.wait(0.1).send()
        flight.send(AID, instance=1, fused=False, innovation_rejected=True, estimator_instance=1)
    assert flight.new_events() == []
    assert flight.kinds == []


def test_vehicle_with_few_events_loses_none_to_make_room_for_others() -> None:
    """At the limit, the vehicle with the most events loses its oldest; if none has over 20, the oldest of all goes."""
    event_log = EventLog(keep=45)

    def add(vehicle: str, count: int, begin: float) -> None:
        for number in range(2 * count):
            fields = VALID | {"xy_valid": number % 2 == 0}
            address = Address(vehicle, POSITION.topic)
            stamp = begin + 60.0 * number  # slow enough that no change is suppressed
            event_log.add(address, {"timestamp": round(stamp * 1e6), **fields}, stamp)

    add("old", 8, 100.0)
    add("other", 10, 200.0)
    add("third", 8, 300.0)
    kept = Counter(event.vehicle for event in event_log.events)
    assert kept == {"old": 45 - 19 - 15, "other": 19, "third": 15}  # none has more than 20
    add("busy", 30, 400.0)
    kept = Counter(event.vehicle for event in event_log.events)
    assert kept["busy"] == 20
    assert kept.total() == 45
