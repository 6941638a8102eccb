"""Event reports, and faults found in them, from synthetic messages and replies."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import given

from nedbus import limits
from nedbus.client import ServiceStatus, SourceStatus, StreamHealth, StreamStatus, reply_parts
from nedbus.monitoring.pages import vehicles_page
from nedbus.timings import TIMINGS
from nedbus.vehicle_events import (
    ALL,
    AccountReport,
    Event,
    Expectation,
    Severity,
    VehicleReport,
    by_vehicle,
    faults_of,
    from_json,
    joined,
    rank_vehicle,
    report_of,
    stories_of,
)
from tests.flights.messages import VLP

from .flight import ARMED, Flight

NOTHING = Expectation()
SCRIPT = AccountReport("", "h", 0.0, {"7": VehicleReport("info", "ok", has_position=True)})


def report(
    flight: Flight, *, service: str = "s", host: str = "h", within: float = 1e9
) -> AccountReport:
    return report_of(flight.event_log, service, host, flight.now, within=within)


def flying(*, since: float = 1.0, **fields: Any) -> Flight:
    """Return a vehicle that has sent valid positions, then a message with these fields."""
    flight = Flight()
    flight.send()
    flight.fly(1)
    flight.wait(since).send(**fields)
    return flight


def through_json(given: AccountReport) -> AccountReport:
    """Return the report as a reader receives it."""
    read = from_json(json.loads(json.dumps(asdict(given))))
    assert read is not None
    return read


def test_report_json_round_trip() -> None:
    """Events with evidence, states and active conditions are equal after JSON encoding and decoding."""
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


def test_story_from_report_equals_story_of_service() -> None:
    """A story from a report equals the service's own story, even for conditions older than all events."""
    flight = flying(xy_valid=False)
    for within in (1e9, 0.0):
        read = through_json(report(flight, within=within))
        stories = stories_of(read.events, read.vehicles["1"].held, topics=read.vehicles["1"].topics)
        assert [(each.what, each.since, each.until) for each in stories] == [
            ("xy not valid", flight.now, None)
        ]


def test_report_has_all_events_of_its_period() -> None:
    """A report contains all kept events of the period, and no events for a period of NaN."""
    flight = Flight()
    for number in range(1500):
        flight.wait(0.1).status(ARMED, nav_state=number % 20)
    sent = report(flight)
    assert len(sent.events) == 1499
    assert sent.events[-1].time == flight.now
    assert report(flight, within=math.nan).events == ()


def test_evidence_has_the_clock_of_its_event() -> None:
    """In a report, the times of events and of their evidence are Unix times, so that their distance remains."""
    flight = flying(dead_reckoning=True)
    flight.wait(3.0).send(dead_reckoning=True, xy_valid=False)
    sent = report_of(flight.event_log, "s", "h", flight.now, within=1e9, to_utc=1.7e9)
    invalid = through_json(sent).events[-1]
    [cause] = invalid.evidence
    assert (invalid.kind, cause.kind) == ("xy_invalid", "dead_reckoning")
    assert (invalid.time, cause.time) == pytest.approx(
        (1.7e9 + flight.now, 1.7e9 + flight.now - 3.0)
    )


def test_topics_of_a_vehicle_are_limited_to_those_of_a_verdict() -> None:
    """A report names at most 30 topics, first those that decide whether evidence and position are missing."""
    flight = flying(xy_valid=False)
    for number in range(100):
        flight.send(f"a_{number}", x=1)
    flight.gps()
    flight.status(ARMED)
    topics = report(flight).vehicles["1"].topics
    assert len(topics) == 30
    assert {VLP, "vehicle_gps_position", "vehicle_status"} <= {*topics}
    [story] = stories_of(flight.event_log.events, topics=topics)
    assert story.lacking == ("estimator_status_flags", "failsafe_flags")


