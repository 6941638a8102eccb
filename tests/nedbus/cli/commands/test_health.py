"""`nedbus health`: exits with 0 only if services answer, their sources work, and messages arrive."""

from __future__ import annotations

import json
import re
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import nedbus
from nedbus.daemon import Daemon
from nedbus.settings import load_settings
from nedbus.transport import Session
from nedbus_msgs import Address
from tests.flights.messages import VALID, VLP, message
from tests.flights.ulogs import UlogWriter
from tests.peers.command_line import CommandResult, run_command
from tests.peers.ports import free_port
from tests.peers.processes import Start
from tests.peers.queryables import answer_queries, reply_with
from tests.waits import DEADLINE, wait_for

Health = Callable[..., CommandResult]


@pytest.fixture
def health(endpoint: str) -> Health:
    """Return a function that runs `nedbus health` with options."""
    return lambda *options: run_command("health", "-c", endpoint, *options)


@contextmanager
def serving(endpoint: str, *sources: str) -> Iterator[Daemon]:
    """Run a service in this process."""
    daemon = Daemon(load_settings(source=sources, connect=(endpoint,)), version="0")
    running = threading.Thread(target=daemon.run)
    running.start()
    try:
        assert daemon.ready.wait(DEADLINE)
        yield daemon
    finally:
        daemon.stop()
        running.join(DEADLINE)


def wait_for_state(daemon: Daemon, state: str) -> None:
    wait_for(lambda: daemon.sources[0].state == state, what=f"the source to be {state}")


def test_service_without_vehicles_is_not_healthy(endpoint: str, health: Health) -> None:
    """A service is not healthy if its sources work but have not received messages from any vehicle."""
    source = f"mavlink:udpin:127.0.0.1:{free_port()}"
    with serving(endpoint, source) as daemon:
        wait_for_state(daemon, "waiting")
        result = health()
    assert (result.exit_code, result.err) == (
        1,
        f"nedbus: no vehicle is published: {source} is waiting\n",
    )


