"""Stories of a vehicle with synthetic messages, and parsing and formatting of times."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import pytest

from nedbus.vehicle_events import Event, Story, Times, stories_of

from .flight import ARMED, DISARMED, Flight, lose_gps


def why(flight: Flight, *, at: float | None = None) -> list[Story]:
    """Return the stories of the vehicle; `at`: time on the event log's clock."""
    followed = flight.event_log.vehicles["1"]
    events = sorted(flight.event_log.events_since(0)[0], key=lambda each: each.time)
    return stories_of(events, followed.conditions.values(), topics=list(followed.topics), at=at)


def recover(flight: Flight) -> None:
    flight.wait(1.0).gps()
    flight.wait(1.0).send()
    flight.wait(0.5).status(ARMED)


def test_flags_invalid_together_are_one_story() -> None:
    """Flags that become invalid together are one story, which includes its consequences."""
    flight = Flight()
    lose_gps(flight)
    (story,) = why(flight)
    assert (story.what, story.until, story.end, story.is_bad) == (
        "xy and vxy not valid",
        None,
        None,
        True,
    )
    assert [each.kind for each in story.before] == [
        "gps_fix_lost",
        "few_satellites",
        "dead_reckoning",
    ]
    assert [each.kind for each in story.meanwhile] == ["failsafe"]
    assert story.after == ()
    assert story.lacking == ("estimator_status_flags", "failsafe_flags")


def test_story_ends_with_last_flag() -> None:
    """A story ends with its last flag, and includes the events at its end."""
    flight = Flight()
    lose_gps(flight)
    begin = flight.now - 1.0
    recover(flight)
    (story,) = why(flight)
    assert story.since == pytest.approx(begin)
    assert story.until == pytest.approx(begin + 3.0)
    assert [(each.kind, each.change) for each in story.after] == [
        ("gps_fix_lost", "end"), ("few_satellites", "end"), ("dead_reckoning", "end"),
    ]  # fmt: skip


def test_text_at_the_start_of_a_file_is_evidence_for_ten_seconds() -> None:
    """A text in the first message of a file, at time 0, is evidence for faults of the next ten seconds only."""
    flight = Flight()
    flight.now, flight.booted = 0.0, -10.0
    flight.send("log_message", severity=4, text="Failsafe warning")
    for start in (5.0, 30.0):
        flight.now = start
        flight.send()
        flight.wait(0.1).send(xy_valid=False)
        flight.wait(1.0).send()
    assert [[each.kind for each in story.before] for story in why(flight)] == [["text"], []]


def test_estimate_fault_that_outlasts_another_is_a_story() -> None:
    """A fault of the estimate that begins during another one and outlasts it is a separate story."""
    flight = Flight()
    flight.status(ARMED)
    flight.send()
    flight.wait(1.0).send(z_valid=False)
    flight.wait(2.0).send(z_valid=False, xy_valid=False)
    flight.status(ARMED, failsafe=True)
    flight.wait(2.0).send(xy_valid=False)
    assert [each.what for each in why(flight)] == ["z not valid", "xy not valid"]


def test_wild_end_without_its_begin_leaves_an_earlier_fault() -> None:
    """A condition of one message, whose begin a full event log has dropped, does not remove an earlier fault's end."""
    flight = Flight()
    flight.send()
    flight.wait(1.0).send(xy_valid=False)
    flight.wait(4.0).send()
    flight.fly(15)
    flight.wait(0.1).send(xy_valid=False)
    flight.wait(0.1).send()
    begin, end, _, wild = flight.event_log.events
    assert ("one_message" in wild.numbers, "one_message" in end.numbers) == (True, False)
    [story] = stories_of([begin, end, wild])
    assert (story.what, story.until) == ("xy not valid", end.time)


def test_reboot_ends_a_story() -> None:
    """A reboot ends earlier conditions without further events, and is a story itself."""
    flight = Flight()
    flight.send()
    flight.wait(1.0).send(xy_valid=False)
    flight.booted = flight.wait(1.0).now - 0.01
    flight.send()
    flight.send()
    stories = why(flight)
    assert [(each.what.partition(" (")[0].partition(":")[0], each.until) for each in stories] == [
        ("xy not valid", flight.now), ("reboot", flight.now),
    ]  # fmt: skip


def test_end_of_one_fault_does_not_end_another() -> None:
    """The end of a fault present in the first message does not end a fault that began later."""
    flight = Flight()
    flight.send()
    flags: dict[str, Any] = {"cs_baro_fault": True, "fs_bad_hdg": False}
    flight.send("estimator_status_flags", **flags)
    flight.wait(1.0).send("estimator_status_flags", **flags | {"fs_bad_hdg": True})
    flight.wait(1.0).send(
        "estimator_status_flags", **flags | {"fs_bad_hdg": True, "cs_baro_fault": False}
    )
    assert [(each.what, each.until) for each in why(flight)] == [("EKF fault: heading", None)]


def test_watch_condition_is_a_story_beside_a_bad_one() -> None:
    """A "watch" condition that has ended is a story, also if a "bad" one follows; `at` selects the one of its time."""
    flight = Flight()
    flight.gps()
    flight.fly(1)
    flight.gps(jamming_indicator=100)
    flight.fly(5)
    flight.gps()
    jammed = flight.now - 2.5
    assert [each.what for each in why(flight)] == ["GNSS jamming: indicator 100"]
    flight.fly(100)
    flight.wait(0.1).send(xy_valid=False)
    assert [each.what for each in why(flight)] == ["GNSS jamming: indicator 100", "xy not valid"]
    assert [each.what for each in why(flight, at=jammed)] == ["GNSS jamming: indicator 100"]
    assert [each.what for each in why(flight, at=flight.now - 50)] == [
        "GNSS jamming: indicator 100"
    ]
    assert [each.what for each in why(flight, at=flight.now + 50)] == ["xy not valid"]


