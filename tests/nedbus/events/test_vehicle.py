"""Regression tests of events: streams, clocks and data that once led to wrong events."""

from __future__ import annotations

from typing import Any

import pytest

from nedbus.events import Event, EventLog, Times, report_of, spans_of, state_at, stories_of, story_of
from nedbus_msgs import Address
from tests.flights.messages import VALID, VLP

MAIN = Address("1", VLP)
GPS = {"fix_type": 3, "satellites_used": 12, "jamming_state": 0, "jamming_indicator": 0, "spoofing_state": 0}


class Sent:
    """An event log of vehicle 1 that gets fields by name, as in a service."""

    def __init__(self) -> None:
        self.event_log = EventLog()

    def __call__(self, time: float, topic: str = VLP, instance: int | None = None, **fields: Any) -> None:
        given = {**(VALID if topic.endswith("local_position") else {}), "timestamp": round((10 + time) * 1e6), **fields}
        given = {name: value for name, value in given.items() if value is not None}
        self.event_log.add(Address("1", topic, instance), given, time)

    @property
    def told(self) -> list[tuple[str, str]]:
        return [(event.kind, event.change) for event in self.event_log.events]

    def state(self, time: float) -> str:
        return self.event_log.state("1", time).severity

    def stories(self, **options: Any) -> list[tuple[str, float | None]]:
        vehicle = self.event_log.vehicles["1"]
        conditions = [*vehicle.initial, *vehicle.conditions.values()]
        return [(story.what, story.until) for story in stories_of(list(self.event_log.events), conditions, **options)]


@pytest.fixture
def sent() -> Sent:
    return Sent()


def test_flags_that_a_source_does_not_have_are_no_state(sent: Sent) -> None:
    """MAVLink without ESTIMATOR_STATUS has no flags: the position is neither valid nor invalid."""
    none: dict[str, Any] = dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"))
    sent(0.0, **none)
    assert sent.state(0.0) == "info"
    sent(1.0, xy_valid=False)
    assert sent.state(1.0) == "bad"
    sent(2.0, **none)
    assert sent.state(2.0) == "info"
    assert sent.told == []


def test_silence_ends_with_the_vehicle_that_was_gone(sent: Sent) -> None:
    """A vehicle that was silent, then gone, then back, has no story without an end."""
    sent(0.0)
    sent.event_log.update(4.0, {MAIN: "stale"})
    sent.event_log.update(8.0, {MAIN: "gone"})
    sent(20.0)
    assert sent.told == [("silent", "begin"), ("gone", "begin"), ("gone", "end")]
    assert state_at(spans_of(list(sent.event_log.events)), 24.0).severity == "info"
    assert all(until is not None for _, until in sent.stories())


def test_conditions_of_a_superseded_stream_end(sent: Sent) -> None:
    """When a better position or receiver arrives, the conditions of the former one end."""
    sent(0.0, "estimator_local_position", 0)
    sent(1.0, "estimator_local_position", 0, xy_valid=False)
    sent(1.0, "sensor_gps", 0, **GPS)
    sent(2.0, "sensor_gps", 0, **{**GPS, "fix_type": 0, "satellites_used": 0})
    assert sent.state(2.0) == "bad"
    sent(3.0)
    sent(3.0, "vehicle_gps_position", **GPS)
    assert sent.state(3.0) == "info"
    assert all(until is not None for _, until in sent.stories())


def test_battery_that_is_taken_out_warns_no_more(sent: Sent) -> None:
    """The condition of a battery ends when it is removed; the next one is not low before it reports so."""
    sent(0.0, "battery_status", 0, warning=0, connected=True)
    sent(1.0, "battery_status", 0, warning=2, connected=True)
    assert sent.state(1.0) == "bad"
    sent(2.0, "battery_status", 0, warning=2, connected=False)
    assert sent.told[-1] == ("battery", "end")
    sent(3.0, "battery_status", 0, warning=0, connected=True)
    assert sent.state(3.0) == "info"


def test_damaged_time_is_no_reboot(sent: Sent) -> None:
    """A single message far ahead of the others, as in a damaged log, makes neither it nor the next one a reboot."""
    for second in range(5):
        sent(float(second), xy_valid=second < 3)
    sent(5.0, timestamp=9 * 10**18, xy_valid=False)
    sent(6.0, xy_valid=False)
    assert ("reboot", "once") not in sent.told
    assert sent.state(6.0) == "bad"
    event = Event("1", "jump", "once", "watch", "", 5.0, boot=9e12)
    assert Times(offsets={"1": 1e9}).utc(event) is None
    assert Times(offsets={"1": 1e9}).text(event) == "9000000000000.000"


def test_what_held_at_first_is_over_at_a_reboot(sent: Sent) -> None:
    """A vehicle that was not valid, reboots and is valid, has no active condition."""
    for second in range(3):
        sent(float(second), xy_valid=False)
    sent(10.0, timestamp=1_000_000)
    assert ("reboot", "once") in sent.told
    assert all(until is not None for what, until in sent.stories() if "xy" in what)


