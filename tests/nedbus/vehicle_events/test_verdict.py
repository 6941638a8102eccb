"""Verdicts on a vehicle with synthetic messages."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from nedbus.flights import read_file_events
from nedbus.vehicle_events import (
    ALL,
    Condition,
    Event,
    Expectation,
    Times,
    Verdict,
    faults_of,
    from_json,
    report_of,
    verdict_of,
)  # fmt: skip
from nedbus.vehicle_events.detectors import Finding
from tests.flights.messages import VALID, VLP, message
from tests.flights.ulogs import UlogWriter

from .flight import ARMED, DISARMED, GOOD_GPS, ORIGIN, Flight, lose_gps

LIVE = Times(is_live=True)


def verdict(flight: Flight, *, times: Times | None = None, at: float | None = None) -> Verdict:
    """Return the current verdict, by default with times since boot."""
    followed = flight.event_log.vehicles["1"]
    events = sorted(flight.event_log.events_since(0)[0], key=lambda each: each.time)
    held = [each for each in followed.conditions.values() if each.severity != "info"]
    return verdict_of(
        "1", events, held, topics=followed.topics, times=times or Times(), end=flight.now, at=at
    )


def has_words(text: str, *words: str) -> bool:
    """Return whether a text has these words in this order."""
    start = 0
    for word in words:
        start = text.find(word, start) + len(word)
        if start < len(word):
            return False
    return True


def since_boot(*events: Event | None) -> list[float]:
    """Return the times of events, in seconds since boot."""
    return [round(event.time - Flight().booted, 3) for event in events if event is not None]


def test_verdict_on_active_fault_includes_evidence() -> None:
    """The verdict states the fault, its start, duration and clock, the evidence in order, and missing topics."""
    flight = Flight()
    lose_gps(flight)
    found = verdict(flight)
    assert has_words(
        found.text,
        "not usable",
        "xy",
        "vxy",
        "not valid",
        "16.000 s since boot",
        "until the end",
        "1.0 s",
    )
    assert has_words(
        found.text,
        "(1.0 s)",
        "11.000",
        "3D to none",
        "satellites 12 to 0",
        "12.000",
        "dead reckoning",
    )
    assert has_words(
        found.text, "dead reckoning", "Not in the data", "estimator_status_flags, failsafe_flags"
    )
    assert since_boot(found.begin, *found.cause) == [16.0, 11.0, 11.0, 12.0]
    assert (found.usable, found.end, len(found.stories)) == (False, None, 1)
    assert found.begin is not None
    assert found.begin.kind == "xy_invalid"
    assert [each.kind for each in found.cause] == [
        "gps_fix_lost",
        "few_satellites",
        "dead_reckoning",
    ]
    assert "UTC, until now (1.0 s)" in verdict(flight, times=LIVE).text


def test_verdict_names_the_latest_evidence() -> None:
    """Of much evidence before a fault, the text has the last three events, the cause all of them."""
    flight = Flight()
    flight.fly(1)
    flags: dict[str, Any] = {"cs_mag_fault": False, "reject_hor_pos": False, "cs_gnss_pos": True}
    flight.send("estimator_status_flags", instance=0, **flags)
    for name, value in flags.items():
        flags[name] = not value
        flight.wait(1.0).send("estimator_status_flags", instance=0, **flags)
    flight.wait(1.0).send(dead_reckoning=True)
    flight.wait(1.0).send(dead_reckoning=True, xy_valid=False)
    found = verdict(flight)
    assert [each.kind for each in found.cause] == [
        "estimator_fault", "innovation_rejected", "not_fused", "dead_reckoning",
    ]  # fmt: skip
    assert (
        "Evidence: 13.000 EKF rejects horizontal position; 14.000 EKF stopped fusing" in found.text
    )
    assert "15.000 dead reckoning" in found.text


def test_verdict_on_ended_fault_includes_start_and_end() -> None:
    """The verdict states the start and end of a fault that has ended."""
    flight = Flight()
    lose_gps(flight)
    flight.wait(1.0).send()
    found = verdict(flight)
    assert has_words(
        found.text, "not usable", "xy and vxy", "16.000", "18.000 s since boot", "2.0 s", "Evidence"
    )
    assert found.begin is not None
    assert found.end is not None
    assert (found.usable, found.begin.time, found.end.time) == (False, flight.now - 2.0, flight.now)


def test_live_verdict_begins_with_what_is_wrong_now() -> None:
    """Live, an active condition or a single event of the last minute comes before a worse fault that has ended."""
    flight = Flight()
    lose_gps(flight)
    flight.wait(1.0).send()
    flight.wait(0.1).gps()
    flight.wait(0.1).status(ARMED)
    found = verdict(flight, times=LIVE)
    assert found.text.startswith("was not usable: xy and vxy not valid from ")
    assert found.usable
    flight.fly(10)
    flight.send("failsafe_flags", fd_motor_failure=False)
    flight.wait(0.1).send("failsafe_flags", fd_motor_failure=True)
    flight.fly(1)
    found = verdict(flight, times=LIVE)
    assert found.text.startswith("position valid now, but failsafe flags: motor failure from ")
    assert "Also" in found.text
    assert "xy and vxy not valid" in found.text
    # in a file, the worst one
    assert verdict(flight).text.startswith("not usable: xy and vxy not valid")


@pytest.mark.parametrize(
    ("text", "level", "state", "is_fault"),
    [
        ("Baro sensor #0 failure: Timeout", 2, ARMED, True), ("MAG #0 failed: STALE!", 0, DISARMED, True),
        ("Mag sensor #1 failure: Stale data", 3, ARMED, True), ("Engine on fire", 2, ARMED, True),
        ("Engine on fire", 2, DISARMED, False), ("No manual control input", 4, ARMED, False),
    ],
)  # fmt: skip
def test_sensor_failures_and_critical_texts_in_flight_are_faults(
    text: str, level: int, state: int, *, is_fault: bool
) -> None:
    """PX4's text about a failed sensor, and any critical one while armed, is a fault; the position stays valid."""
    flight = Flight()
    flight.fly(1)
    flight.status(state)
    flight.send("log_message", severity=level, text=text)
    flight.fly(1)
    for times, since in (Times(), "throughout"), (LIVE, "now"):
        found = verdict(flight, times=times)
        assert found.usable
        assert found.text.startswith(f'position valid {since}, but PX4: "{text}" at ') == is_fault
        assert ("Evidence" in found.text, found.text.startswith("no faults")) == (
            False,
            not is_fault,
        )