def test_active_watch_condition_is_a_story_after_ended_fault() -> None:
    """A "watch" condition that is active now is a story, even after a "bad" condition that has ended."""
    flight = Flight()
    lose_gps(flight)
    recover(flight)
    flight.fly(60)
    flight.wait(0.1).send(dead_reckoning=True)
    assert [(each.what, each.until) for each in why(flight)][1:] == [("dead reckoning", None)]
    flight.wait(1.0).send(dead_reckoning=True, xy_valid=False)
    assert [each.what for each in why(flight)] == ["xy and vxy not valid", "xy not valid"]


def test_fault_that_ended_before_the_arming_is_not_in_flight() -> None:
    """A fault is in flight if it lasts into the time between arming and disarming."""
    flight = Flight()
    flight.status(DISARMED)
    flight.send()
    flight.wait(1.0).send(xy_valid=False)
    flight.wait(3.0).send()
    flight.wait(1.0).status(ARMED)
    flight.fly(5)
    flight.wait(0.1).send(xy_valid=False)
    flight.wait(3.0).send()
    flight.wait(1.0).status(DISARMED)
    assert [(story.what, story.in_flight) for story in why(flight)] == [
        ("xy not valid", False),
        ("xy not valid", True),
    ]


def test_condition_without_begin_event_is_a_story() -> None:
    """A condition without a begin event is active from its recorded start, or from the first message on."""
    flight = Flight()
    flight.send(z_valid=False)
    flight.wait(2.0).send(z_valid=False, xy_valid=False)
    held = list(flight.event_log.vehicles["1"].conditions.values())
    assert [(each.what, each.begin, each.until) for each in stories_of([], held)] == [
        ("z not valid", None, None), ("xy not valid", held[1].begin, None),
    ]  # fmt: skip


def test_healthy_vehicle_has_no_story() -> None:
    """A vehicle that arms, takes off and lands has no story; nor does an unknown vehicle."""
    flight = Flight()
    flight.send()
    flight.status(ARMED)
    flight.send("vehicle_land_detected", landed=True)
    flight.wait(1.0).send("vehicle_land_detected", landed=False)
    assert why(flight) == []
    assert stories_of([]) == []
    assert stories_of([], at=5.0) == []


def event_at(time: float, *, boot: float | None = None) -> Event:
    return Event("1", "jump", "once", "watch", "", time, boot)


EVENING = datetime(2026, 11, 22, 23, 59, 50, tzinfo=UTC).timestamp()


@pytest.mark.parametrize(
    ("text", "step"),
    [
        ("23:59:50", 0.0), ("23:59", -50.0), ("00:00:10", 20.0), ("0:00:10.5", 20.5), ("12:00", -43_190.0),
        (" 11:59:00 ", 43_150.0), ("7", -93.0), ("100.25", 0.25), ("1e2", 0.0),
    ],
)  # fmt: skip
def test_time_is_parsed(text: str, step: float) -> None:
    """A time of day selects its closest occurrence, even across midnight; a number is seconds since boot."""
    live, event = Times(is_live=True), event_at(EVENING, boot=100.0)
    assert live.find(text, event) - event.time == pytest.approx(step, abs=1e-3)
    of_file, event = Times(offsets={"1": EVENING - 100.0}), event_at(40.0, boot=100.0)
    assert of_file.find(text, event) - event.time == pytest.approx(step, abs=1e-3)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "noon",
        "24:00",
        "12:60",
        "12:30:60",
        "12:30:61.5",
        "1:2",
        "12.30.00",
        "nan",
        "inf",
        "1:00:00:00",
    ],
)
def test_invalid_time_raises(text: str) -> None:
    """Text that is not a time raises ValueError with nedbus's own message."""
    with pytest.raises(ValueError, match="not a time"):
        Times(is_live=True).find(text, event_at(EVENING, boot=100.0))


def test_unavailable_clock_raises() -> None:
    """Parsing a time raises if no message has its clock; a log without UTC uses seconds since boot."""
    times, event = Times(), event_at(40.0, boot=100.0)
    assert (times.clock(event), times.text(event), times.utc(event)) == ("boot", "100.000", None)
    assert times.find("99", event) == 39.0
    assert (times.find("+12.5", event), times.find("-1", event)) == (12.5, -1.0)
    with pytest.raises(ValueError, match="no message of this vehicle has UTC"):
        times.find("12:00", event)
    with pytest.raises(ValueError, match="no message of this vehicle has the time since boot"):
        Times(is_live=True).find("99", event_at(EVENING))
    with pytest.raises(ValueError, match="live data has no start"):
        Times(is_live=True).find("+12.5", event_at(EVENING, boot=100.0))


def test_event_without_boot_time_is_relative_to_start() -> None:
    """An event without a time since boot is shown relative to the start of the recording, as `find` parses it."""
    event = event_at(40.0)
    assert (Times().clock(event), Times().text(event), Times.unit(Times().clock(event))) == (
        "start",
        "+40.000",
        "s since the start of the recording",
    )
    assert Times().find(Times().text(event), event) == 40.0


def test_timestamp_in_unix_time_is_shown_as_utc() -> None:
    """A timestamp that is Unix time, as from a simulator, is shown as UTC."""
    event = event_at(1.0, boot=EVENING)
    assert (Times().clock(event), Times().text(event)) == ("vehicle", "23:59:50.0")


def test_time_of_day_is_rounded_once() -> None:
    """59.96 s is shown as the next minute, not as 60.0 s."""
    assert Times(is_live=True).text(event_at(EVENING + 9.96)) == "00:00:00.0"