@pytest.mark.slow
def test_large_report_is_sent_in_parts() -> None:
    """A report of 1,000 vehicles is split into parts below the size limit, which join to the same report."""
    flight = Flight()
    steps: list[dict[str, Any]] = [
        {},
        {"xy_valid": False},
        {"xy_valid": False, "z_valid": False, "v_xy_valid": False},
    ]
    for faults in steps:
        for number in range(limits.VEHICLES):
            flight.send(vehicle=f"vehicle-{number}", **faults)
    sent = report(flight)
    parts = list(reply_parts(sent))
    assert sum(map(len, parts)) > 2 * limits.REPLY_BYTES
    assert max(map(len, parts)) <= limits.REPLY_BYTES
    read = [from_json(json.loads(part)) for part in parts]
    assert asdict(joined([each for each in read if each])) == asdict(sent)


def test_large_status_is_split_by_source() -> None:
    """A large status is split between sources; a single source that is too large omits the health of its streams."""
    address = f"{'v' * 60}/{VLP}"
    stream = StreamStatus(address, StreamHealth(VLP).snapshot(0))
    sources = tuple(
        SourceStatus(f"ulog:{number}", addresses=(address,) * 100) for number in range(100)
    )
    parts = [json.loads(part) for part in reply_parts(ServiceStatus("s", sources=sources))]
    assert len(parts) > 1
    assert [each["source"] for part in parts for each in part["sources"]] == [
        each.source for each in sources
    ]
    [part] = reply_parts(
        ServiceStatus("s", sources=(replace(sources[0], streams=(stream,) * 1000),))
    )
    assert [len(each["streams"]) for each in json.loads(part)["sources"]] == [0]


def test_vehicle_with_too_large_report_is_omitted(caplog: pytest.LogCaptureFixture) -> None:
    """A vehicle whose report alone exceeds the size limit is omitted, which is logged."""
    vehicles = {
        name: VehicleReport("bad", "x" * size)
        for name, size in (("1", limits.REPLY_BYTES), ("2", 9))
    }
    [part] = reply_parts(AccountReport("s", "h", 1.0, vehicles))
    assert json.loads(part)["vehicles"].keys() == {"2"}
    assert [each.about.event for each in caplog.records if hasattr(each, "about")] == ["incomplete"]


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
def test_malformed_reply_returns_none(content: object) -> None:
    """Parsing a reply that is not a report returns None."""
    assert from_json(content) is None


def test_deeply_nested_reply_returns_none() -> None:
    """Parsing deeply nested evidence returns None instead of raising."""
    event: dict[str, Any] = {
        "vehicle": "1", "kind": "jump", "change": "once", "severity": "info", "text": "", "time": 0.0
    }  # fmt: skip
    for _ in range(5000):
        event = event | {"evidence": [event]}
    assert (
        from_json({"service": "s", "host": "h", "now": 1.0, "vehicles": {}, "events": [event]})
        is None
    )


def test_reply_beyond_limits_returns_none() -> None:
    """Parsing a reply with more events or vehicles than a service sends returns None."""
    event = asdict(Event("1", "jump", "once", "info", "", 0.0))
    content: dict[str, object] = {"service": "s", "host": "h", "now": 1.0, "vehicles": {}}
    assert from_json(content | {"events": [event] * (limits.EVENTS + 1)}) is None
    vehicle = {"severity": "info", "text": "ok"}
    assert (
        from_json(content | {"vehicles": {str(number): vehicle for number in range(1001)}}) is None
    )
    read = from_json(
        content
        | {
            "events": [event] * limits.EVENTS,
            "vehicles": {str(number): vehicle for number in range(1000)},
        }
    )
    assert read is not None


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=10,
)


@given(st.sampled_from(["events", "vehicles", "now", "service", "host"]), json_values)
def test_any_reply_returns_a_report_or_none(name: str, value: object) -> None:
    """Parsing any reply returns None, or a report whose stories and faults can be computed."""
    content = json.loads(json.dumps(asdict(report(flying(xy_valid=False)))))
    read = from_json(content | {name: value})
    if read is not None:
        assert isinstance(
            faults_of([read], Expectation(vehicles=1, valid=("xy",), within=1.0)), list
        )
        assert isinstance(stories_of(read.events), list)