def test_silence_lasts_from_the_last_message() -> None:
    """The period of a silence begins at the last message, not where the silence was noticed."""
    flight = Flight()
    flight.fly(5)
    flight.wait(3.5).update("stale")
    flight.wait(6.5).send()
    assert "from 15.000 to 25.000 s since boot (10.0 s)" in verdict(flight).text


def test_verdict_reports_absence_of_faults() -> None:
    """A verdict without faults states the period, and whether the data lacks position validity."""
    flight = Flight()
    flight.fly(5)
    found = verdict(flight)
    assert (found.usable, found.stories) == (True, ())
    assert has_words(found.text, "no faults", "105 s")
    assert has_words(verdict(flight, times=LIVE).text, "no faults", "history")
    assert all(
        "position validity" not in verdict(flight, times=times).text for times in (Times(), LIVE)
    )
    unknown = verdict_of("1", [], topics=["vehicle_attitude"], times=Times(), end=5.0)
    assert (unknown.usable, "the data has no position validity" in unknown.text) == (None, True)
    assert "satellite" not in unknown.text
    satellite = verdict_of("1", [], topics=["vehicle_global_position"], times=Times(), end=5.0)
    assert "only a global position, as over a satellite link (HIGH_LATENCY2)" in satellite.text


def test_verdict_without_validity_flags_is_unknown() -> None:
    """For a position without validity flags, as from ArduPilot, `usable` is None."""
    flight = Flight()
    for _ in range(5):
        flight.wait(0.1).send(missing=("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"))
    (known,) = report_of(flight.event_log, "s", "h", flight.now, within=60).vehicles.values()
    found = verdict_of("1", [], topics=known.topics, unknown=known.unknown, times=Times(), end=0.5)
    assert found.usable is None
    assert has_words(found.text, "no faults", "0 s", "no position validity")


def test_watch_condition_leaves_vehicle_usable() -> None:
    """A vehicle with a condition of severity "watch" stays usable."""
    flight = Flight()
    flight.gps()
    flight.fly(1)
    flight.gps(jamming_indicator=100)
    flight.fly(5)
    flight.gps()
    found = verdict(flight)
    assert found.usable is True
    assert has_words(found.text, "position valid", "GNSS jamming", "100", "11.000", "16.000 s")
    assert since_boot(found.begin, found.end) == [11.0, 16.0]


def px4_text(flight: Flight, words: str, level: int = 4) -> None:
    """Emit a PX4 text."""
    severity: Any = "bad" if level < 3 else "watch" if level < 5 else "info"
    said = Finding("text", "once", words, ("warning",), {"level": level}, severity)
    flight.event_log.vehicles["1"].emit(said, "log_message", flight.now)


