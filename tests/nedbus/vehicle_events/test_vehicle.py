"""Regression tests: streams, clocks and data that once caused wrong events."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest

from nedbus.vehicle_events import (
    Event,
    EventLog,
    Times,
    report_of,
    spans_of,
    state_at,
    stories_of,
    story_of,
)
from nedbus.vehicle_events.rules import PAUSE
from nedbus_msgs import Address
from tests.flights.messages import VALID, VLP
from tests.nedbus.vehicle_events.flight import ARMED, Flight

MAIN = Address("1", VLP)
GPS = {
    "fix_type": 3,
    "satellites_used": 12,
    "jamming_state": 0,
    "jamming_indicator": 0,
    "spoofing_state": 0,
}


class SimpleVehicle:
    """Vehicle 1 in an event log that receives dicts of fields, as in a service."""

    def __init__(self) -> None:
        self.event_log = EventLog()

    def send(
        self, time: float, topic: str = VLP, instance: int | None = None, **fields: Any
    ) -> None:
        given = {
            **(VALID if topic.endswith("local_position") else {}),
            "timestamp": round((10 + time) * 1e6),
            **fields,
        }
        given = {name: value for name, value in given.items() if value is not None}
        self.event_log.add(Address("1", topic, instance), given, time)

    @property
    def reported(self) -> list[tuple[str, str]]:
        return [(event.kind, event.change) for event in self.event_log.events]

    def state(self, time: float) -> str:
        return self.event_log.state("1", time).severity

    def stories(self, **options: Any) -> list[tuple[str, float | None]]:
        vehicle = self.event_log.vehicles["1"]
        conditions = [*vehicle.initial, *vehicle.conditions.values()]
        return [
            (story.what, story.until)
            for story in stories_of(list(self.event_log.events), conditions, **options)
        ]


@pytest.fixture
def vehicle() -> SimpleVehicle:
    return SimpleVehicle()


@pytest.mark.parametrize(
    ("interval", "is_wild"), [(0.1, True), (0.3, True), (0.5, False), (2.0, False)]
)
@pytest.mark.parametrize("fields", [{"xy_valid": False}, {"ref_lat": 46.0, "ref_timestamp": 9}])
def test_only_a_value_of_less_than_half_a_second_is_marked_as_that_of_one_message(
    fields: dict[str, Any], interval: float, *, is_wild: bool
) -> None:
    """A condition, or a moved origin, of one message that the next one takes back is doubtful if that follows soon."""
    flight = Flight()
    flight.status(ARMED)
    for number in range(8):
        flight.wait(interval).send(**fields if number == 5 else {})
    changes = [
        event for event in flight.event_log.events if event.kind in ("xy_invalid", "origin_moved")
    ]
    assert len(changes) == 2
    assert ["one_message" in event.numbers for event in changes] == [False, is_wild]
    assert len(flight_stories(flight)) == (0 if is_wild else 1)


def flight_stories(flight: Flight) -> list[str]:
    """Return the faults of a flight, those with the same text once."""
    held = flight.event_log.vehicles["1"].held
    return [*dict.fromkeys(story.what for story in stories_of(flight.event_log.events, held))]


def test_flags_not_provided_are_neither_valid_nor_invalid(vehicle: SimpleVehicle) -> None:
    """Without ESTIMATOR_STATUS, MAVLink provides no flags: the position is neither valid nor invalid."""
    none: dict[str, Any] = dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"))
    vehicle.send(0.0, **none)
    assert vehicle.state(0.0) == "info"
    vehicle.send(1.0, xy_valid=False)
    assert vehicle.state(1.0) == "bad"
    vehicle.send(2.0, **none)
    assert vehicle.state(2.0) == "info"
    assert vehicle.reported == []


def test_gone_vehicle_that_resumes_is_not_silent(vehicle: SimpleVehicle) -> None:
    """When a vehicle resumes after it was silent and then gone, no story stays active."""
    vehicle.send(0.0)
    vehicle.event_log.update(4.0, {MAIN: "stale"})
    vehicle.event_log.update(8.0, {MAIN: "gone"})
    vehicle.send(20.0)
    assert vehicle.reported == [("silent", "begin"), ("gone", "begin"), ("gone", "end")]
    assert state_at(spans_of(list(vehicle.event_log.events)), 24.0).severity == "info"
    assert all(until is not None for _, until in vehicle.stories())


def test_conditions_of_superseded_stream_end(vehicle: SimpleVehicle) -> None:
    """When a preferred position or receiver arrives, the conditions of the previous one end."""
    vehicle.send(0.0, "estimator_local_position", 0)
    vehicle.send(1.0, "estimator_local_position", 0, xy_valid=False)
    vehicle.send(1.0, "sensor_gps", 0, **GPS)
    vehicle.send(2.0, "sensor_gps", 0, **{**GPS, "fix_type": 0, "satellites_used": 0})
    assert vehicle.state(2.0) == "bad"
    vehicle.send(3.0)
    vehicle.send(3.0, "vehicle_gps_position", **GPS)
    assert vehicle.state(3.0) == "info"
    assert all(until is not None for _, until in vehicle.stories())


def test_removed_battery_ends_its_warning(vehicle: SimpleVehicle) -> None:
    """Removing a battery ends its warning; the next battery has no warning until it reports one."""
    vehicle.send(0.0, "battery_status", 0, warning=0, connected=True)
    vehicle.send(1.0, "battery_status", 0, warning=2, connected=True)
    assert vehicle.state(1.0) == "bad"
    vehicle.send(2.0, "battery_status", 0, warning=2, connected=False)
    assert vehicle.reported[-1] == ("battery", "end")
    vehicle.send(3.0, "battery_status", 0, warning=0, connected=True)
    assert vehicle.state(3.0) == "info"


def test_damaged_timestamp_is_not_a_reboot(vehicle: SimpleVehicle) -> None:
    """After a single message far ahead in time, as in a damaged log, the next message is not a reboot."""
    for second in range(5):
        vehicle.send(float(second), xy_valid=second < 3)
    vehicle.send(5.0, timestamp=9 * 10**18, xy_valid=False)
    vehicle.send(6.0, xy_valid=False)
    assert ("reboot", "once") not in vehicle.reported
    assert vehicle.state(6.0) == "bad"
    event = Event("1", "jump", "once", "watch", "", 5.0, boot=9e12)
    assert Times(offsets={"1": 1e9}).utc(event) is None
    assert Times(offsets={"1": 1e9}).text(event) == "9000000000000.000"


@pytest.mark.parametrize("stamp", [0, 1, 20_000_000])
def test_single_low_timestamp_is_not_a_reboot(vehicle: SimpleVehicle, stamp: int) -> None:
    """A reboot needs two messages: after a single one far back in time, the stream continues as before."""
    for second in range(5):
        vehicle.send(float(second), timestamp=(100 + second) * 10**6, xy_valid=second < 3)
    vehicle.send(5.0, timestamp=stamp, xy_valid=False, z_valid=False)
    vehicle.send(6.0, timestamp=106 * 10**6, xy_valid=False, z_valid=False)
    vehicle.send(7.0, timestamp=107 * 10**6, xy_valid=False)
    assert vehicle.reported == [
        ("xy_invalid", "begin"),
        ("z_invalid", "begin"),
        ("z_invalid", "end"),
    ]
    assert vehicle.state(7.0) == "bad"


@pytest.mark.parametrize("stamp", [1, 10**11, 9 * 10**18])
def test_wild_last_timestamp_does_not_date_later_events(vehicle: SimpleVehicle, stamp: int) -> None:
    """Events after a message with a wild timestamp, such as silence, have the time since boot of the others."""
    for second in range(5):
        vehicle.send(float(second))
    vehicle.send(5.0, timestamp=stamp)
    vehicle.event_log.update(20.0, {MAIN: "stale"})
    assert [(each.kind, each.boot) for each in vehicle.event_log.events] == [("silent", 30.0)]


def test_event_after_an_old_text_has_its_own_time(vehicle: SimpleVehicle) -> None:
    """A text from before the start of a log has its own time since boot, and so has the next event."""
    vehicle.send(0.0)
    vehicle.send(0.5, "log_message", timestamp=1_000_000, severity=6, text="old")
    vehicle.send(1.0, xy_valid=False)
    assert [(each.kind, each.boot) for each in vehicle.event_log.events] == [
        ("text", 1.0),
        ("xy_invalid", 11.0),
    ]


def test_wild_first_timestamp_is_not_a_reboot(vehicle: SimpleVehicle) -> None:
    """If only the first message of the only stream was later, that time was wrong, and the vehicle did not reboot."""
    vehicle.send(0.0, timestamp=10**11)
    for second in range(1, 5):
        vehicle.send(float(second))
    assert vehicle.reported == []


def test_second_stream_confirms_a_reboot(vehicle: SimpleVehicle) -> None:
    """Two streams whose time went back show a reboot, and the first one keeps what it reported."""
    status = {"arming_state": 2, "nav_state": 4, "failsafe": False}
    vehicle.send(0.0, timestamp=100_000_000)
    vehicle.send(0.0, "vehicle_status", timestamp=100_000_000, **status)
    vehicle.send(1.0, "vehicle_status", timestamp=1_000_000, **status)
    assert ("reboot", "once") not in vehicle.reported
    vehicle.send(2.0, timestamp=2_000_000)
    assert vehicle.reported == [("reboot", "once")]
    assert vehicle.event_log.vehicles["1"].armed is True


def test_reboot_ends_initial_condition(vehicle: SimpleVehicle) -> None:
    """A vehicle that is invalid in the first message and valid after a reboot has no active condition."""
    for second in range(3):
        vehicle.send(float(second), xy_valid=False)
    vehicle.send(10.0, timestamp=1_000_000)
    vehicle.send(10.1, timestamp=1_100_000)
    assert ("reboot", "once") in vehicle.reported
    assert all(until is not None for what, until in vehicle.stories() if "xy" in what)


def test_info_condition_on_ground_becomes_watch_when_armed(vehicle: SimpleVehicle) -> None:
    """A GCS connection lost while disarmed has severity "watch" once the vehicle is armed."""
    status = {"arming_state": 1, "nav_state": 4, "failsafe": False}
    vehicle.send(0.0, "vehicle_status", **status, gcs_connection_lost=False)
    vehicle.send(1.0, "vehicle_status", **status, gcs_connection_lost=True)
    assert vehicle.state(1.0) == "info"
    vehicle.send(2.0, "vehicle_status", **{**status, "arming_state": 2}, gcs_connection_lost=True)
    assert vehicle.state(2.0) == "watch"


def test_jamming_in_first_message_is_a_condition(vehicle: SimpleVehicle) -> None:
    """Jamming in the first message is a condition; a receiver without satellites is not."""
    vehicle.send(0.0, "vehicle_gps_position", **{**GPS, "jamming_state": 3})
    assert vehicle.state(0.0) == "watch"
    assert vehicle.reported == []
    other = SimpleVehicle()
    other.send(0.0, "vehicle_gps_position", **{**GPS, "fix_type": 0, "satellites_used": 0})
    assert other.state(0.0) == "info"


def test_condition_active_throughout_a_recording_is_in_every_state(vehicle: SimpleVehicle) -> None:
    """A vehicle whose position is never valid in a recording has state "bad" at any time in it, as in live data."""
    for second in range(5):
        vehicle.send(float(second), xy_valid=False)
    state = state_at(
        spans_of(list(vehicle.event_log.events), vehicle.event_log.vehicles["1"].initial), 3.0
    )
    assert (state.severity, state.text) == ("bad", "xy not valid")
    assert [each.initial for each in state.conditions] == [True]


def test_worse_warning_ends_the_previous_one(vehicle: SimpleVehicle) -> None:
    """A battery low in the first message, then critical, then replaced, is no longer low."""
    for second, warning in enumerate((1, 2, 0)):
        vehicle.send(float(second), "battery_status", 0, warning=warning, connected=True)
    spans = spans_of(list(vehicle.event_log.events), vehicle.event_log.vehicles["1"].initial)
    assert [(span.text, span.since, span.until) for span in spans] == [
        ("battery low", 0.0, 1.0), ("battery critical", 1.0, 2.0),
    ]  # fmt: skip
    assert [state_at(spans, time).severity for time in (0.5, 1.5, 2.5)] == ["watch", "bad", "info"]
    assert vehicle.stories() == [("battery critical", 2.0)]


def test_story_of_event_explains_that_event(vehicle: SimpleVehicle) -> None:
    """Two faults within a minute have one story each; an end event belongs to the story of its begin event."""
    vehicle.send(0.0)
    vehicle.send(0.1)
    vehicle.send(1.0, timestamp=1_000_000, xy_reset_counter=0)
    vehicle.send(1.05, timestamp=1_050_000, xy_reset_counter=0)
    vehicle.send(1.1, timestamp=1_100_000, xy_reset_counter=1, delta_xy=(3.0, 4.0), x=3.0, y=4.0)
    vehicle.send(2.0, timestamp=2_000_000, xy_reset_counter=1, x=3.0, y=4.0, xy_valid=False)
    vehicle.send(3.0, timestamp=3_000_000, xy_reset_counter=1, x=3.0, y=4.0)
    events = list(vehicle.event_log.events)
    stories = {(event.kind, event.change): story_of(event, events) for event in events}
    reported = {key: story.what for key, story in stories.items() if story is not None}
    assert reported["reset", "once"].startswith("reset of xy by 5.0 m")
    assert reported["reboot", "once"].startswith("reboot (up for")
    assert reported["xy_invalid", "end"] == reported["xy_invalid", "begin"] == "xy not valid"
    assert story_of(Event("1", "jump", "once", "watch", "", 9.0), events) is None


@pytest.mark.slow
def test_noisy_vehicle_does_not_displace_events_of_others() -> None:
    """A full event log keeps the events of a vehicle after thousands of events of another one."""
    event_log = EventLog(keep=300)
    quiet, noisy = Address("quiet", VLP), Address("noisy", VLP)
    for second, valid in enumerate((True, False, True)):
        event_log.add(
            quiet, {**VALID, "timestamp": (second + 1) * 10**6, "xy_valid": valid}, float(second)
        )
    for number in range(9000):
        fields = {**VALID, "timestamp": (number + 1) * 10**6, "xy_reset_counter": number % 256}
        event_log.add(noisy, fields, 10.0 + number)
    answered = report_of(event_log, "s", "h", 10_000.0, within=1e9).events
    assert [event.kind for event in answered if event.vehicle == "quiet"] == [
        "xy_invalid",
        "xy_invalid",
    ]
    assert len(answered) == 300
    assert [event.time for event in answered] == sorted(event.time for event in answered)


def test_oldest_event_is_deleted_while_no_vehicle_has_many() -> None:
    """In a full event log of vehicles with up to 20 events each, the oldest event of all is deleted."""
    event_log = EventLog(keep=40)
    for start, vehicle, count in ((0, "a", 5), (5, "b", 20), (25, "c", 16)):
        for number in range(count + 1):
            fields = {**VALID, "timestamp": (number + 1) * 10**6, "xy_reset_counter": number}
            event_log.add(Address(vehicle, VLP), fields, float(start + number))
    assert Counter(each.vehicle for each in event_log.events) == {"a": 4, "b": 20, "c": 16}


def test_logging_dropout_is_not_silence(vehicle: SimpleVehicle) -> None:
    """A logging dropout of 5 s is an event with its duration, and does not make the vehicle silent."""
    vehicle.send(0.0)
    vehicle.event_log.add_dropout("1", 5.0, 0.02)
    for time in (1.0, 4.0, 5.0, 7.9):
        vehicle.event_log.update(time)
    assert vehicle.reported == [("dropout", "once")]
    [event] = vehicle.event_log.events
    assert (event.severity, event.time, event.numbers["duration"]) == ("info", 0.02, 5.0)
    assert event.text == "logging dropout of 5.0 s"
    vehicle.event_log.update(8.5)  # 3 s after the dropout
    assert vehicle.reported[1:] == [("silent", "begin")]


def test_only_primary_ekf_has_conditions(vehicle: SimpleVehicle) -> None:
    """Only faults of the primary EKF are conditions; they end when another EKF becomes primary."""
    for primary, faulty in ((1, 0), (0, 0), (1, 1)):
        for time in (0.0, 1.0):
            vehicle.send(time, "estimator_selector_status", primary_instance=primary)
            for instance in (0, 1):
                flags = {"cs_gnss_pos": time == 0.0 or instance != faulty}
                vehicle.send(time, "estimator_status_flags", instance, **flags)
        assert len(vehicle.reported) == (0 if primary != faulty else 1), primary
        vehicle = SimpleVehicle()
    vehicle.send(0.0, "estimator_status_flags", 0, cs_gnss_pos=True, cs_mag_fault=False)
    vehicle.send(1.0, "estimator_status_flags", 0, cs_gnss_pos=False, cs_mag_fault=True)
    assert vehicle.state(1.0) == "watch"
    for odd in (255, -1, 1.0, None, "x"):
        vehicle.send(1.5, "estimator_selector_status", primary_instance=odd)
    assert vehicle.state(1.5) == "watch"
    vehicle.send(2.0, "estimator_selector_status", primary_instance=1)
    assert vehicle.state(2.0) == "info"
    vehicle.send(3.0, "estimator_status_flags", 1, cs_gnss_pos=True, cs_mag_fault=False)
    vehicle.send(4.0, "estimator_status_flags", 0, cs_gnss_pos=True, cs_mag_fault=True)
    assert vehicle.state(4.0) == "info"


def test_fault_of_non_primary_ekf_is_info(vehicle: SimpleVehicle) -> None:
    """A fault of a non-primary EKF has severity "info" and is no evidence; once the EKF is primary, it is a fault."""
    for time, primary, rejects in ((0.0, 0, False), (1.0, 0, True), (2.0, 1, True), (3.0, 0, True)):
        vehicle.send(time, "estimator_status_flags", 1, reject_hor_pos=rejects)
        vehicle.send(time, "estimator_selector_status", primary_instance=primary)
        vehicle.send(time, xy_reset_counter=round(time), x=5.0 * time)
    found = [each for each in vehicle.event_log.events if each.kind not in ("reset", "jump")]
    rejected = "EKF 1 (not primary): rejects horizontal position"
    assert [(each.change, each.severity, each.text) for each in found] == [
        ("begin", "info", rejected),
        ("once", "watch", "primary EKF changed from 0 to 1"),
        ("end", "info", f"{rejected}: superseded by estimator_status_flags/1 after 1.0 s"),
        ("begin", "watch", "EKF rejects horizontal position"),
        ("once", "watch", "primary EKF changed from 1 to 0"),
        ("end", "info", "EKF rejects horizontal position: superseded by estimator_status_flags/0 after 1.0 s"),
        ("begin", "info", rejected),
    ]  # fmt: skip
    resets = [each for each in vehicle.event_log.events if each.kind == "reset"]
    assert [[each.kind for each in reset.evidence] for reset in resets] == [
        [], ["ekf_changed", "innovation_rejected"], ["ekf_changed", "innovation_rejected"],
    ]  # fmt: skip
    assert vehicle.event_log.vehicles["1"].state(100.0).conditions == ()


def test_primary_ekf_without_selector_is_identified_by_its_estimate(vehicle: SimpleVehicle) -> None:
    """Without a selector, the primary EKF is the only one whose estimate equals the vehicle's."""
    for time, other in ((0.0, 0.0), (1.0, 5.0), (2.0, 6.0)):
        for instance, x in ((0, other), (1, time)):
            vehicle.send(
                time, "estimator_local_position", instance, timestamp_sample=round(1e6 * time), x=x
            )
        vehicle.send(time, timestamp_sample=round(1e6 * time), x=time, vx=1.0)
        for instance in (0, 1):
            vehicle.send(time, "estimator_status_flags", instance, cs_mag_fault=False)
    vehicle.send(3.0, "estimator_status_flags", 0, cs_mag_fault=True)
    vehicle.send(4.0, "estimator_status_flags", 1, cs_mag_fault=True)
    texts = [each.text for each in vehicle.event_log.events]
    assert texts == ["EKF 0 (not primary): fault: magnetometer", "EKF fault: magnetometer"]
    assert [each.kind for each in vehicle.event_log.vehicles["1"].state(100.0).conditions] == [
        "estimator_fault"
    ]


