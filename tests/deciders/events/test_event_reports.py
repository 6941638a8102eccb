"""Accounts as services answer them, and faults as they follow: hand-made messages and answers, in no other process."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import given

from nedbus.events import ALL, FORGOTTEN, AccountReport, Event, Expectation, faults_of, from_json, report_of, tell

from .flight import ARMED, Flight

NOTHING = Expectation()


def report(flight: Flight, *, service: str = "s", host: str = "h", within: float = 1e9) -> AccountReport:
    return report_of(flight.account, service, host, flight.now, within=within)


def flying(*, since: float = 1.0, **fields: Any) -> Flight:
    """Return a vehicle that has sent valid positions, and then these."""
    flight = Flight()
    flight.send()
    flight.fly(1)
    flight.wait(since).send(**fields)
    return flight


def through_json(given: AccountReport) -> AccountReport:
    """Return the report as a reader gets it."""
    read = from_json(json.loads(json.dumps(asdict(given))))
    assert read is not None
    return read


def test_report_comes_back_as_it_was() -> None:
    """Events with their evidence, states, and what holds: all of it goes through JSON."""
    flight = Flight()
    flight.send(z_valid=False)
    flight.gps()
    flight.gps(fix_type=0)
    flight.wait(1.0).send(z_valid=False, xy_valid=False)
    sent = report(flight)
    assert sent.events
    assert asdict(through_json(sent)) == asdict(sent)
    vehicle = sent.vehicles["1"]
    assert (vehicle.severity, vehicle.text, vehicle.since) == ("bad", "xy not valid", flight.now)
    assert vehicle.kinds == ("xy_invalid", "z_invalid", "gps_fix_lost")
    assert vehicle.flags == {"xy_valid": flight.now, "z_valid": 100.0}
    assert set(vehicle.topics) == {"vehicle_local_position", "vehicle_gps_position"}
    assert [(each.text, each.initial) for each in vehicle.held] == [("z not valid", True)]


def test_story_is_the_same_from_a_report() -> None:
    """A reader tells what the service itself would, also of what held before all events."""
    flight = flying(xy_valid=False)
    for within in (1e9, 0.0):
        read = through_json(report(flight, within=within))
        told = tell(read.events, read.vehicles["1"].held, topics=read.vehicles["1"].topics)
        assert [(each.what, each.since, each.until) for each in told] == [("xy not valid", flight.now, None)]


def test_report_is_bounded() -> None:
    """Of many events the last are answered, within a size that a reader accepts."""
    flight = Flight()
    flight.gps()
    for number in range(1500):
        flight.wait(0.1).status(ARMED, nav_state=number % 3)
    sent = report(flight)
    assert len(sent.events) == 300
    assert sent.events[-1].time == flight.now
    for number in range(3000):
        flight.wait(0.1).send(x=float(number % 2) * 50, xy_reset_counter=number % 256, xy_valid=number % 7 != 0)
    assert len(json.dumps(asdict(report(flight)))) < 2**18
    assert report(flight, within=math.nan).events == ()


def test_report_of_many_vehicles_is_read() -> None:
    """A service of a thousand vehicles, each bad and with all topics, answers what readers accept."""
    flight = Flight()
    topics = ["vehicle_gps_position", "vehicle_status", "battery_status", "estimator_status_flags", "failsafe_flags"]
    for number in range(1000):
        flight.send(vehicle=f"vehicle-{number}", xy_valid=False)
        for topic in topics:
            flight.account.vehicles[f"vehicle-{number}"].topics.add(topic)
    assert len(json.dumps(asdict(report(flight)))) < 2**20


@pytest.mark.parametrize(
    "content",
    [
        None, [], {}, "vehicles", {"vehicles": {}}, {"service": "s", "host": "h", "now": "x", "vehicles": {}},
        {"service": "s", "host": "h", "now": 1.0, "vehicles": [1]},
        {"service": "s", "host": "h", "now": 1.0, "vehicles": {"1": {"severity": "dire", "text": ""}}},
        {"service": "s", "host": "h", "now": 1.0, "vehicles": {}, "events": [{}]},
        {"service": "s", "host": "h", "now": 1.0, "vehicles": {}, "events": "x" * 1000},
    ],
)  # fmt: skip
def test_hostile_answer_is_none(content: object) -> None:
    """Anything that is no report is left out."""
    assert from_json(content) is None


def test_deep_answer_is_none() -> None:
    """Evidence of evidence of evidence does not break the reader."""
    event: dict[str, Any] = {
        "vehicle": "1", "kind": "jump", "change": "once", "severity": "info", "text": "", "time": 0.0
    }  # fmt: skip
    for _ in range(5000):
        event = event | {"evidence": [event]}
    assert from_json({"service": "s", "host": "h", "now": 1.0, "vehicles": {}, "events": [event]}) is None


def test_huge_answer_is_bounded() -> None:
    """No peer makes a reader keep more events and vehicles than a service answers."""
    event = asdict(Event("1", "jump", "once", "info", "", 0.0))
    content: dict[str, object] = {"service": "s", "host": "h", "now": 1.0, "vehicles": {}}
    assert from_json(content | {"events": [event] * 301}) is None
    vehicle = {"severity": "info", "text": "ok"}
    assert from_json(content | {"vehicles": {str(number): vehicle for number in range(1001)}}) is None
    read = from_json(content | {"events": [event] * 300, "vehicles": {str(number): vehicle for number in range(1000)}})
    assert read is not None


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=10,
)


@given(st.sampled_from(["events", "vehicles", "now", "service", "host"]), json_values)
def test_any_answer_is_a_report_or_none(name: str, value: object) -> None:
    """Whatever a peer puts into a field, nothing else is raised, and what is read can be told and judged."""
    content = json.loads(json.dumps(asdict(report(flying(xy_valid=False)))))
    read = from_json(content | {name: value})
    if read is not None:
        assert isinstance(faults_of([read], Expectation(vehicles=1, valid=("xy",), within=1.0)), list)
        assert isinstance(tell(read.events), list)


def test_well_vehicle_has_no_fault() -> None:
    """Nothing is wrong with one that is heard, as far as nobody expects more."""
    assert faults_of([report(flying())], NOTHING) == []
    expected = Expectation(("1",), 1, ("xy", "z", "vxy", "vz"), 60.0)
    assert faults_of([report(flying())], expected) == []
    assert faults_of([report(flying(xy_valid=False))], NOTHING) == []


def test_silent_vehicle_is_a_fault() -> None:
    """It is one for an hour; then it was switched off, unless somebody asks for it."""
    flight = flying()
    flight.wait(10.0).look("stale")
    line = "vehicle 1: silent: no vehicle_local_position for 10.0 s, since 00:01:42.0 UTC (10.0 s)"
    assert faults_of([report(flight)], NOTHING) == [line]
    flight.wait(FORGOTTEN - 11).look("stale")
    assert len(faults_of([report(flight)], NOTHING)) == 1
    flight.wait(2).look("stale")
    assert faults_of([report(flight)], NOTHING) == []
    asked = faults_of([report(flight)], Expectation(("1",)))
    assert asked == ["vehicle 1: silent: no vehicle_local_position for 10.0 s, since 00:01:42.0 UTC (60 min)"]


def test_vehicle_that_moved_is_heard() -> None:
    """One service lost it, another hears it, in whichever order they answer."""
    lost, found = flying(), flying()
    lost.wait(10.0).look("gone")
    reports = [report(lost, service="a"), report(found, service="b")]
    assert faults_of(reports, Expectation(("1",), 1)) == []
    assert faults_of(reports[::-1], Expectation(("1",), 1)) == []
    assert len(faults_of(reports[:1], Expectation(("1",), 1))) == 2


def test_expected_vehicles() -> None:
    """Those that are missing are named, and how many are heard; a vehicle of a script counts when it is heard."""
    one = report(flying())
    assert faults_of([one], Expectation(("1", "7"))) == ["vehicle 7 is missing: it has no publisher"]
    assert faults_of([one], Expectation(("1", "7")), heard=["7"]) == []
    assert faults_of([one], Expectation(vehicles=3), heard=["7"]) == ["2 of 3 vehicles are heard: 1, 7"]
    assert faults_of([], Expectation(vehicles=1)) == ["0 of 1 vehicles are heard"]
    assert faults_of([one], Expectation(("7",), valid=("xy",)), heard=["7"]) == []  # vehicle 1 is not judged


def test_other_hosts_are_not_judged() -> None:
    """Where nothing is expected of all hosts, those of this one are."""
    silent = flying()
    silent.wait(10.0).look("stale")
    assert faults_of([report(silent, host="other")], NOTHING, only="this") == []
    assert len(faults_of([report(silent, host="this")], NOTHING, only="this")) == 1


def test_flags_are_judged_since_they_fell() -> None:
    """All flags of a vehicle are one line, with the time of the first; not that of something else that is wrong."""
    flight = Flight()
    flight.send()
    flight.status(ARMED, failsafe=True)
    flight.wait(5.0).send(xy_valid=False)
    flight.wait(5.0).send(xy_valid=False, v_xy_valid=False)
    expected = Expectation(valid=("xy", "z", "vxy"))
    assert faults_of([report(flight)], expected) == [
        "vehicle 1: xy, vxy not valid, since 00:01:45.0 UTC (5.0 s)"
    ]  # fmt: skip
    assert faults_of([report(flight)], Expectation(valid=("z", "vz"))) == []


def test_vehicle_without_a_position() -> None:
    """Validity is asked for, and none of its messages tells it."""
    flight = Flight()
    flight.status(ARMED)
    assert faults_of([report(flight)], Expectation(valid=("xy",))) == ["vehicle 1: it sends no position"]


def test_what_happened_lately() -> None:
    """Nothing bad or to be watched may have happened in that time; info may."""
    flight = flying(xy_valid=False)
    flight.wait(1.0).send()
    lines = faults_of([report(flight)], Expectation(within=60.0))
    assert lines == ["vehicle 1: xy not valid, at 00:01:42.0 UTC, 1.0 s ago"]
    assert faults_of([report(flight)], Expectation(("2",), within=60.0), heard=["2"]) == []
    flight.fly(60)
    assert faults_of([report(flight)], Expectation(within=60.0)) == []
    flight.link = "no link to x"
    flight.look()
    assert faults_of([report(flight)], Expectation(("1",), within=60.0)) == [
        "h: no link to x, at 00:02:43.0 UTC, 0 ms ago"
    ]  # fmt: skip


def test_many_events_are_counted() -> None:
    """The first twenty are shown, the others counted."""
    events = tuple(Event(ALL, "lost", "once", "watch", f"{number} lost", float(number)) for number in range(30))
    lines = faults_of([replace(report(flying()), now=30.0, events=events)], Expectation(within=60.0))
    assert len(lines) == 21
    assert lines[-1] == "10 events more in the last 60 s"