def test_evidence_of_end_is_later_than_begin() -> None:
    """Neither a GPS fix regained before the position became invalid nor a PX4 text explains the end of the fault."""
    flight = Flight()
    flight.gps(fix_type=0)
    flight.fly(1)
    flight.gps()
    flight.wait(1.0).send(xy_valid=False)
    flight.wait(2.0).send()
    ended = flight.event_log.events_since(0)[0][-1]
    assert (ended.kind, ended.change, ended.evidence) == ("xy_invalid", "end", ())
    assert "GPS" not in verdict(flight).text
    flight.wait(1.0).send(xy_valid=False)
    px4_text(flight, "Failsafe activated")
    flight.wait(2.0).send()
    assert flight.event_log.events_since(0)[0][-1].evidence == ()


def test_verdict_quotes_px4() -> None:
    """PX4's texts are evidence in chronological order, except texts that already appeared before the fault."""
    flight = Flight()
    flight.send()
    for _ in range(3):
        px4_text(flight, "No manual control input", 3)
        flight.fly(6)
    px4_text(flight, "No manual control input", 3)
    flight.wait(1.0).send(dead_reckoning=True)
    px4_text(flight, "GNSS fix too low")
    flight.wait(1.0).send(dead_reckoning=True, xy_valid=False)
    flight.wait(0.2)
    px4_text(flight, "Failsafe activated", 2)
    flight.wait(5.0).send(xy_valid=False)
    found = verdict(flight)
    assert has_words(
        found.text,
        "not usable",
        "xy not valid",
        "30.000 s since boot",
        "until the end",
        "5.2 s",
        "Evidence",
    )
    evidence = found.text.partition("Evidence")[2]
    assert has_words(
        evidence,
        "29.000",
        'PX4: "GNSS fix too low"',
        "dead reckoning",
        "30.200",
        'PX4: "Failsafe activated"',
    )
    assert has_words(evidence, "Failsafe activated", "Not in the data", "vehicle_gps_position")
    assert "No manual control input" not in found.text
    assert since_boot(found.begin, *found.cause) == [30.0, 29.0, 29.0, 30.2]


def test_unrelated_events_are_evidence_without_a_known_cause() -> None:
    """Without a known cause, all events shortly before a fault are shown, except phases of the flight."""
    flight = Flight()
    flight.status(ARMED)
    flight.send("failsafe_flags", fd_critical_failure=False)
    flight.send(heading_good_for_control=True)
    flight.wait(0.5).send(heading_good_for_control=False)
    flight.wait(0.5).status(ARMED, nav_state=3)
    flight.send("failsafe_flags", fd_critical_failure=True)
    found = verdict(flight)
    assert "failsafe flags: attitude or altitude limit exceeded" in found.text
    assert [each.kind for each in found.cause] == ["heading_not_good"]


def condition_of(kind: str, flag: str, words: str, since: float = 0.0) -> Condition:
    """Return a condition that was active in the first message."""
    begin = Event("1", kind, "begin", "watch", words, since, 10.0, names=(flag,))
    return Condition(kind, "watch", words, since, begin, initial=True)


def test_missing_global_reference_of_a_whole_flight_is_no_fault() -> None:
    """A flight without GNSS has no fault, only a note on it; it is evidence if the position was never valid."""
    conditions = [
        condition_of("gps_fix_lost", "", "no GPS fix"),
        condition_of("xy_not_global", "xy_global", "xy has no global reference", 0.1),
    ]  # fmt: skip
    topics = ["vehicle_local_position", "vehicle_gps_position"]
    found = verdict_of("1", [], conditions, topics=topics, times=Times(), end=62.0)
    assert found.text == "no faults in 62 s; throughout: no GPS fix, xy has no global reference"
    assert (found.usable, found.stories, found.begin, found.end) == (True, (), None, None)
    invalid = replace(condition_of("xy_invalid", "xy_valid", "xy not valid"), severity="bad")
    found = verdict_of("1", [], [*conditions, invalid], topics=topics, times=Times(), end=62.0)
    assert has_words(
        found.text, "not usable", "xy not valid", "first message", "until the end", "62.0 s"
    )
    assert [each.kind for each in found.cause] == ["gps_fix_lost"]
    assert (found.usable, len(found.stories)) == (False, 1)


@pytest.mark.parametrize(
    ("steps", "cause"),
    [
        ([lambda f: f.send(xy_valid=False), lambda f: f.status(ARMED, failsafe=True)], "xy not valid"),
        (
            [lambda f: f.send(xy_valid=False), lambda f: f.status(ARMED, failsafe=True), lambda f: f.send()],
            "failsafe",
        ),
        ([lambda f: f.send(xy_valid=False)] * 2 + [lambda f: f.update("gone")], "gone: no publisher of "),
        ([lambda f: f.update("gone"), lambda f: f.update("ok"), lambda f: f.send(z_valid=False)], "z not valid"),
        ([lambda f: f.send(dead_reckoning=True), lambda f: f.battery(2)], "battery "),
    ],
)  # fmt: skip
def test_state_and_verdict_name_the_same_cause(
    steps: list[Callable[[Flight], object]], cause: str
) -> None:
    """An active invalid position is named before the failsafe, and a gone vehicle before both."""
    flight = Flight()
    flight.send()
    for step in steps:
        step(flight.wait(1.0))
    assert flight.event_log.state("1", flight.now).text.startswith(cause)
    assert verdict(flight, times=LIVE).text.removeprefix("not usable: ").startswith(cause)


