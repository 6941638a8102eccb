"""Events of an event log, from hand-made messages."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import example, given

from nedbus.events import (
    ALL,
    KEPT,
    KINDS,
    MAX_VEHICLES,
    RECENT,
    WINDOW,
    Event,
    EventLog,
)
from nedbus.events.event_log import MAX_GONE
from nedbus.events.rules import FLAPPING_CHANGES, PAUSE
from nedbus.timings import TIMINGS
from nedbus_msgs import Address
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


def test_first_message_is_no_event() -> None:
    """Conditions of the first message are states without an event, until they end."""
    flight = Flight()
    assert flight.send(xy_valid=False, dead_reckoning=True) == []
    assert (flight.severity, flight.kinds) == ("bad", ["xy_invalid", "dead_reckoning"])
    ended = flight.wait(0.1).send()
    assert [(event.text, event.lasted) for event in ended] == [
        ("xy valid for the first time", None), ("dead reckoning ended", None),
    ]  # fmt: skip
    assert (flight.severity, flight.kinds) == ("info", [])


@pytest.mark.parametrize("kind", ["xy", "z", "v_xy", "v_z"])
def test_validity_begins_and_ends(flight: Flight, kind: str) -> None:
    """A flag of the position is bad from the message that clears it to the message that sets it."""
    begun = flight.wait(0.1).send(**dict[str, Any]({f"{kind}_valid": False}))
    assert brief(begun) == [(f"{kind}_invalid", "begin", "bad")]
    ended = flight.wait(2.5).send()
    assert brief(ended) == [(f"{kind}_invalid", "end", "info")]
    assert ended[0].lasted == pytest.approx(2.5)
    assert ended[0].text.endswith("valid again after 2.5 s")
    assert ended[0].time == flight.now
    assert ended[0].boot == pytest.approx(flight.now - flight.booted)


def test_reboot_is_reported_once(flight: Flight) -> None:
    """Several streams go back, soon or late; the state is reset, and earlier conditions end without an event."""
    flight.status(ARMED, failsafe=True)
    flight.gps(satellites_used=12)
    flight.wait(0.1).send(xy_valid=False)
    flight.wait(0.1).gps(satellites_used=3)
    assert {"xy_invalid", "few_satellites", "failsafe"} <= set(flight.kinds)
    flight.booted = flight.now
    told = flight.wait(1.0).send()
    assert brief(told) == [("reboot", "once", "bad")]
    assert told[0].text == "reboot: time since boot is 1.0 s, was 10.1 s"
    assert flight.kinds == ["reboot"]
    assert flight.wait(1.0).gps() == []  # neither a second reboot, nor the end of what that receiver had
    flight.fly(20)
    assert flight.status(DISARMED) == []
    assert [each.kind for each in flight.event_log.events].count("reboot") == 1


def test_stream_that_returns_long_after_a_reboot(flight: Flight) -> None:
    """Streams that go back later belong to the same reboot, in any order, and the state is kept."""
    streams: list[Callable[[], list[Event]]] = [flight.send, flight.gps, lambda: flight.status(ARMED)]
    for first in range(3):
        flight.wait(1000.0)
        for send in streams:
            send()
        flight.take()
        flight.booted = flight.now
        told = []
        for index in range(3):
            flight.wait(8.0)
            told += streams[(first + index) % 3]()
        assert [each.kind for each in told if each.kind not in ("silent", "gone")] == ["reboot"]
        assert flight.event_log.vehicles["1"].armed is True


def test_late_message_from_before_a_reboot_is_no_reboot(flight: Flight) -> None:
    """Streams are not ordered among each other: an old message that arrives late is no reboot."""
    flight.gps()
    flight.booted, before = flight.now, flight.booted
    assert brief(flight.wait(0.1).send()) == [("reboot", "once", "bad")]
    flight.booted, after = before, flight.booted
    assert flight.wait(0.1).gps() == []
    flight.booted = after
    assert flight.wait(0.1).gps() == []


def test_disorder_is_no_reboot(flight: Flight) -> None:
    """A time that goes back by up to a second is a reordered message."""
    flight.wait(5.0).send()
    flight.booted += 1.0
    assert flight.send() == []


def test_silence_is_reported_by_updates(flight: Flight) -> None:
    """A vehicle is silent since its last position, gone with its publisher, and back with the next position."""
    flight.fly(1)
    last = flight.now
    assert flight.wait(2.0).look() == []
    begun = flight.wait(2.0).look("stale")
    assert brief(begun) == [("silent", "begin", "bad")]
    assert begun[0].text == "silent: no vehicle_local_position for 4.0 s"
    assert flight.look("stale") == []
    assert brief(flight.wait(1.0).look("gone")) == [("gone", "begin", "bad")]
    assert flight.event_log.state("1", flight.now).since == last
    assert flight.look("stale") == []  # gone stays gone
    back = flight.wait(1.0).send()
    assert brief(back) == [("gone", "end", "info")]
    assert back[0].lasted == pytest.approx(6.0)
    assert flight.severity == "info"


def test_silence_of_unknown_streams(flight: Flight) -> None:
    """Without stream states, a vehicle is silent after three seconds without a position; other topics do not count."""
    assert flight.wait(2.9).look(None) == []
    flight.gps()
    assert brief(flight.wait(0.2).look(None)) == [("silent", "begin", "bad")]


def test_loss_is_reported_once(flight: Flight) -> None:
    """A burst of losses is one event, with their number, at the time of the first one."""
    flight.wait(1.0).send(lost=2)
    first = flight.now
    flight.wait(1.0).gps()
    flight.wait(1.0).send("vehicle_gps_position", lost=3, **GOOD_GPS)
    assert flight.look() == []
    told = flight.wait(6.0).look()
    assert [(event.text, event.severity, event.time) for event in told] == [
        ("5 messages lost (vehicle_gps_position, vehicle_local_position)", "watch", first)
    ]
    assert flight.wait(6.0).look() == []


def test_continuous_loss_is_reported(flight: Flight) -> None:
    """Continuous losses are reported every twenty seconds, so that the state stays watch."""
    told = []
    for second in range(100):
        flight.wait(1.0).send(lost=1)
        told += flight.look()
        assert second <= 21 or flight.severity == "watch"
    assert [event.numbers["messages"] for event in told] == [22, 22, 22, 22]


def test_rejection_begins_and_ends(flight: Flight) -> None:
    """The first rejected message begins the condition, with its reason; five seconds without one end it."""
    begun = flight.reject("x is NaN")
    assert brief(begun) == [("rejected", "begin", "watch")]
    assert begun[0].text == "vehicle_local_position rejected: x is NaN"
    assert flight.wait(1.0).reject("y is NaN") == []
    last = flight.now
    assert flight.severity == "watch"
    ended = flight.wait(6.0).look()
    assert [(event.kind, event.text, event.time) for event in ended] == [
        ("rejected", "rejections stopped (2 messages) after 1.0 s", last)
    ]
    assert flight.severity == "info"


def test_link_down_excuses_vehicles(flight: Flight) -> None:
    """Without a link no vehicle is silent, and that time does not count; the link is an event of all vehicles."""
    flight.fly(1)
    flight.link = "no link to tcp/host:7447"
    begun = flight.look()
    assert [(event.vehicle, event.text) for event in begun] == [(ALL, "no link to tcp/host:7447")]
    assert flight.wait(60.0).look("disconnected") == []
    flight.link = ""
    ended = flight.wait(60.0).look("unknown")
    assert [(event.vehicle, event.kind, event.change, event.text) for event in ended] == [
        (ALL, "link_down", "end", "link restored after 2 min")
    ]
    assert flight.wait(1.0).send() == []
    assert flight.severity == "info"


def test_message_before_the_update_that_finds_the_link(flight: Flight) -> None:
    """A message that arrives before the link is polled again does not make the vehicle silent."""
    flight.fly(1)
    flight.link = "no link"
    flight.look()
    assert flight.wait(60.0).send() == []
    flight.link = ""
    assert [event.kind for event in flight.look()] == ["link_down"]


def test_vehicle_that_does_not_return_with_the_link(flight: Flight) -> None:
    """A vehicle is silent three seconds after the link is back, with the link as evidence."""
    flight.fly(1)
    flight.link = "no link"
    flight.look()
    flight.link = ""
    assert [event.kind for event in flight.wait(60.0).look("unknown")] == ["link_down"]
    assert flight.wait(2.0).look("unknown") == []
    told = flight.wait(1.5).look("stale")
    assert brief(told) == [("silent", "begin", "bad")]
    assert [each.text for each in told[0].evidence] == ["link restored after 60.0 s"]


def test_link_that_flaps(flight: Flight) -> None:
    """Of more than four changes of the link in ten seconds the last is reported; the state is always current."""
    told = []
    for index in range(9):
        flight.link = "no link" if index % 2 == 0 else ""
        told += flight.wait(0.5).look("unknown")
    assert brief(told) == [("link_down", "begin", "bad"), ("link_down", "end", "info")] * 2
    told = flight.wait(6.0).look("unknown")
    assert [event.text for event in told] == ["no link, the last of 5 suppressed changes"]
    flight.link = ""
    assert brief(flight.wait(10.0).look("unknown")) == [("link_down", "end", "info")]


def test_overload(flight: Flight) -> None:
    """Dropped messages are reported once, with their number after five seconds without a drop."""
    assert flight.look(dropped=0) == []
    begun = flight.look(dropped=10)
    assert [(event.vehicle, event.kind, event.change) for event in begun] == [(ALL, "overload", "begin")]
    flight.fly(2)
    assert flight.look(dropped=25) == []
    flight.fly(4.9)
    assert flight.look(dropped=25) == []
    flight.fly(0.2)
    ended = flight.look(dropped=25)
    assert [(event.change, event.numbers) for event in ended] == [("end", {"messages": 25})]
    assert ended[0].lasted == pytest.approx(2.0)


def test_overload_is_evidence_of_loss(flight: Flight) -> None:
    """A condition of all vehicles is evidence for one of them, however long ago it began."""
    for dropped in range(1, 31):
        flight.fly(1)
        flight.look(dropped=dropped)
    flight.wait(0.1).send(lost=3)
    flight.fly(4.5)
    flight.look(dropped=31)
    flight.fly(1)
    (lost,) = flight.look(dropped=32)
    assert [each.kind for each in lost.evidence] == ["overload"]


def test_battery_warnings(flight: Flight) -> None:
    """Low is watch, critical is bad; the last warning holds until it is 0."""
    assert flight.wait(1.0).battery(0) == []
    assert brief(flight.wait(1.0).battery(1)) == [("battery", "begin", "watch")]
    critical = flight.wait(1.0).battery(2)
    assert brief(critical) == [("battery", "begin", "bad")]
    assert critical[0].text == "battery critical, 20 % left"
    assert flight.severity == "bad"
    assert flight.wait(1.0).battery(2) == []
    assert brief(flight.wait(1.0).battery(0)) == [("battery", "end", "info")]
    assert flight.severity == "info"


def test_receiver(flight: Flight) -> None:
    """Fix, satellites, jamming by indicator or state, and spoofing have hysteresis."""
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


def test_receiver_that_never_had_a_fix(flight: Flight) -> None:
    """Without a fix from the start there is an info state without an event; the first fix is an event."""
    assert flight.gps(fix_type=0, satellites_used=0) == []
    assert flight.severity == "info"
    assert brief(flight.gps()) == [("gps_fix_lost", "end", "info"), ("few_satellites", "end", "info")]


def test_estimator_flags(flight: Flight) -> None:
    """Flags that change in the same way in one message are one event that names them; each one ends by itself."""
    names = ["reject_hor_pos", "reject_hor_vel", "fs_bad_hdg", "cs_baro_fault", "cs_gnss_pos", "cs_baro_hgt"]

    def send(**changed: Any) -> list[Event]:
        return flight.wait(0.1).send("estimator_status_flags", **dict.fromkeys(names, False) | changed)

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
    assert brief(send(fs_bad_hdg=True, cs_baro_fault=True)) == [("estimator_fault", "begin", "watch")]
    assert brief(send(cs_gnss_pos=True, cs_baro_hgt=True))[0] == ("estimator_fault", "end", "info")
    assert brief(send(cs_gnss_pos=True)) == [("not_fused", "begin", "info")]  # another height is fused
    assert brief(send()) == [("not_fused", "begin", "watch")]


def test_flight_without_fix_or_global_reference() -> None:
    """A lack of the first message is no state on the ground; once the vehicle is armed it is one since that message."""
    flight, since = Flight(), 100.0
    assert flight.gps(fix_type=0, satellites_used=0) == flight.send(xy_global=False) == []
    assert flight.wait(1.0).status(DISARMED) == []
    assert (flight.severity, flight.event_log.vehicles["1"].initial[1:]) == (
        "info",
        [],
    )  # few satellites are information
    assert brief(flight.wait(1.0).status(ARMED)) == [("armed", "once", "info")]
    assert flight.wait(PAUSE - 0.1).look() == []
    assert flight.kinds == []
    assert flight.wait(0.2).look() == []
    held = flight.event_log.state("1", flight.now).conditions
    assert [(each.text, each.severity, each.since, each.initial) for each in held] == [
        ("no GPS fix, 0 satellites", "watch", since, True), ("xy has no global reference", "watch", since, True),
    ]  # fmt: skip
    assert set(held) <= set(flight.event_log.vehicles["1"].initial)
    assert brief(flight.gps(satellites_used=0)) == [("gps_fix_lost", "end", "info")]
    flight.wait(1.0).status(DISARMED)
    assert flight.severity == "info"
    flight.booted = flight.now
    flight.wait(1.0).send()
    flight.wait(1.0).status(ARMED)
    flight.wait(PAUSE).look()
    assert flight.kinds == ["reboot"]


def test_fix_before_arming_is_no_state() -> None:
    """Receivers and estimators start without a fix and a global reference."""
    flight = Flight()
    flight.status(DISARMED)
    flight.gps(fix_type=0, satellites_used=0)
    flight.send(xy_global=False, z_global=False)
    flight.wait(5.0).gps()
    flight.send()
    flight.wait(5.0).status(ARMED)
    flight.wait(PAUSE).look()
    assert flight.kinds == []


def test_labels_are_words() -> None:
    """No event shows the name of a field."""
    for kind in KINDS.values():
        for name, label in kind.flags.items():
            assert "_" not in label
            assert not re.match(r"(fd|cs|fs|reject) |.*relaxed$", label), name


def test_on_the_ground(flight: Flight) -> None:
    """Faults of sensors and links are info while the vehicle is disarmed."""
    flight.status(DISARMED, gcs_connection_lost=False)
    assert brief(flight.wait(0.1).status(DISARMED, gcs_connection_lost=True)) == [("gcs_lost", "begin", "info")]
    assert brief(flight.wait(0.1).status(ARMED, gcs_connection_lost=True)) == [("armed", "once", "info")]
    flight.wait(0.1).status(ARMED, gcs_connection_lost=False)
    assert brief(flight.wait(0.1).status(ARMED, gcs_connection_lost=True)) == [("gcs_lost", "begin", "watch")]
    assert flight.severity == "watch"
    flight.wait(0.1).status(DISARMED, gcs_connection_lost=True)
    assert flight.severity == "info"


def test_missing_flag_is_no_event() -> None:
    """A field that the source does not provide is neither valid nor invalid, whatever its value."""
    flight = Flight()
    missing = ("z_valid", "v_z_valid", "heading_good_for_control", "dist_bottom_valid", "dead_reckoning")
    flight.send(missing=missing, z_valid=False, v_z_valid=False, dead_reckoning=True)
    assert flight.kinds == []
    assert flight.wait(0.1).send(missing=missing, heading_good_for_control=True) == []
    told = flight.wait(0.1).send(missing=missing, xy_valid=False, z_valid=False, v_z_valid=False)
    assert brief(told) == [("xy_invalid", "begin", "bad")]


@pytest.mark.parametrize(
    ("topic", "instance"),
    [
        ("vehicle_local_position_groundtruth", None), ("estimator_local_position", 1), ("estimator_local_position", 0),
    ],
)  # fmt: skip
def test_other_estimates_are_not_used(flight: Flight, topic: str, instance: int | None) -> None:
    """A second EKF and the ground truth make no events, and change no state."""
    fields = message(1, **VALID).model_dump() | {"xy_valid": False, "dead_reckoning": True, "x": 500.0}
    for step in range(5):
        fields["timestamp"] = 100 - step
        assert flight.wait(0.1).send(topic, instance=instance, **fields) == []
        assert flight.send() == []
    assert flight.severity == "info"
    assert flight.event_log.vehicles["1"].main == POSITION


def test_other_estimate_is_used_if_it_is_the_only_one() -> None:
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


def test_second_receiver_and_battery_are_not_used(flight: Flight) -> None:
    """Of several sensors instance 0 is used, and vehicle_gps_position is preferred to any single receiver."""
    flight.send("sensor_gps", instance=0, **GOOD_GPS)
    assert flight.send("sensor_gps", instance=1, **GOOD_GPS | {"fix_type": 0}) == []
    assert flight.send("battery_status", instance=1, warning=3, remaining=0.0, connected=True) == []
    assert flight.gps() == []
    assert flight.send("sensor_gps", instance=0, **GOOD_GPS | {"fix_type": 0}) == []
    assert brief(flight.gps(fix_type=0)) == [("gps_fix_lost", "begin", "watch")]
    assert flight.severity == "watch"


def test_origin_that_only_has_a_new_time() -> None:
    """An origin is set once, and moves by a centimetre or more; a new ref_timestamp alone is ignored."""
    flight = Flight()
    flight.send(xy_global=False, z_global=False)
    origin: dict[str, Any] = {
        "xy_global": True,
        "z_global": True,
        "ref_lat": 47.397744,
        "ref_lon": 8.545594,
        "ref_alt": 488.0,
    }
    told = flight.wait(0.1).send(**origin, ref_timestamp=1)
    assert [event.kind for event in told if event.kind.startswith("origin")] == ["origin_set"]
    for stamp in range(2, 20):
        assert flight.wait(0.1).send(**origin, ref_timestamp=stamp) == []
    assert flight.wait(0.1).send(**origin | {"ref_alt": 488.005}, ref_timestamp=20) == []
    moved = flight.wait(0.1).send(**origin | {"ref_lat": 47.397754}, ref_timestamp=21)
    assert [event.kind for event in moved] == ["origin_moved"]
    assert moved[0].numbers["distance"] == pytest.approx(1.112, abs=1e-3)


def test_jump_is_what_velocity_does_not_explain(flight: Flight) -> None:
    """A position that moves over several messages is one jump, reported when it ends; flying is none."""
    for step in range(1, 20):
        assert flight.wait(0.1).send(x=2.0 * step, vx=20.0) == []
    flight = Flight()
    flight.send()
    begin = flight.now - flight.booted
    assert flight.wait(0.1).send(x=10.0, y=-10.0) == []
    assert flight.wait(0.1).send(x=30.0, y=-30.0) == []
    told = flight.wait(0.1).send(x=30.0, y=-30.0)
    assert brief(told) == [("jump", "once", "watch")]
    assert told[0].numbers == pytest.approx(
        {"distance": math.hypot(30, 30), "north": 30.0, "east": -30.0, "begin": begin}
    )


def test_jump_that_is_a_reset(flight: Flight) -> None:
    """A reset reported by the estimator is a reset with its size, and not a jump."""
    told = flight.wait(0.1).send(
        x=30.0, z=-4.0, xy_reset_counter=1, z_reset_counter=1, delta_xy=(30.0, 0.0), delta_z=-4.0
    )
    assert brief(told) == [("reset", "once", "watch")]
    assert told[0].names == ("xy", "z")
    assert told[0].numbers == pytest.approx({"north": 30.0, "east": 0.0, "up": 4.0}, abs=1e-3)
    assert flight.wait(0.1).send(x=30.0, z=-4.0, xy_reset_counter=1, z_reset_counter=1, delta_xy=(30.0, 0.0)) == []


@pytest.mark.parametrize(
    ("seconds", "fields", "size"),
    [
        (0.1, {"z": -10.0, "z_reset_counter": 1, "delta_z": -6.0}, "height by 10.0 m"),  # the delta is not in the data
        (0.1, {"z": 0.0, "z_reset_counter": 1, "delta_z": -489.6}, "height by 0.0 m"),  # an origin is set
        (0.1, {"z": -12.0, "vz": -20.0, "z_reset_counter": 1, "delta_z": -10.2}, "height by 10.2 m"),  # and motion
        (0.1, {"z": -12.0, "z_reset_counter": 1, "delta_z": math.nan}, "height by 12.0 m"),
        (0.1, {"x": 3.0, "y": 4.0, "xy_reset_counter": 2, "delta_xy": (1.0, 0.0)}, "xy by 5.0 m (3.0 north, 4.0 east)"),
        (2.0, {"x": 3.0, "y": 4.0, "xy_reset_counter": 2, "delta_xy": (1.0, 0.0)}, "xy by an unknown amount"),
        (2.0, {"x": 8.0, "xy_reset_counter": 1, "delta_xy": (3.0, 0.0)}, "xy by 3.0 m (3.0 north, 0.0 east)"),
        (0.1, {"heading": 3.0, "heading_reset_counter": 1, "delta_heading": 1.0}, "heading by 172 deg"),
        (0.1, {"xy_valid": False, "x": math.nan, "xy_reset_counter": 2}, "xy by an unknown amount"),
    ],
)
def test_size_of_a_reset_is_the_step_in_the_data(
    flight: Flight, seconds: float, fields: dict[str, Any], size: str
) -> None:
    """It is the delta where the two samples agree with it, else their difference without motion, if they are near."""
    reset = next(each for each in flight.wait(seconds).send(**fields) if each.kind == "reset")
    assert reset.text == f"reset of {size}"


def test_flapping_is_reported_when_it_ends(flight: Flight) -> None:
    """Of more than four changes in ten seconds the last is reported after five seconds, with their number."""
    told, times = [], []
    for index in range(21):
        told += flight.wait(0.2).send(xy_valid=index % 2 == 1)
        times.append(flight.now)
        told += flight.look()
    assert [event.time for event in told] == times[:4]
    assert flight.kinds == ["xy_invalid"]  # the state is always true
    for _ in range(60):
        told += flight.wait(0.1).send(xy_valid=False)
        told += flight.look()
    assert [event.time for event in told[4:]] == [times[-1]]
    assert told[-1].text == "xy not valid, the last of 17 suppressed changes"
    assert told[-1].change == "begin"


def test_flapping_in_combinations_is_suppressed(flight: Flight) -> None:
    """Flags of one kind that change in ever new combinations are reported twenty times, then when they rest."""
    names = list(KINDS["failsafe_flag"].flags)[:8]
    flags: dict[str, Any] = dict.fromkeys(names, False)
    told = flight.send("failsafe_flags", **flags)
    for number in range(1, 256):
        gray = number ^ number >> 3
        flags |= {name: bool(gray >> bit & 1) for bit, name in enumerate(names)}
        told += flight.wait(0.1).send("failsafe_flags", **flags)
        told += flight.look()
    assert FLAPPING_CHANGES[1] <= len(told) < 2 * FLAPPING_CHANGES[1]
    told += flight.wait(PAUSE + 0.1).look()
    assert "suppressed changes" in told[-1].text
    assert len(told) < 2 * FLAPPING_CHANGES[1]


def test_flapping_of_one_is_not_of_another(flight: Flight) -> None:
    """Each kind of condition is counted separately."""
    for index in range(20):
        flight.wait(0.1).send(xy_valid=index % 2 == 1)
    assert brief(flight.wait(0.1).send(z_valid=False)) == [("z_invalid", "begin", "bad")]


def test_evidence_is_from_the_window(flight: Flight) -> None:
    """Events up to ten seconds before are evidence; later ones, or ones of unrelated kinds, are not."""
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


def test_evidence_that_goes_on(flight: Flight) -> None:
    """An active condition is evidence, however long ago it began."""
    flight.gps()
    flight.gps(fix_type=0)
    flight.fly(10 * WINDOW)
    told = flight.wait(0.1).send(dead_reckoning=True)
    assert [each.kind for each in told[0].evidence] == ["gps_fix_lost"]


def test_evidence_of_others_does_not_count(flight: Flight) -> None:
    """Events of other vehicles are no evidence."""
    flight.send("vehicle_gps_position", vehicle="2", **GOOD_GPS)
    flight.send("vehicle_gps_position", vehicle="2", **GOOD_GPS | {"fix_type": 0})
    assert flight.wait(0.1).send(xy_valid=False)[0].evidence == ()


def test_evidence_has_none_of_its_own(flight: Flight) -> None:
    """Evidence has no evidence of its own, so chains do not grow."""
    flight.gps()
    flight.gps(fix_type=0)
    flight.wait(0.1).send(dead_reckoning=True)
    told = flight.wait(0.1).send(dead_reckoning=True, xy_valid=False)
    assert [each.kind for each in told[0].evidence] == ["gps_fix_lost", "dead_reckoning"]
    assert all(each.evidence == () for each in told[0].evidence)


def test_state_is_worst_first(flight: Flight) -> None:
    """Bad is shown before watch; a single event of severity watch counts for a minute."""
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


def test_memory_is_bounded() -> None:
    """An event log keeps the most recent events, a thousand vehicles, and a thousand streams per vehicle."""
    flight = Flight()
    for number in range(1100):
        flight.send(vehicle=f"v{number}")
    assert len(flight.event_log.vehicles) == 1000
    for number in range(1100):
        flight.send(f"unknown_{number}", vehicle="v1")
    known = flight.event_log.vehicles["v1"]
    assert len(known._detectors) <= 1000
    assert len(known.topics) <= 1000
    for number in range(KEPT + 100):
        flight.wait(0.1).status(DISARMED, vehicle="v2", nav_state=number % 2)
    new, told = flight.event_log.events_since(0)
    assert (len(new), told) == (KEPT, KEPT + 99)
    assert flight.event_log.events_since(told - 1) == ([new[-1]], told)


def look(event_log: EventLog, now: float, *present: str, link: str = "") -> set[str]:
    """Update an event log of which these vehicles have a publisher; return the vehicles that it follows."""
    event_log.update(now, {}, link=link, present=present)
    return set(event_log.vehicles)


def test_vehicle_beyond_the_limit_is_told_and_gets_the_place_of_one_that_left(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A vehicle too many has no events and says so, once in the log; of those gone, the longest gone makes room."""
    flight = Flight()
    for number in range(MAX_VEHICLES):
        flight.send(vehicle=f"v{number}")
    for _ in range(3):
        flight.send(vehicle="more")
    event_log = flight.event_log
    assert event_log.state("more", flight.now).text == "no events: more than 1000 vehicles"
    assert (event_log.refused, len(event_log.vehicles), len(caplog.records)) == (3, MAX_VEHICLES, 1)
    flight.wait(RECENT + 1).send(vehicle="v0")
    flight.send(vehicle="more")
    assert {"v0", "more"} <= event_log.vehicles.keys()
    assert "v1" not in event_log.vehicles
    assert event_log.state("more", flight.now).text == "ok"


