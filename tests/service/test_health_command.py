"""`nedbus health`: green only when services answer, their sources work, and messages flow."""

from __future__ import annotations

import json
import signal

import pytest

import nedbus
from nedbus_msgs import DEFAULT_TOPIC
from tests.conftest import Process, Start, free_endpoint, message, wait_for

VLP = DEFAULT_TOPIC


@pytest.fixture
def health(run_nedbus: Start, endpoint: str) -> Start:
    """Run `nedbus health` with options."""

    def run(*options: str) -> Process:
        process = run_nedbus("health", "-c", endpoint, *options)
        process.wait()
        return process

    return run


def test_nothing_that_flies_is_not_healthy(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, health: Start) -> None:
    """A service whose sources all work, and of which no vehicle was ever heard."""
    source = f"mavlink:udpin:127.0.0.1:{free_endpoint().rpartition(':')[2]}"
    run_nedbus("serve", "-c", endpoint, "-s", source)
    wait_for(bus.services, what="the service")
    wait_for(lambda: "waiting" in str(bus.services()), what="the source")
    shown = health()
    assert shown.popen.returncode == 1
    assert shown.err == f"nedbus: no vehicle is published: {source} is waiting\n"


def test_finished_replay_is_not_healthy(run_nedbus: Start, endpoint: str, health: Start) -> None:
    """The newest message must be fresh, whatever the state of the source; --max-age says how fresh."""
    service = run_nedbus("serve", "-c", endpoint, "-s", "sim:?duration=1")
    wait_for(lambda: "sim:?duration=1: done" in service.err, what="the end of the replay")
    wait_for(lambda: health().popen.returncode == 1, what="its age")
    assert "the newest message is " in health().err
    assert "old, from vehicle 1: at most 3 s" in health().err
    assert health("--max-age", "3600").popen.returncode == 0


def test_frozen_service_is_missed(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, health: Start) -> None:
    """With --services 2 both must answer; one that is stopped does not."""
    run_nedbus("serve", "-c", endpoint, "-s", "sim:")
    second = run_nedbus("serve", "-c", endpoint, "-s", "sim:?vehicle=2")
    wait_for(lambda: len(bus.services()) == 2, what="both services")
    wait_for(lambda: health("--services", "2").popen.returncode == 0, what="health")
    second.signal(signal.SIGSTOP)
    try:
        shown = health("--services", "2")
        assert shown.popen.returncode == 1
        assert "1 of 2 services answer" in shown.err
    finally:
        second.signal(signal.SIGCONT)


def test_one_vehicle_is_judged(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, health: Start) -> None:
    """--vehicle is of that vehicle alone, also of one that a script publishes; one that is not there is missed."""
    run_nedbus("serve", "-c", endpoint, "-s", "sim:", "-s", "ulog:/gone.ulg")
    with bus.publisher(VLP, vehicle="script") as publisher:
        wait_for(lambda: len(bus.vehicles()) == 2, what="both vehicles")
        publisher.publish(message(1))
        assert "ulog:/gone.ulg is retrying: " in health().err
        wait_for(lambda: health("--vehicle", "1").popen.returncode == 0, what="the simulated vehicle")
        assert health("--vehicle", "script", "--max-age", "60").popen.returncode == 0
        assert "vehicle 9 is not published" in health("--vehicle", "9").err
        assert health("--vehicle", "a/b").popen.returncode == 2


def test_report_is_json(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, health: Start) -> None:
    """--json has the verdict, the reason, and the age of each vehicle's newest message, whatever the verdict."""
    run_nedbus("serve", "-c", endpoint, "-s", "sim:")
    wait_for(lambda: bus.latest() and health().popen.returncode == 0, what="health")
    report = json.loads(health("--json").out)
    assert report.pop("vehicles")["1"] < 3
    assert report == {"healthy": True, "reason": None, "services": 1, "sources": 1}
    missed = health("--json", "--services", "5")
    assert missed.popen.returncode == 1
    assert json.loads(missed.out)["reason"].startswith("1 of 5 services answer")