def test_verdict_is_limited_to_vehicle_and_time() -> None:
    """Events of other vehicles are ignored; with `at`, the verdict is on the fault at that time."""
    flight = Flight()
    lose_gps(flight)
    flight.wait(1.0).send()
    flight.status(ARMED)
    flight.gps()
    flight.fly(60)
    events = flight.event_log.events_since(0)[0]
    other: list[Any] = [replace(each, vehicle="2") for each in events]
    topics = ["vehicle_local_position"]
    assert verdict_of("1", other, topics=topics, times=LIVE, end=flight.now).stories == ()
    assert verdict_of(
        "1", [replace(other[0], vehicle=ALL)], topics=topics, times=LIVE, end=flight.now
    ).stories
    assert has_words(verdict(flight, at=flight.now - 30).text, "no fault at that time", "nearest")
    assert verdict(flight, at=flight.now - 30).usable is True
    found = verdict(flight, at=107.0)
    assert has_words(
        found.text, "not usable", "xy and vxy not valid", "16.000", "18.000 s since boot"
    )
    assert since_boot(found.begin, found.end) == [16.0, 18.0]


def test_verdict_on_never_valid_vehicle_quotes_px4() -> None:
    """If a fault has been active since the first message, PX4's most severe text is evidence, however late it is."""
    flight = Flight()
    flight.send(xy_valid=False)
    px4_text(flight, "Preflight Fail: GPS Vertical Pos Drift too high", 4)
    flight.wait(30.0).send(xy_valid=False)
    px4_text(flight, "Preflight Fail: ekf2 missing data", 2)
    found = verdict(flight)
    assert has_words(
        found.text, "not usable", "xy not valid", "first message", "until the end", "30.0 s"
    )
    assert has_words(
        found.text,
        "Evidence",
        "40.000",
        'PX4: "Preflight Fail: ekf2 missing data"',
        "Not in the data",
    )
    assert "GPS Vertical Pos Drift" not in found.text
    assert (found.usable, found.begin, since_boot(*found.cause)[-1]) == (False, None, 40.0)


def test_verdict_counts_equal_faults() -> None:
    """The longest of several equal faults is the worst, and the verdict states their number."""
    flight = Flight()
    flight.send()
    for seconds in (1.0, 3.0, 2.0):
        flight.wait(20.0).send(xy_valid=False)
        flight.wait(seconds).send()
    found = verdict(flight)
    assert has_words(
        found.text,
        "not usable",
        "xy not valid",
        "one of 3",
        "51.000",
        "54.000 s since boot",
        "3.0 s",
    )
    assert since_boot(found.begin, found.end) == [51.0, 54.0]
    assert [each.spans[0].kind for each in found.stories] == ["xy_invalid"] * 3


def test_shortened_evidence_prefers_sensor_events() -> None:
    """If only part of the evidence fits, events of sensors precede those of the estimator."""
    flight = Flight()
    for _ in range(3):
        flight.gps()
        flight.fly(20.0)
        flight.send(dead_reckoning=True)
        flight.gps(fix_type=0, satellites_used=0)
        flight.wait(5.0).send(dead_reckoning=True, xy_valid=False, v_xy_valid=False)
        flight.wait(1.0).send()
    text = verdict(flight).text
    assert "(one of 3)" in text
    assert "satellites 12 to 0, dead reckoning" in text
    assert "only 0 satellites" not in text, "the lost fix says it"
    assert text.index("GPS fix lost") < text.index("dead reckoning")


def test_verdict_fits_three_lines() -> None:
    """Long PX4 texts are truncated: a verdict has at most three lines of 100 columns."""
    flight = Flight()
    flight.send()
    for number in range(40):
        px4_text(flight, f"{number} " + "very long " * 12)
    flight.wait(0.1).send(xy_valid=False, v_xy_valid=False, z_valid=False, v_z_valid=False)
    assert len(textwrap.wrap(f"1: {verdict(flight).text}", 100, subsequent_indent="   ")) <= 3