def test_vehicles_are_listed_worst_first() -> None:
    """Vehicles of a report are listed by state, then in natural order."""
    known: dict[str, Severity] = {
        "uav-10": "info",
        "uav-2": "info",
        "3": "watch",
        "b": "bad",
        "a": "bad",
    }
    vehicles = {name: VehicleReport(severity, f"is {severity}") for name, severity in known.items()}
    given = AccountReport("s", "h", 1.0, vehicles)
    order = sorted(known, key=lambda name: rank_vehicle(name, known[name]))
    assert list(by_vehicle([given])) == order == ["a", "b", "3", "uav-2", "uav-10"]
    assert faults_of([given], Expectation(well=True)) == ["vehicle a: is bad", "vehicle b: is bad"]
    page = vehicles_page(
        replace(given, vehicles={name: vehicles[name] for name in known if known[name] != "bad"})
    )
    assert page.content.decode().splitlines() == ["3 is watch", "uav-2 is info", "uav-10 is info"]


def test_healthy_vehicle_has_no_fault() -> None:
    """A vehicle that is sending has no fault unless it violates a criterion."""
    assert faults_of([report(flying())], NOTHING) == []
    expected = Expectation(("1",), 1, ("xy", "z", "vxy", "vz"), 60.0)
    assert faults_of([report(flying())], expected) == []
    assert faults_of([report(flying(xy_valid=False))], NOTHING) == []


def test_silent_vehicle_is_a_fault_for_an_hour() -> None:
    """A silent vehicle is a fault for an hour; then it counts as switched off unless expected."""
    flight = flying()
    flight.wait(10.0).update("stale")
    line = "vehicle 1: silent: no vehicle_local_position for 10.0 s, since 00:01:42.0 UTC (10.0 s)"
    assert faults_of([report(flight)], NOTHING) == [line]
    flight.wait(TIMINGS.forgotten - 11).update("stale")
    assert len(faults_of([report(flight)], NOTHING)) == 1
    flight.wait(2).update("stale")
    assert faults_of([report(flight)], NOTHING) == []
    faults = faults_of([report(flight)], Expectation(("1",)))
    assert faults == [
        "vehicle 1: silent: no vehicle_local_position for 10.0 s, since 00:01:42.0 UTC (60 min)"
    ]


def test_vehicle_received_by_one_service_is_not_missing() -> None:
    """A vehicle gone for one service but received by another has no fault, whatever the order of the replies."""
    lost, found = flying(), flying()
    lost.wait(10.0).update("gone")
    reports = [report(lost, service="a"), report(found, service="b")]
    assert faults_of(reports, Expectation(("1",), 1)) == []
    assert faults_of(reports[::-1], Expectation(("1",), 1)) == []
    assert len(faults_of(reports[:1], Expectation(("1",), 1))) == 2


def test_missing_vehicles_are_faults() -> None:
    """A missing vehicle is a fault, whether expected by name or by count; one published by a script is present."""
    one = report(flying())
    assert faults_of([one], Expectation(("1", "7"))) == [
        "vehicle 7 is missing: it has no publisher; published: 1"
    ]
    assert faults_of([], Expectation(("7",))) == ["vehicle 7 is missing: it has no publisher"]
    assert faults_of([one, SCRIPT], Expectation(("1", "7"))) == []
    assert faults_of([one, SCRIPT], Expectation(vehicles=3)) == [
        "messages arrive from 2 of 3 vehicles: 1, 7"
    ]
    assert faults_of([], Expectation(vehicles=1)) == ["messages arrive from 0 of 1 vehicles"]
    # vehicle 1 is not checked
    assert faults_of([one, SCRIPT], Expectation(("7",), valid=("xy",))) == []