def test_vehicle_that_is_gone_is_forgotten() -> None:
    """After an hour without a publisher and with a link, a vehicle and its counts are forgotten; its events stay."""
    flight = Flight()
    for vehicle in ("here", "gone"):
        flight.send(vehicle=vehicle)
        flight.send(vehicle=vehicle, xy_valid=False)
    event_log, start = flight.event_log, flight.now
    assert look(event_log, start + TIMINGS.forgotten, "here") == {"here", "gone"}
    assert look(event_log, start + TIMINGS.forgotten + 1, link="no link") == {"here", "gone"}
    assert look(event_log, start + 2 * TIMINGS.forgotten, "here") == {"here", "gone"}
    assert look(event_log, start + 2 * TIMINGS.forgotten + 2, "here") == {"here"}
    assert {name for name, _ in event_log.counts} == {ALL, "here"}
    assert [each.vehicle for each in event_log.events if each.kind == "xy_invalid"] == ["here", "gone"]
    event_log.update(start + 9 * TIMINGS.forgotten, {})  # of a file
    assert set(event_log.vehicles) == {"here"}


def test_of_many_that_left_the_last_fifty_are_known() -> None:
    """Vehicles that come and go leave the last fifty behind, and those of the last minute."""
    flight = Flight()
    for number in range(3000):
        flight.wait(2.0).send(vehicle=f"v{number}")
        known = look(flight.event_log, flight.now, f"v{number}")
    assert known == {f"v{number}" for number in range(3000 - MAX_GONE - 31, 3000)}
    assert len(flight.event_log.counts) <= 3 * len(known)