def test_simultaneous_px4_texts_are_separate_events() -> None:
    """Texts with equal times are separate events of origin px4, in quotes, and survive a JSON report."""
    flight = Flight()
    flight.send()
    for words in ("invalid setpoints", "Failsafe: blind land"):
        px4_text(flight, words)
    flight.wait(0.1).send(xy_valid=False)
    sent = report_of(flight.event_log, "s", "h", flight.now, within=60)
    read = from_json(json.loads(json.dumps(asdict(sent))))
    assert read is not None
    assert [each.words for each in read.events if each.origin == "px4"] == [
        'PX4: "invalid setpoints"', 'PX4: "Failsafe: blind land"',
    ]  # fmt: skip
    assert len({each.identity for each in read.events}) == len(read.events) == 3
    held = list(read.vehicles["1"].held)
    found = verdict_of(
        "1", read.events, held, topics=read.vehicles["1"].topics, times=LIVE, end=read.now
    )
    assert 'PX4: "invalid setpoints", PX4: "Failsafe: blind land"' in found.text


WILD: list[tuple[str, dict[str, Any]]] = [
    *(
        (VLP, {flag: False})
        for flag in ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid", "xy_global", "z_global")
    ),
    (VLP, {"dead_reckoning": True}),
    (VLP, {"xy_valid": False, "z_valid": False, "dead_reckoning": True}),
    (VLP, {"ref_lat": -33.0, "ref_lon": 151.0, "ref_timestamp": 9}),
    (VLP, {"xy_reset_counter": 77}),
    (VLP, {"x": 1e6}),
    ("vehicle_gps_position", {"fix_type": 0}),
    ("vehicle_gps_position", {"fix_type": 0, "satellites_used": 0}),
    ("vehicle_gps_position", {"jamming_state": 3}),
    ("vehicle_gps_position", {"spoofing_state": 3}),
    ("battery_status", {"warning": 3}),
    ("battery_status", {"warning": 4}),
]
SOUND: dict[str, dict[str, Any]] = {
    VLP: {}, "vehicle_gps_position": GOOD_GPS, "battery_status": {"warning": 0, "remaining": 0.2, "connected": True},
}  # fmt: skip


def fly_all(flight: Flight, topic: str = "", wild: dict[str, Any] | None = None) -> None:
    """Send one message of each topic, one of them with wild values, and wait for the next ones."""
    for name, fields in SOUND.items():
        flight.send(name, **fields | (wild or {} if name == topic else {}))
    flight.wait(0.1)


@pytest.mark.parametrize("position", ["middle", "second"])
@pytest.mark.parametrize(("topic", "wild"), WILD)
def test_one_wild_message_is_no_fault(topic: str, wild: dict[str, Any], position: str) -> None:
    """A flag, fix, warning, origin, counter or position wrong in one message is no fault, state or failed check."""
    flight = Flight()
    flight.status(ARMED)
    for _ in range(20 if position == "middle" else 1):
        fly_all(flight)
    healthy = {each.kind for each in flight.event_log.state("1", flight.now).conditions}
    fly_all(flight, topic, wild)
    for _ in range(20):
        fly_all(flight)
    assert verdict(flight).text.startswith("no faults")
    assert {each.kind for each in flight.event_log.state("1", flight.now).conditions} == healthy
    report = report_of(flight.event_log, "s", "h", flight.now, within=60)
    read = from_json(json.loads(json.dumps(asdict(report))))
    assert read is not None
    assert faults_of([read], Expectation(within=60)) == []


@pytest.mark.parametrize(("topic", "wild"), [*WILD[:4], *WILD[6:9], *WILD[11:]])
def test_two_wrong_messages_are_a_fault(topic: str, wild: dict[str, Any]) -> None:
    """What a second message confirms, or the only message of 0.5 s has, is a fault that begins with the first one."""
    for count, pause in ((2, 0.1), (1, 0.5)):
        flight = Flight()
        flight.status(ARMED)
        for number in range(20):
            if number == 10:
                began = flight.now
            for name, fields in SOUND.items():
                flight.send(
                    name, **fields | (wild if name == topic and 10 <= number < 10 + count else {})
                )
            flight.wait(pause)
        found = verdict(flight)
        assert found.begin is not None, found.text
        assert (found.begin.time, found.begin.topic) == (began, topic)


def test_wild_message_is_no_evidence() -> None:
    """A GPS fix lost in one message does not explain a fault that follows."""
    flight = Flight()
    for wild in ({}, {"fix_type": 0}, {}, {}):
        fly_all(flight, "vehicle_gps_position", wild)
    flight.send(xy_valid=False)
    flight.wait(0.1).send(xy_valid=False)
    found = verdict(flight)
    assert found.begin is not None
    assert found.begin.kind == "xy_invalid"
    assert found.cause == ()


