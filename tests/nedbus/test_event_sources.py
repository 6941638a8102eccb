"""`nedbus.events` and `nedbus.why`: from files, open flights, samples and buses, as the commands print them."""

from __future__ import annotations

import asyncio
import json
import pkgutil
import re
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

import nedbus
from nedbus.health import Event, LiveEvents
from nedbus.transport import Session
from tests.flights.messages import VALID, VLP, message
from tests.flights.ulogs import LOGS
from tests.nedbus.cli.commands.test_events import VERDICT, start_service, write_flight
from tests.peers.command_line import run_command
from tests.peers.processes import Start
from tests.waits import DEADLINE, repeating, wait_for, wait_for_matching

PAGE = Path(__file__).parents[2] / "docs" / "events.md"
REAL = LOGS.parent / "px4" / "twelve_messages.ulg"
SHOWN = VERDICT.removeprefix("1: ").strip()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Write a log of 20 s with 3 s of dead reckoning, and then 4 s of invalid position."""
    return write_flight(tmp_path / "flight.ulg")


def facts_of(events: Iterable[Event]) -> list[tuple[object, ...]]:
    """Return what identifies events and their evidence."""
    return [
        (
            event.boot,
            event.change,
            event.severity,
            event.text,
            [cause.text for cause in event.evidence],
        )
        for event in events
    ]


def next_of(events: LiveEvents, kind: str) -> Event:
    """Return the next live event of this kind."""
    return next(event for event in events if event.kind == kind)


def test_no_public_name_is_that_of_a_module() -> None:
    """Importing a module of the package cannot replace a public name, such as `nedbus.events`."""
    modules = {module.name for module in pkgutil.iter_modules(nedbus.__path__)}
    assert modules.isdisjoint(nedbus.__all__)


def test_each_source_of_a_flight_has_the_same_events(log: Path) -> None:
    """A path, a list of paths, an open flight and its samples yield the events that `nedbus events` prints."""
    printed = [
        json.loads(line) for line in run_command("events", str(log), "--json").out.splitlines()
    ]
    history = nedbus.events(log)
    events = facts_of(history)
    assert [event[:4] for event in events] == [
        (each["boot"], each["change"], each["severity"], each["text"]) for each in printed
    ]
    assert [event[4] for event in events] == [
        [cause["text"] for cause in each["evidence"]] for each in printed
    ]
    assert facts_of(nedbus.events(str(log))) == events
    assert facts_of(nedbus.events([log])) == events
    with nedbus.open(log) as flight:
        assert facts_of(nedbus.events(flight)) == events
        assert facts_of(nedbus.events(flight())) == events
        assert facts_of(nedbus.events(list(flight(rows=True)))) == events
    assert (len(history), history.dropped, history.warnings) == (6, 0, ())
    assert list(history.vehicles) == ["1"]
    assert history.end == pytest.approx(19.9)
    assert history.events[0].time == pytest.approx(4.0)


def test_why_is_what_the_command_prints(log: Path) -> None:
    """The verdict has the text, the fault with its period and evidence, and its events; `at` selects a time."""
    verdict = nedbus.why(log)["1"]
    assert (verdict.vehicle, verdict.text, verdict.usable) == ("1", SHOWN, False)
    (story,) = verdict.stories
    assert (story.what, verdict.period(story)) == (
        "xy and vxy not valid",
        "from 8.000 to 12.000 s since boot (4.0 s)",
    )
    assert [event.kind for event in verdict.cause] == ["dead_reckoning"]
    assert (verdict.begin and verdict.begin.boot, verdict.end and verdict.end.boot) == (8.0, 12.0)
    with nedbus.open(log) as flight:
        assert nedbus.why(flight)["1"].text == SHOWN
        assert nedbus.why(flight("*"), vehicle=1)["1"].text == SHOWN
    then = nedbus.why(log, at="6.5")["1"]
    assert then.usable
    assert run_command("why", str(log), "--at", "6.5").out == f"1: {then.text}\n"


@pytest.mark.logs
@pytest.mark.skipif(not REAL.exists(), reason=f"no real logs: {REAL} does not exist")
@pytest.mark.long
def test_why_of_a_real_flight() -> None:
    """A log of PX4 1.17, its open flight and its samples have one verdict; times are the vehicle's UTC."""
    verdict = nedbus.why(REAL)["1"]
    assert verdict.text.startswith(
        "not usable: xy and vxy not valid from 23:09:04.9 to 23:09:20.8 UTC (15.9 s)."
    )
    with nedbus.open(REAL) as flight:
        assert nedbus.why(flight)["1"].text == verdict.text
        of_samples = nedbus.why(flight("*"))["1"]
    assert (of_samples.usable, of_samples.stories[0].what) == (False, verdict.stories[0].what)
    # by the log's own UTC
    assert re.search(r"from 23:09:04\.\d to 23:09:20\.\d UTC \(15.9 s\)", of_samples.text)