def test_fleet_that_drops_at_once_is_remembered() -> None:
    """Of 300 vehicles that vanish together behind a link that works, none is forgotten before an hour has passed."""
    flight, fleet = Flight(), [f"v{number}" for number in range(300)]
    for vehicle in fleet:
        flight.send(vehicle=vehicle)
    assert look(flight.event_log, flight.now, *fleet) == set(fleet)
    assert look(flight.event_log, flight.now + TIMINGS.forgotten - 1) == set(fleet)
    assert look(flight.event_log, flight.now + TIMINGS.forgotten + 1) == set()


def test_reasons_do_not_fill_the_memory(flight: Flight) -> None:
    """Reasons of ended rejections are not kept, as each one may be different."""
    for number in range(200):
        flight.wait(20.0).reject(f"x is {number}")
        flight.wait(6.0).look()
    assert len(flight.event_log.vehicles["1"]._changes) < 5


def test_state_is_the_current_one(flight: Flight) -> None:
    """An active condition counts before single events of the last minute, and of those the largest."""
    flight.send()
    flight.wait(1.0).send(xy_reset_counter=1, delta_xy=(20.0, 0.0), x=20.0)
    flight.wait(1.0).send(xy_reset_counter=2, delta_xy=(3.0, 0.0), x=23.0)
    assert flight.event_log.state("1", flight.now).text.startswith("reset of xy by 20.0 m")
    flight.wait(1.0).send(xy_reset_counter=2, x=23.0, dead_reckoning=True)
    assert flight.event_log.state("1", flight.now).text == "dead reckoning"