@pytest.mark.parametrize(
    "wild", [{"xy_valid": False}, {"ref_lat": -33.0, "ref_timestamp": 9}, {"z_valid": False}]
)
def test_one_wild_message_of_a_log_is_no_fault(tmp_path: Path, wild: dict[str, Any]) -> None:
    """In a log at 50 Hz, one wild message is no fault, unlike two of them."""
    for count in (1, 2):
        writer = UlogWriter()
        writer.define([VLP])
        for number in range(200):
            fields = VALID | ORIGIN | (wild if 100 <= number < 100 + count else {})
            writer.add(VLP, message(1_000_000 + 20_000 * number, **fields))
        read = read_file_events(writer.write(tmp_path / f"{count}.ulg"))
        topics = read.event_log.vehicles["1"].topics
        found = verdict_of(
            "1", read.event_log.events, topics=topics, times=read.times, end=read.end
        )
        assert len(read.event_log.events) == 2
        assert found.text.startswith("no faults") == (count == 1)


def reset_and_switch(*before: Event) -> list[Event]:
    """Return events of a change of the EKF and a reset one second later, after others."""
    return [
        *before,
        Event("1", "ekf_changed", "once", "watch", "primary EKF changed from 0 to 1", 100.0),
        Event(
            "1",
            "reset",
            "once",
            "watch",
            "reset of xy by 31.9 m",
            101.0,
            names=("xy",),
            numbers={"north": 31.9},
        ),
    ]


OVERLOAD = [
    Event(ALL, "overload", "begin", "watch", "reader overloaded", 50.0),
    Event(ALL, "overload", "end", "info", "reader caught up", 55.0),
]
NO_ORIGIN = [
    Event(
        "1",
        "xy_not_global",
        "begin",
        "watch",
        "xy has no global reference",
        20.0,
        names=("xy_global",),
    )
]


@pytest.mark.parametrize(
    "before", [[], OVERLOAD, NO_ORIGIN], ids=["alone", "overload", "no_origin"]
)
@pytest.mark.parametrize("times", [Times(), LIVE], ids=["file", "live"])
def test_what_changed_the_estimate_leads(before: list[Event], times: Times) -> None:
    """A reset leads, with the change of the EKF as evidence, beside an ended fault and a lasting minor condition."""
    topics = ("vehicle_local_position", "estimator_selector_status", "vehicle_gps_position")
    found = verdict_of("1", reset_and_switch(*before), topics=topics, times=times, end=110.0)
    since = "now" if times.is_live else "throughout"
    assert found.text.startswith(f"position valid {since}, but reset of xy by 31.9 m ")
    assert has_words(found.text, "Evidence", "primary EKF changed from 0 to 1")
    assert len(found.stories) == 1 + bool(before)


def test_large_reset_in_flight_makes_the_vehicle_unusable() -> None:
    """A reset of 10 m or more while armed is bad; while disarmed, or as the recovery of an invalid estimate, it is not.

    The text names only the quantities that moved that far.
    """
    for state, invalid, usable in (
        (ARMED, False, False),
        (DISARMED, False, True),
        (ARMED, True, False),
    ):
        flight = Flight()
        flight.status(state)
        flight.fly(2)
        for _ in range(2):
            flight.wait(0.1).send(xy_valid=not invalid)
        flight.wait(0.1).send(x=20.0, xy_reset_counter=1, z=0.6, z_reset_counter=1)
        for _ in range(10):
            flight.wait(0.1).send(x=20.0, xy_reset_counter=1, z=0.6, z_reset_counter=1)
        (reset,) = [event for event in flight.event_log.events if event.kind == "reset"]
        assert reset.severity == ("watch" if invalid else "bad" if state == ARMED else "info")
        found = verdict(flight)
        assert found.usable is usable
        if state == ARMED and not invalid:
            assert found.text.startswith(
                "not usable: reset of xy by 20.0 m (20.0 north, 0.0 east) at "
            )


@pytest.mark.parametrize(
    ("tenths", "severity"), [(5, "watch"), (9, "watch"), (12, "bad"), (25, "bad")]
)
def test_large_reset_is_a_recovery_for_a_second_after_an_invalid_estimate(
    tenths: int, severity: str
) -> None:
    """A reset of 10 m that follows the end of an invalid estimate within a second recovers it; a later one is bad."""
    flight = Flight()
    flight.status(ARMED)
    flight.fly(2)
    for _ in range(10):
        flight.wait(0.1).send(xy_valid=False)
    flight.wait(0.1).send()  # valid again
    for _ in range(tenths - 1):
        flight.wait(0.1).send()
    flight.wait(0.1).send(x=20.0, xy_reset_counter=1)
    [reset] = [event for event in flight.event_log.events if event.kind == "reset"]
    assert reset.severity == severity