def test_vehicles_are_selected(tmp_path: Path) -> None:
    """`vehicle` selects one or several; the vehicle of an open flight is selected as well."""
    bad, good = write_flight(tmp_path / "bad.ulg"), write_flight(tmp_path / "good.ulg", fault=False)
    joined = tmp_path / "both.mcap"
    assert run_command("convert", str(bad), str(joined), "--vehicle", "7").exit_code == 0
    events = nedbus.events(joined, vehicle=[7])
    assert {event.vehicle for event in events} == {"7"}
    assert list(nedbus.why(joined)) == ["7"]
    with nedbus.open(joined, vehicle=7) as flight:
        assert facts_of(nedbus.events(flight)) == facts_of(events)
    with nedbus.open(good, vehicle=2) as flight:
        assert list(nedbus.events(flight).vehicles) == []
    assert not [*nedbus.events(good)]


def test_invalid_source_raises(log: Path, tmp_path: Path, bus: nedbus.Bus) -> None:
    """Each invalid argument raises a typed error that names the value and the remedy."""
    source: Any
    for source in (5, None, [log, 5], iter([log])):
        with pytest.raises(nedbus.ArgumentError, match=r"^source .* is not valid: expected "):
            nedbus.events(source)
    with pytest.raises(nedbus.ArgumentError, match=r"at least one \.ulg"):
        nedbus.events([])
    with pytest.raises(nedbus.SourceError, match="no such file"):
        nedbus.why(tmp_path / "none.ulg")
    with pytest.raises(
        nedbus.AddressError, match="vehicle '7' is not in this history: expected one of 1"
    ):
        nedbus.events(log, vehicle="7")
    with pytest.raises(nedbus.AddressError, match="vehicle '7' is not in this history"):
        nedbus.why(log, vehicle="7")
    recorded: Any = log
    with pytest.raises(
        nedbus.ArgumentError, match=r"within 5 is not valid: expected None with files"
    ):
        nedbus.events(recorded, within=5)
    for at, reason in (("noon", "not a time"), ("12:00", "no message of this vehicle has UTC")):
        with pytest.raises(
            nedbus.ArgumentError,
            match=rf"at '{at}' is not in this data \({reason}\): expected 14:05",
        ):
            nedbus.why(log, at=at)
    number: Any = 6.5
    with pytest.raises(nedbus.ArgumentError, match=r"at 6\.5 is not valid: expected a string"):
        nedbus.why(log, at=number)
    with nedbus.open(log) as flight:
        pass
    with pytest.raises(nedbus.ClosedError):
        nedbus.events(flight)
    with pytest.raises(nedbus.NoDataError, match="event history of vehicle 7"):
        bus.why("7", timeout=0.2)
    bus.close()
    with pytest.raises(nedbus.ClosedError):
        nedbus.events(bus)


def test_samples_received_from_a_bus_have_events(bus: nedbus.Bus, endpoint: str, log: Path) -> None:
    """A list of live samples is analysed by the vehicle's clock, however fast it arrived, without retained ones."""
    with nedbus.connect(endpoint) as sender, nedbus.open(log) as flight:
        publisher = sender.publisher(VLP, vehicle="7", lossless=True)
        messages = [sample.message for sample in flight()]
        publisher.publish(messages[0])
        with bus.subscribe(vehicle="7", mode="every") as subscription:
            samples = [subscription.receive(DEADLINE)]
            for each in messages[1:]:
                publisher.publish(each)
            samples += [subscription.receive(DEADLINE) for _ in messages[1:]]
    assert samples[0].retained
    events = nedbus.events(samples)
    expected = [(event.text, event.boot) for event in nedbus.events(log)]
    assert [(event.text, event.boot) for event in events] == expected
    first = next(sample for sample in samples if sample.message.timestamp == 5_000_000)
    utc = events.utc(events.events[0])
    assert utc is not None
    assert abs(utc - first.received / 1e9) < 30  # UTC by the clock of the reader
    assert "UTC" in nedbus.why(samples)["7"].text