def test_finished_replay_is_not_healthy(
    endpoint: str, health: Health, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The newest message must not be older than --max-age, whatever the state of the source."""
    offset = [0.0]
    monkeypatch.setattr(
        "nedbus.daemon.worker.Clock.now", staticmethod(lambda: time.monotonic() + offset[0])
    )
    with serving(endpoint, "sim:?duration=0.1") as daemon:
        wait_for_state(daemon, "done")
        offset[0] = 100.0
        result = health()
        assert result.exit_code == 1
        assert re.search(
            r"the newest message is 1\d\d.\d s old, from vehicle 1: the limit is 3 s\n", result.err
        )
        assert health("--max-age", "3600").exit_code == 0


@pytest.mark.slow
def test_frozen_service_is_not_healthy(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus, health: Health
) -> None:
    """--services 2 fails if one of two services is frozen (SIGSTOP)."""
    other = run_nedbus("serve", "-c", endpoint, "-s", "sim:?vehicle=2")
    with serving(endpoint, "sim:"):
        wait_for(lambda: len(bus.services(timeout=0.3)) == 2, what="both services")
        wait_for(lambda: health("--services", "2").exit_code == 0, what="health")
        other.signal(signal.SIGSTOP)
        try:
            result = health("--services", "2")
        finally:
            other.signal(signal.SIGCONT)
    assert result.exit_code == 1
    assert "1 of 2 services answer" in result.err


def test_vehicle_option_checks_one_vehicle(endpoint: str, bus: nedbus.Bus, health: Health) -> None:
    """--vehicle checks only that vehicle, even if a script publishes it, and fails if nothing publishes it."""
    with (
        serving(endpoint, "ulog:/gone.ulg", "sim:") as daemon,
        bus.publisher(VLP, vehicle="script") as publisher,
    ):
        wait_for_state(daemon, "retrying")
        wait_for(lambda: len(bus.vehicles()) == 2, what="both vehicles")
        publisher.publish(message(1))
        assert "ulog:/gone.ulg is retrying: " in health().err
        wait_for(lambda: health("--vehicle", "1").exit_code == 0, what="the simulated vehicle")
        assert health("--vehicle", "script", "--max-age", "60").exit_code == 0
        assert (
            "vehicle 9 is not published (published: 1, script): ulog:"
            in health("--vehicle", "9").err
        )
        assert health("--vehicle", "a/b").exit_code == 2


def test_vehicle_option_judges_the_age_of_this_vehicle_alone(endpoint: str, health: Health) -> None:
    """--vehicle reports only this vehicle, also of a service with several."""
    with serving(endpoint, "sim:", "sim:?vehicle=2"):
        wait_for(lambda: health("--vehicles", "2").exit_code == 0, what="both vehicles")
        report = json.loads(health("--vehicle", "2", "--max-age", "60", "--json").out)
    assert report["vehicles"].keys() == {"2"}


def test_json_report_has_reason_and_ages(endpoint: str, bus: nedbus.Bus, health: Health) -> None:
    """--json writes the result, the reason and the ages of the newest messages, healthy or not."""
    with serving(endpoint, "sim:"):
        wait_for(lambda: bus.latest() and health().exit_code == 0, what="health")
        report = json.loads(health("--json", "--max-age", "60").out)
        missed = health("--json", "--services", "5")
    assert report.pop("vehicles")["1"] < 60
    assert report == {"healthy": True, "reason": None, "faults": [], "services": 1, "sources": 1}
    assert missed.exit_code == 1
    assert json.loads(missed.out)["reason"].startswith("1 of 5 services answer")


def test_missing_expected_vehicles_are_faults(
    endpoint: str, bus: nedbus.Bus, health: Health
) -> None:
    """--expect names the required vehicles, --vehicles their number; they may be on any host or come from scripts."""
    with serving(endpoint, "sim:"), bus.publisher(VLP, vehicle="script") as publisher:
        wait_for(
            lambda: health("--expect", "1", "--vehicles", "1").exit_code == 0,
            what="the simulated vehicle",
        )
        result = health("--expect", "1,7, 8", "--vehicles", "3")
        assert (result.exit_code, result.out) == (1, "")
        assert result.err.splitlines() == [
            "nedbus: vehicle 7 is missing: it has no publisher; published: 1",
            "nedbus: vehicle 8 is missing: it has no publisher; published: 1",
            "nedbus: messages arrive from 1 of 3 vehicles: 1",
        ]
        publisher.publish(message(1, xy_valid=False))
        options = "--expect", "1,script", "--vehicles", "2", "--max-age", "60"
        wait_for(lambda: health(*options).exit_code == 0, what="both vehicles")
        result = health(*options, "--valid", "xy,z")
        assert result.err.splitlines() == [
            "nedbus: vehicle script: xy not valid",
            "nedbus: vehicle script: validity of z is unknown: the vehicle does not send it",
        ]


def test_valid_and_within_options_report_faults(
    endpoint: str, tmp_path: Path, health: Health
) -> None:
    """--valid checks current flags and --within past events; stderr has one line per fault, and --json lists all."""
    writer = UlogWriter()
    writer.define([VLP])
    for tenth in range(10, 60):
        good = VALID | {"xy_valid": tenth < 30, "dead_reckoning": tenth >= 20}
        writer.add(VLP, message(tenth * 100_000, **good))
    log = writer.write(tmp_path / "flight.ulg")
    with serving(endpoint, f"ulog:{log}?speed=20") as daemon:
        wait_for_state(daemon, "done")
        assert health("--max-age", "600").exit_code == 0
        assert health("--max-age", "600", "--valid", "z,vz").exit_code == 0
        result = health("--max-age", "600", "--valid", "xy,z")
        assert result.exit_code == 1
        assert re.fullmatch(
            r"nedbus: vehicle 1: xy not valid, since \d\d:\d\d:\d\d\.\d UTC \(.*s\)\n", result.err
        )
        result = health("--max-age", "600", "--valid", "xy", "--within", "600", "--json")
        report = json.loads(result.out)
        assert (result.exit_code, report["healthy"], report["reason"]) == (
            1,
            False,
            report["faults"][0],
        )
        texts = [
            re.sub(r"\d\d:\d\d:\d\d\.\d UTC|[\d.]+ m?s", "T", fault) for fault in report["faults"]
        ]
        assert texts == [
            "vehicle 1: xy not valid, since T (T)",
            "vehicle 1: dead reckoning, at T, T ago",
            "vehicle 1: xy not valid, at T, T ago",
        ]
        assert len(result.err.splitlines()) == 3
        assert health("--max-age", "600", "--expect", "1", "--within", "0").exit_code == 0


@pytest.mark.slow
def test_silent_vehicle_is_a_fault(endpoint: str, health: Health) -> None:
    """Every silent vehicle is a fault; --expect and --vehicle restrict the check to the vehicles they name."""
    with serving(endpoint, "sim:") as daemon:
        wait_for(lambda: health().exit_code == 0, what="health")
        daemon.event_log.add(Address("2", VLP), message(1, **VALID), time.time() - 100)
        wait_for(lambda: daemon.event_log.state("2", time.time()).severity == "bad", what="silence")
        wait_for(lambda: health().exit_code == 1, what="the report on vehicle 2")
        result = health()
        assert re.fullmatch(
            r"nedbus: vehicle 2: silent: no vehicle_local_position for 1\d\d\.\d s, since .* UTC .*\n",
            result.err,
        )
        assert health("--expect", "1").exit_code == 0
        assert health("--vehicle", "1").exit_code == 0


@pytest.mark.slow
def test_faults_of_a_vehicle_do_not_hide_those_of_a_vehicle_with_a_shorter_name(
    endpoint: str, health: Health
) -> None:
    """An expected vehicle without a publisher is missing, even if a service still reports it."""
    with serving(endpoint, "sim:") as daemon:
        wait_for(lambda: health().exit_code == 0, what="health")
        daemon.event_log.add(Address("2", VLP), message(1, **VALID), time.time())
        wait_for(lambda: "1, 2" in health("--expect", "25").err, what="vehicle 2")
        result = health("--expect", "2,25")
    assert result.exit_code == 1
    assert result.err.splitlines() == [
        "nedbus: vehicle 25 is missing: it has no publisher; published: 1, 2",
        "nedbus: vehicle 2 is missing: it has no publisher, although a service reports it",
    ]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--expect", "1,a b"), "nedbus: vehicle 'a b' is not valid"),
        (("--expect", ""), "nedbus: --expect: the list is empty"),
        (("--valid", " , "), "nedbus: --valid: the list is empty"),
        (
            ("--valid", "xy,heading"),
            "nedbus: --valid: 'heading': expected a list of xy, z, vxy, vz\n",
        ),
    ],
)
def test_invalid_option_value_exits_with_2(
    health: Health, arguments: tuple[str, ...], text: str
) -> None:
    """An invalid value is reported in one line before any query, with exit code 2."""
    result = health(*arguments)
    assert result.exit_code == 2
    assert result.err.startswith(text)
    assert len(result.err.splitlines()) == 1


@pytest.mark.slow
def test_ended_replay_causes_no_silence_event(endpoint: str, bus: nedbus.Bus) -> None:
    """`nedbus events` shows nothing for the last message of a replay that ended long ago."""
    with serving(endpoint, "sim:?duration=0.1"):

        def is_old() -> bool:
            return any(
                sample.latency is not None and sample.latency > 3.5 for sample in bus.latest("*")
            )

        wait_for(is_old, what="the last message to be old")
        result = run_command("events", "-c", endpoint, "--duration", "4")
        assert result.out == ""


def test_service_without_history_is_a_fault(
    endpoint: str, zenoh_session: Session, health: Health
) -> None:
    """--valid and --within fail for an older service, which keeps no history of its vehicles."""
    key, status = (
        "nedbus/@service/1/old/status",
        {"service": "old", "host": socket.gethostname(), "sources": []},
    )
    with answer_queries(
        zenoh_session,
        key,
        reply_with({key: json.dumps(status).encode()}, encoding="application/json"),
    ):
        for option in ("--valid", "xy"), ("--within", "60"):
            result = health("--services", "1", *option)
            assert result.exit_code == 1
            assert "service old keeps no event history: update nedbus on its host" in result.err


def test_older_service_is_named_once(endpoint: str, zenoh_session: Session, health: Health) -> None:
    """A service whose status key names no vehicle is one fault, and is not also asked for its event history."""
    key = "nedbus/@service/old-1/status"
    status = json.dumps({"host": "flyer", "version": "0.1.0"}).encode()
    with answer_queries(zenoh_session, key, reply_with({key: status})):
        result = health("--services", "1", "--valid", "xy")
    assert result.exit_code == 1
    assert result.err.count("service old-1 on flyer runs nedbus 0.1.0") == 1
    assert "keeps no event history" not in result.err