@pytest.mark.parametrize(("distance", "is_named"), [(20.0, True), (9.0, False)])
def test_large_correction_at_the_end_of_a_fault_is_named(
    distance: float, *, is_named: bool
) -> None:
    """A reset of 10 m or more that recovers an invalid estimate is no fault, but in the verdict, by its size."""
    flight = Flight()
    flight.status(ARMED)
    flight.fly(2)
    for _ in range(10):
        flight.wait(0.1).send(xy_valid=False)
    for _ in range(10):
        flight.wait(0.1).send(x=distance, xy_reset_counter=1)
    found = verdict(flight)
    assert [story.kind for story in found.stories] == ["xy_invalid"]
    assert (f" reset of xy by {distance:.1f} m." in found.text) == is_named


def test_reset_during_a_lesser_fault_stays_a_fault() -> None:
    """What corrected the estimate is not part of a fault that left it sound, unlike other consequences of that."""
    flight = Flight()
    flight.status(ARMED)
    flight.send("estimator_status_flags", instance=0, cs_ev_pos=True)
    flight.fly(2)
    flight.wait(0.1).send(dead_reckoning=True)
    flight.wait(0.1).send(dead_reckoning=True, x=2.0, xy_reset_counter=1)
    flight.send("failsafe_flags", local_position_invalid=False)
    for _ in range(10):
        flight.wait(0.1).send(x=2.0, xy_reset_counter=1)
    assert [story.kind for story in verdict(flight).stories] == ["dead_reckoning", "reset"]


def test_text_from_before_arming_is_no_evidence() -> None:
    """A failed check of the ground explains nothing in flight, unlike a text about a failed sensor."""
    flight = Flight()
    flight.status(DISARMED)
    flight.fly(1)
    px4_text(flight, "No heading reference")
    px4_text(flight, "Baro sensor #0 failure: Timeout")
    flight.wait(1.0).status(ARMED)
    flight.fly(2)
    for _ in range(10):
        flight.wait(0.1).send(dead_reckoning=True)
    [story] = [story for story in verdict(flight).stories if story.kind == "dead_reckoning"]
    assert [event.text for event in story.before] == ["Baro sensor #0 failure: Timeout"]


def test_fault_in_flight_leads_before_one_on_the_ground() -> None:
    """In a file, a fault between take-off and disarming leads before a worse one on the ground; live, the present one.

    The ground began again in a simulation of PX4: its log had a hole after the landing.
    """
    flight = Flight()
    flight.status(ARMED)
    flight.send("vehicle_land_detected", landed=True)
    flight.fly(2)
    flight.send("vehicle_land_detected", landed=False)
    flight.fly(2)
    flight.send(dead_reckoning=True)
    flight.wait(1.0).send()
    flight.fly(2)
    flight.status(DISARMED)
    flight.fly(20)
    flight.wait(6.0).update("stale")
    flight.send()
    flight.fly(1)
    found = verdict(flight)
    assert found.text.startswith("position valid throughout, but dead reckoning from ")
    assert has_words(found.text, "Also", "silent: no vehicle_local_position")
    assert [story.in_flight for story in found.stories] == [True, False]


def test_cause_within_half_a_second_after_the_fault_is_evidence() -> None:
    """Of other topics, which differ in rate, what changes within 0.5 s after the fault is its evidence, not "Also"."""
    for delay, kinds in ((0.3, ["not_fused"]), (0.7, [])):
        flight = Flight()
        flight.status(ARMED)
        flight.send("estimator_status_flags", instance=0, cs_ev_pos=True)
        flight.fly(1)
        flight.send(dead_reckoning=True)
        flight.wait(delay).send("estimator_status_flags", instance=0, cs_ev_pos=False)
        flight.wait(0.1).send(dead_reckoning=True)
        found = verdict(flight)
        assert [event.kind for event in found.cause] == kinds
        assert ("Also" in found.text) == (not kinds)


def test_evidence_is_nearest_in_kind_before_nearest_in_time() -> None:
    """Texts about the sensor that fails are quoted before later ones about others; recovered conditions are not."""
    flight = Flight()
    flight.status(ARMED)
    flight.send("estimator_status_flags", instance=0, reject_hor_pos=False, cs_baro_fault=False)
    flight.fly(1)
    flight.send("estimator_status_flags", instance=0, reject_hor_pos=True, cs_baro_fault=False)
    flight.wait(1.0).send(
        "estimator_status_flags", instance=0, reject_hor_pos=False, cs_baro_fault=False
    )
    flight.wait(1.0)
    px4_text(flight, "Compass 0 inconsistent")
    for words in ("GPS 0 lost", "Airspeed low", "Battery hot", "Wind high"):
        flight.wait(1.0)
        px4_text(flight, words)
    flight.wait(1.0).send(
        "estimator_status_flags", instance=0, reject_hor_pos=False, cs_mag_fault=True
    )
    flight.wait(0.1).send(
        "estimator_status_flags", instance=0, reject_hor_pos=False, cs_mag_fault=False
    )
    flight.wait(0.1).send(
        "estimator_status_flags", instance=0, reject_hor_pos=False, cs_mag_fault=True
    )
    found = verdict(flight, times=LIVE)
    assert found.text.startswith("position valid now, but EKF fault: magnetometer")
    evidence = found.text.partition("Evidence")[2].partition("Also")[0]
    assert has_words(evidence, "Compass 0 inconsistent", "Wind high")
    assert "Airspeed" not in evidence
    assert "rejects" not in evidence