def test_what_began_on_the_ground_counts_when_armed(sent: Sent) -> None:
    """A link lost while disarmed is reported as watch once the vehicle is armed."""
    status = {"arming_state": 1, "nav_state": 4, "failsafe": False}
    sent(0.0, "vehicle_status", **status, gcs_connection_lost=False)
    sent(1.0, "vehicle_status", **status, gcs_connection_lost=True)
    assert sent.state(1.0) == "info"
    sent(2.0, "vehicle_status", **{**status, "arming_state": 2}, gcs_connection_lost=True)
    assert sent.state(2.0) == "watch"


def test_jamming_at_first_is_a_state(sent: Sent) -> None:
    """A receiver jammed when the service starts is reported; a vehicle without GNSS is not."""
    sent(0.0, "vehicle_gps_position", **{**GPS, "jamming_state": 3})
    assert sent.state(0.0) == "watch"
    assert sent.told == []
    other = Sent()
    other(0.0, "vehicle_gps_position", **{**GPS, "fix_type": 0, "satellites_used": 0})
    assert other.state(0.0) == "info"


def test_what_holds_from_first_to_last_is_the_state_at_any_time(sent: Sent) -> None:
    """A vehicle that is never valid in a recording is bad at any time, as it would be live."""
    for second in range(5):
        sent(float(second), xy_valid=False)
    state = state_at(spans_of(list(sent.event_log.events), sent.event_log.vehicles["1"].initial), 3.0)
    assert (state.severity, state.text) == ("bad", "xy not valid")
    assert [each.initial for each in state.conditions] == [True]


def test_condition_that_a_worse_one_replaces_ends_there(sent: Sent) -> None:
    """A battery that was low at the first message, becomes critical and is replaced, is no longer low."""
    for second, warning in enumerate((1, 2, 0)):
        sent(float(second), "battery_status", 0, warning=warning, connected=True)
    spans = spans_of(list(sent.event_log.events), sent.event_log.vehicles["1"].initial)
    assert [(span.text, span.since, span.until) for span in spans] == [
        ("battery low", 0.0, 1.0), ("battery critical", 1.0, 2.0),
    ]  # fmt: skip
    assert [state_at(spans, time).severity for time in (0.5, 1.5, 2.5)] == ["watch", "bad", "info"]
    assert sent.stories() == [("battery critical", 2.0)]


def test_story_is_about_the_event_that_was_asked_for(sent: Sent) -> None:
    """Two faults within a minute have a story each, and an end has the story of its begin."""
    sent(0.0)
    sent(1.0, timestamp=1_000_000)
    sent(1.1, timestamp=1_100_000, xy_reset_counter=1, delta_xy=(3.0, 4.0), x=3.0, y=4.0)
    sent(2.0, timestamp=2_000_000, xy_reset_counter=1, x=3.0, y=4.0, xy_valid=False)
    sent(3.0, timestamp=3_000_000, xy_reset_counter=1, x=3.0, y=4.0)
    events = list(sent.event_log.events)
    stories = {(event.kind, event.change): story_of(event, events) for event in events}
    told = {key: story.what for key, story in stories.items() if story is not None}
    assert told["reset", "once"].startswith("reset of xy by 5.0 m")
    assert told["reboot", "once"].startswith("reboot:")
    assert told["xy_invalid", "end"] == told["xy_invalid", "begin"] == "xy not valid"
    assert story_of(Event("1", "jump", "once", "watch", "", 9.0), events) is None


def test_noisy_vehicle_leaves_room_for_others_in_an_answer() -> None:
    """A full event log has the events of each vehicle, even after thousands of events of another one."""
    event_log = EventLog(keep=300)
    quiet, noisy = Address("quiet", VLP), Address("noisy", VLP)
    for second, valid in enumerate((True, False, True)):
        event_log.add(quiet, {**VALID, "timestamp": (second + 1) * 10**6, "xy_valid": valid}, float(second))
    for number in range(9000):
        fields = {**VALID, "timestamp": (number + 1) * 10**6, "xy_reset_counter": number % 256}
        event_log.add(noisy, fields, 10.0 + number)
    answered = report_of(event_log, "s", "h", 10_000.0, within=1e9).events
    assert [event.kind for event in answered if event.vehicle == "quiet"] == ["xy_invalid", "xy_invalid"]
    assert len(answered) == 300
    assert [event.time for event in answered] == sorted(event.time for event in answered)


def test_dropout_of_the_logger_is_no_silence(sent: Sent) -> None:
    """Nothing was recorded for 5 s: an event of the logger with its duration, and no silent vehicle."""
    sent(0.0)
    sent.event_log.add_dropout("1", 5.0, 0.02)
    for time in (1.0, 4.0, 5.0, 7.9):
        sent.event_log.update(time)
    assert sent.told == [("dropout", "once")]
    [event] = sent.event_log.events
    assert (event.severity, event.time, event.numbers["duration"]) == ("info", 0.02, 5.0)
    assert event.text == "logging dropout of 5.0 s"
    sent.event_log.update(8.5)  # 3 s after its end
    assert sent.told[1:] == [("silent", "begin")]