def test_late_selector_overrides_comparison_of_estimates(vehicle: SimpleVehicle) -> None:
    """From the first selector message on, estimates are not compared with the vehicle's."""
    for time in (0.0, 1.0, 2.0, 3.0):
        for instance in (0, 1):
            vehicle.send(
                time,
                "estimator_local_position",
                instance,
                timestamp_sample=round(1e6 * time),
                x=time * instance,
            )
        vehicle.send(time, timestamp_sample=round(1e6 * time), x=time, vx=1.0)
        vehicle.send(time, "estimator_status_flags", 0, cs_mag_fault=time == 3.0)
        if time >= 1.0:
            vehicle.send(time, "estimator_selector_status", primary_instance=0)
    assert [each.text for each in vehicle.event_log.events] == ["EKF fault: magnetometer"]


@pytest.mark.parametrize("gnss", [False, True])
def test_end_of_fake_position_fusion_is_evidence(vehicle: SimpleVehicle, gnss: bool) -> None:
    """The end of fake position fusion is evidence for an invalid position unless GNSS replaces it."""
    vehicle.send(
        0.0,
        "estimator_status_flags",
        0,
        cs_fake_pos=True,
        cs_valid_fake_pos=True,
        cs_gnss_pos=False,
    )
    vehicle.send(0.0)
    vehicle.send(
        1.0,
        "estimator_status_flags",
        0,
        cs_fake_pos=True,
        cs_valid_fake_pos=False,
        cs_gnss_pos=gnss,
    )
    vehicle.send(
        2.0,
        "estimator_status_flags",
        0,
        cs_fake_pos=False,
        cs_valid_fake_pos=False,
        cs_gnss_pos=gnss,
    )
    vehicle.send(2.2, xy_valid=False)
    [invalid] = [each for each in vehicle.event_log.events if each.kind == "xy_invalid"]
    assert [each.text for each in invalid.evidence] == [
        "no horizontal aiding: EKF stopped fusing fake position"
    ][: not gnss]


def test_number_of_topics_of_a_vehicle_is_limited(vehicle: SimpleVehicle) -> None:
    """At most 1,000 topics are stored, although a better position stream opens the other streams again."""
    for instance in (3, 2, 1, 0):
        vehicle.send(0.0, "estimator_local_position", instance)
        for number in range(800):
            vehicle.send(0.0, f"topic_{instance}_{number}")
    assert len(vehicle.event_log.vehicles["1"].topics) == 1000


@pytest.mark.slow
def test_number_of_initial_conditions_is_limited() -> None:
    """A vehicle that is rebooted and armed again and again without a fix has at most 100 initial conditions."""
    flight = Flight()
    for _ in range(100):
        flight.booted = flight.now
        flight.wait(1.0).send(xy_global=False)
        flight.gps(fix_type=0, satellites_used=0)
        flight.status(ARMED)
        flight.fly(PAUSE + 1.0)
        flight.update()
    assert 90 <= len(flight.event_log.vehicles["1"].initial) <= 100