def test_other_hosts_are_not_checked() -> None:
    """With `only`, services on other hosts are not checked."""
    silent = flying()
    silent.wait(10.0).update("stale")
    assert faults_of([report(silent, host="other")], NOTHING, only="this") == []
    assert len(faults_of([report(silent, host="this")], NOTHING, only="this")) == 1


def test_invalid_flags_form_one_fault_from_the_first_on() -> None:
    """Invalid flags of a vehicle form one fault, which begins with the first of them, not with an earlier failsafe."""
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


def test_vehicle_without_position_fails_validity_check() -> None:
    """A vehicle that publishes no position fails a validity check."""
    flight = Flight()
    flight.status(ARMED)
    assert faults_of([report(flight)], Expectation(valid=("xy",))) == [
        "vehicle 1: publishes no position"
    ]


def test_recent_events_are_faults() -> None:
    """Events of severity "bad" or "watch" within the period are faults; "info" events are not."""
    flight = flying(xy_valid=False)
    flight.wait(1.0).send()
    lines = faults_of([report(flight)], Expectation(within=60.0))
    assert lines == ["vehicle 1: xy not valid, at 00:01:42.0 UTC, 1.0 s ago"]
    assert faults_of([report(flight), SCRIPT], Expectation(("7",), within=60.0)) == []
    flight.fly(60)
    assert faults_of([report(flight)], Expectation(within=60.0)) == []
    flight.link = "no link to x"
    flight.update()
    assert faults_of([report(flight)], Expectation(("1",), within=60.0)) == [
        "h: no link to x, at 00:02:43.0 UTC, 0 ms ago"
    ]  # fmt: skip


def test_recent_events_beyond_twenty_are_counted() -> None:
    """The first twenty recent events are listed, the others counted."""
    events = tuple(
        Event(ALL, "lost", "once", "watch", f"{number} lost", float(number)) for number in range(30)
    )
    lines = faults_of(
        [replace(report(flying()), now=30.0, events=events)], Expectation(within=60.0)
    )
    assert len(lines) == 21
    assert lines[-1] == "10 more events in the last 60 s"


def test_loss_of_a_link_is_one_fault_of_its_service() -> None:
    """A service reports its link under each of its vehicles; a check lists it once, in chronological order."""
    lost = Event(ALL, "link_down", "begin", "bad", "no link to tcp/a", 50.0)
    resets = [
        Event(name, "reset", "once", "watch", "reset of xy", time)
        for name, time in (("1", 40.0), ("2", 60.0))
    ]
    vehicles = {name: VehicleReport("info", "ok", has_position=True) for name in ("1", "2")}
    whole = AccountReport("gcs", "host", 100.0, vehicles, (resets[0], lost, resets[1]))
    found = faults_of([whole.about("1"), whole.about("2")], Expectation(within=90.0))
    assert [fault.partition(", at")[0] for fault in found] == [
        "vehicle 1: reset of xy", "host: no link to tcp/a", "vehicle 2: reset of xy",
    ]  # fmt: skip
    forged = whole.about("1")
    other = AccountReport("other", "host", 100.0, {"3": vehicles["1"]})
    assert faults_of([forged, other], Expectation(expect=("3",), within=90.0)) == []


def test_report_about_one_vehicle_replaces_no_event_of_another() -> None:
    """A report about vehicle 1 with the service, host and time of an event of vehicle 2 does not replace that event."""
    vehicles = {name: VehicleReport("info", "ok", has_position=True) for name in ("1", "2")}
    lost = Event(ALL, "link_down", "begin", "bad", "no link to tcp/a", 50.0)
    genuine = AccountReport("gcs", "host", 100.0, vehicles, (lost,)).about("2")
    forged = AccountReport(
        "gcs", "host", 100.0, vehicles, (replace(lost, severity="info", text="ok"),)
    ).about("1")
    for reports in ([forged, genuine], [genuine, forged]):
        found = faults_of(reports, Expectation(within=90.0))
        assert [fault.partition(", at")[0] for fault in found] == ["host: no link to tcp/a"]