FLAGS = ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid", "dead_reckoning", "heading_good_for_control", "xy_global")
ACTIONS: dict[str, tuple[Callable[[Flight, Any], object], st.SearchStrategy[Any]]] = {
    "send": (
        lambda flight, flags: flight.send(
            **dict[str, Any]({name: name in flags for name in FLAGS} | {"ref_lat": 1.0, "ref_lon": 1.0})
        ),
        st.sets(st.sampled_from(FLAGS)),
    ),
    "gps": (
        lambda flight, seen: flight.gps(fix_type=seen[0], satellites_used=seen[1], jamming_indicator=seen[2]),
        st.tuples(st.integers(0, 6), st.integers(0, 12), st.integers(0, 120)),
    ),
    "status": (
        lambda flight, seen: flight.status(seen[0], failsafe=seen[1]),
        st.tuples(st.sampled_from([DISARMED, ARMED]), st.booleans()),
    ),
    "battery": (Flight.battery, st.integers(0, 3)),
    "reject": (Flight.reject, st.sampled_from("ab")),
    "lose": (lambda flight, count: flight.send(lost=count), st.integers(1, 5)),
    "look": (Flight.look, st.sampled_from([None, "stale", "gone", "ok"])),
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
@example([("send", {"xy_valid"}), ("send", set()), ("lose", 1), *[("send", set()), ("send", {"xy_valid"})] * 2])
def test_events_are_consistent(steps: list[tuple[str, Any]]) -> None:
    """An end follows a begin or an initial condition, at most once since the boot, whatever arrives.

    The end of flapping repeats an end if an even number of changes was suppressed, which are only counted.
    Nothing ends before it began, and evidence precedes the event.
    """
    flight = Flight()
    for name, value in steps:
        ACTIONS[name][0](flight.wait(0.05), value)
    flight.link = ""
    for _ in range(3):  # reports flapping and losses that have ended
        flight.wait(20.0).look()
    begun: dict[tuple[str, str], Event] = {}
    initial: set[tuple[str, str]] = set()  # those that ended without a begin, which they can do once
    for event in sorted(flight.event_log.events, key=lambda each: each.time):
        assert event.kind in KINDS
        assert all(each.time <= event.time for each in event.evidence)
        assert event.lasted is None or event.lasted >= 0
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
                assert known is not None or is_repeated or (key not in initial and event.lasted is None)
                initial |= {key} if known is None else set()