def test_live_verdict_tells_since_when() -> None:
    """A service that was restarted knows the vehicle only since its first message, and its verdict says so."""
    flight = Flight()
    flight.fly(30)
    (known,) = report_of(flight.event_log, "s", "h", flight.now, within=60).vehicles.values()
    assert known.first == pytest.approx(100.1)
    sound = verdict_of("1", [], topics=known.topics, times=LIVE, end=flight.now, since=known.first)
    assert sound.text == "no faults since 00:01:40.1 UTC (29.9 s)"
    found = verdict_of(
        "1", reset_and_switch(), topics=known.topics, times=LIVE, end=flight.now, since=known.first
    )
    assert found.text.startswith("position valid since 00:01:40.1 UTC, but reset of xy by 31.9 m ")


def test_live_verdict_excludes_the_time_without_a_position() -> None:
    """The position is valid since its first message, or since an estimate that was invalid at first became valid."""
    flight = Flight()
    flight.battery(0)
    flight.wait(10.0).send(xy_valid=False)
    flight.wait(5.0).send(xy_valid=True)
    flight.status(ARMED)
    flight.fly(5)
    px4_text(flight, "Baro sensor #0 failure: Timeout")
    (known,) = report_of(flight.event_log, "s", "h", flight.now, within=60).vehicles.values()
    assert known.first == 110.0
    events = flight.event_log.events
    found = verdict_of(
        "1", events, topics=known.topics, times=LIVE, end=flight.now, since=known.first
    )
    assert found.text.startswith(
        'position valid since 00:01:55.0 UTC, but PX4: "Baro sensor #0 failure: Timeout" at '
    )


def test_condition_that_had_recovered_is_no_evidence() -> None:
    """A condition that ended more than a second before a fault does not explain it, unlike one that lasts."""
    flight = Flight()
    flight.gps()
    flight.fly(1)
    flight.gps(fix_type=0)
    flight.wait(1.0).gps()
    flight.wait(3.0).send(dead_reckoning=True)
    flight.wait(2.0).send(dead_reckoning=True, xy_valid=False)
    flight.wait(1.0).send(dead_reckoning=True, xy_valid=False)
    [story] = [story for story in verdict(flight).stories if story.kind == "xy_invalid"]
    assert [event.kind for event in story.before] == ["dead_reckoning"]


def test_texts_on_one_injected_failure_are_quoted_once() -> None:
    """PX4 reports an injected failure in the words of the command and of each driver."""
    flight = Flight()
    flight.status(ARMED)
    flight.fly(1)
    px4_text(flight, "Failure injection: GPS off")
    px4_text(flight, "CMD_INJECT_FAILURE, gnss off")
    flight.wait(1.0).send(xy_valid=False)
    flight.wait(1.0).send(xy_valid=False)
    assert verdict(flight).text.lower().count("inject") == 1


def test_warning_long_after_the_start_of_a_fault_is_no_evidence() -> None:
    """A text is evidence for a fault until a second after its start."""
    flight = Flight()
    flight.status(ARMED)
    flight.fly(1)
    flight.send(xy_valid=False)
    flight.wait(0.5)
    px4_text(flight, "GPS 0 lost")
    flight.wait(2.0)
    px4_text(flight, "Battery hot")
    flight.wait(1.0).send(xy_valid=False)
    assert [event.text for event in verdict(flight).cause] == ["GPS 0 lost"]


def test_second_bad_fault_is_named_before_a_large_correction() -> None:
    """Of what else happened, another bad fault comes first, then the largest correction."""
    flight = Flight()
    flight.status(ARMED)
    flight.fly(2)
    for tenth in range(80):
        fields: dict[str, Any] = {"xy_valid": tenth >= 40, "z_valid": not 20 <= tenth < 60}
        if tenth >= 40:
            fields |= {"x": 20.0, "xy_reset_counter": 1}
        flight.wait(0.1).send(**fields)
    found = verdict(flight)
    assert len(found.stories) == 2
    assert has_words(found.text, "Also", "not valid", "reset of xy by 20.0 m")