@pytest.mark.slow
def test_live_events_have_their_reason(bus: nedbus.Bus, zenoh_session: Session) -> None:
    """A bus yields the events of the selected vehicle as they happen, in Unix time, with their evidence."""
    fields: dict[str, object] = VALID | {"dead_reckoning": False}

    def publish() -> None:
        for publisher in (seven, eight):
            publisher.publish(message(time.monotonic_ns() // 1000, **fields))

    with (
        bus.publisher(VLP, vehicle="7") as seven,
        bus.publisher(VLP, vehicle="8") as eight,
        nedbus.events(bus, vehicle=7) as events,
    ):
        wait_for_matching(zenoh_session, f"nedbus/7/{VLP}")
        with repeating(publish):
            while "7" not in events.from_start:
                received = events.subscription.receive(DEADLINE)
                events.add(received)
            fields["dead_reckoning"] = True
            reckoning = next_of(events, "dead_reckoning")
            fields["xy_valid"] = False
            invalid = next_of(events, "xy_invalid")
        silent = next_of(events, "silent")
    assert [cause.kind for cause in invalid.evidence] == ["dead_reckoning"]
    assert {reckoning.vehicle, invalid.vehicle, silent.vehicle} == {"7"}
    assert reckoning.time <= invalid.time <= silent.time
    assert abs(invalid.time - received.received / 1e9) < DEADLINE
    assert list(events) == []  # closed


@pytest.mark.slow
def test_verdict_of_a_live_vehicle(
    run_nedbus: Start, bus: nedbus.Bus, endpoint: str, log: Path
) -> None:
    """`bus.why`, `nedbus.why(bus)` and AsyncBus return the services' verdict; `within` begins with past events."""
    start_service(run_nedbus, bus, endpoint, f"ulog:{log}?speed=20")
    printed = run_command("why", "-c", endpoint).out.strip()
    verdict = bus.why(1)
    assert (f"1: {verdict.text}", verdict.usable) == (printed, True)
    assert verdict.text.startswith("was not usable: xy and vxy not valid from ")
    assert nedbus.why(bus)["1"].text == verdict.text
    assert [event.text for event in bus.history()] == [
        event.text for event in bus.history(within=1e6)
    ]
    with nedbus.events(bus, vehicle="1", within=600) as events:
        assert [event.kind for event in events.poll()][:2] == ["dead_reckoning", "xy_invalid"]

    async def ask() -> tuple[str, int]:
        async with nedbus.connect_async(endpoint) as other:
            return (await other.why("1")).text, len(await other.history())

    assert asyncio.run(ask()) == (verdict.text, len(bus.history()))


@pytest.mark.slow
def test_documented_alarm_gives_the_reason(
    start: Start, bus: nedbus.Bus, zenoh_session: Session, endpoint: str
) -> None:
    """The alarm script of docs/events.md prints a fault of vehicle 7 with its reason."""
    (script,) = re.findall(
        r"test_event_sources.py -->\n```python\n(.*?)```", PAGE.read_text(), re.DOTALL
    )
    assert len([line for line in script.splitlines() if line]) <= 10
    fields: dict[str, object] = VALID | {"dead_reckoning": False}
    with bus.publisher(VLP, vehicle="7") as publisher:

        def publish() -> None:
            publisher.publish(message(time.monotonic_ns() // 1000, **fields))

        alarm = start("-c", script, NEDBUS_CONNECT=endpoint)
        wait_for_matching(zenoh_session, f"nedbus/7/{VLP}")
        for _ in range(10):
            publish()
        with repeating(publish):
            fields["dead_reckoning"] = True
            wait_for(lambda: "dead reckoning" in alarm.out, what=f"dead reckoning: {alarm.err}")
            fields["xy_valid"] = False
            wait_for(lambda: "xy not valid" in alarm.out, what=f"the invalid position: {alarm.err}")
    assert "ALARM: vehicle 7: xy not valid, because of: dead reckoning\n" in alarm.out