def test_only_the_ekf_in_use_has_states(sent: Sent) -> None:
    """The selector names the EKF in use: faults of others are no states, and those of the former one end."""
    for primary, faulty in ((1, 0), (0, 0), (1, 1)):
        for time in (0.0, 1.0):
            sent(time, "estimator_selector_status", primary_instance=primary)
            for instance in (0, 1):
                flags = {"cs_gnss_pos": time == 0.0 or instance != faulty}
                sent(time, "estimator_status_flags", instance, **flags)
        assert len(sent.told) == (0 if primary != faulty else 1), primary
        sent = Sent()
    sent(0.0, "estimator_status_flags", 0, cs_gnss_pos=True, cs_mag_fault=False)
    sent(1.0, "estimator_status_flags", 0, cs_gnss_pos=False, cs_mag_fault=True)
    assert sent.state(1.0) == "watch"
    for odd in (255, -1, 1.0, None, "x"):
        sent(1.5, "estimator_selector_status", primary_instance=odd)
    assert sent.state(1.5) == "watch"
    sent(2.0, "estimator_selector_status", primary_instance=1)
    assert sent.state(2.0) == "info"
    sent(3.0, "estimator_status_flags", 1, cs_gnss_pos=True, cs_mag_fault=False)
    sent(4.0, "estimator_status_flags", 0, cs_gnss_pos=True, cs_mag_fault=True)
    assert sent.state(4.0) == "info"


def test_fault_of_an_unused_ekf_names_it(sent: Sent) -> None:
    """It is information of its own kind, which explains nothing; that of an EKF that comes into use is a fault."""
    for time, primary, rejects in ((0.0, 0, False), (1.0, 0, True), (2.0, 1, True), (3.0, 0, True)):
        sent(time, "estimator_status_flags", 1, reject_hor_pos=rejects)
        sent(time, "estimator_selector_status", primary_instance=primary)
        sent(time, xy_reset_counter=round(time), x=5.0 * time)
    found = [each for each in sent.event_log.events if each.kind not in ("reset", "jump")]
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
    resets = [each for each in sent.event_log.events if each.kind == "reset"]
    assert [[each.kind for each in reset.evidence] for reset in resets] == [
        [], ["ekf_changed", "innovation_rejected"], ["ekf_changed", "innovation_rejected"],
    ]  # fmt: skip
    assert sent.event_log.vehicles["1"].state(100.0).conditions == ()


def test_ekf_in_use_without_a_selector(sent: Sent) -> None:
    """It is the one whose estimates equal the vehicle's; two that are equal tell nothing."""
    for time, other in ((0.0, 0.0), (1.0, 5.0), (2.0, 6.0)):
        for instance, x in ((0, other), (1, time)):
            sent(time, "estimator_local_position", instance, timestamp_sample=round(1e6 * time), x=x)
        sent(time, timestamp_sample=round(1e6 * time), x=time, vx=1.0)
        for instance in (0, 1):
            sent(time, "estimator_status_flags", instance, cs_mag_fault=False)
    sent(3.0, "estimator_status_flags", 0, cs_mag_fault=True)
    sent(4.0, "estimator_status_flags", 1, cs_mag_fault=True)
    texts = [each.text for each in sent.event_log.events]
    assert texts == ["EKF 0 (not primary): fault: magnetometer", "EKF fault: magnetometer"]
    assert [each.kind for each in sent.event_log.vehicles["1"].state(100.0).conditions] == ["estimator_fault"]


def test_selector_that_arrives_late_names_the_ekf_in_use(sent: Sent) -> None:
    """From the first selector on, estimates that equal the vehicle's are not compared."""
    for time in (0.0, 1.0, 2.0, 3.0):
        for instance in (0, 1):
            sent(time, "estimator_local_position", instance, timestamp_sample=round(1e6 * time), x=time * instance)
        sent(time, timestamp_sample=round(1e6 * time), x=time, vx=1.0)
        sent(time, "estimator_status_flags", 0, cs_mag_fault=time == 3.0)
        if time >= 1.0:
            sent(time, "estimator_selector_status", primary_instance=0)
    assert [each.text for each in sent.event_log.events] == ["EKF fault: magnetometer"]


@pytest.mark.parametrize("gnss", [False, True])
def test_fake_position_that_ends_is_evidence(sent: Sent, gnss: bool) -> None:
    """A fake position that nothing replaces precedes an invalid position; one that GNSS replaces is no event."""
    sent(0.0, "estimator_status_flags", 0, cs_fake_pos=True, cs_valid_fake_pos=True, cs_gnss_pos=False)
    sent(0.0)
    sent(1.0, "estimator_status_flags", 0, cs_fake_pos=True, cs_valid_fake_pos=False, cs_gnss_pos=gnss)
    sent(2.0, "estimator_status_flags", 0, cs_fake_pos=False, cs_valid_fake_pos=False, cs_gnss_pos=gnss)
    sent(2.2, xy_valid=False)
    [invalid] = [each for each in sent.event_log.events if each.kind == "xy_invalid"]
    assert [each.text for each in invalid.evidence] == ["no horizontal aiding: EKF stopped fusing fake position"][
        : not gnss
    ]
