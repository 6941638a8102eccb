"""`nedbus health`: green only when services answer, their sources work, and messages flow."""

from __future__ import annotations

import json
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

import nedbus
from nedbus.daemon import Daemon
from nedbus.settings import load_settings
from tests.command_line import Ended, run_command
from tests.messages import VLP, message
from tests.ports import free_port
from tests.processes import Start
from tests.waits import DEADLINE, wait_for

Judge = Callable[..., Ended]


@pytest.fixture
def health(endpoint: str) -> Judge:
    """Run `nedbus health` with options."""
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


def test_nothing_that_flies_is_not_healthy(endpoint: str, health: Judge) -> None:
    """A service whose sources all work, and of which no vehicle was ever heard."""
    source = f"mavlink:udpin:127.0.0.1:{free_port()}"
    with serving(endpoint, source) as daemon:
        wait_for_state(daemon, "waiting")
        shown = health()
    assert (shown.exit_code, shown.err) == (1, f"nedbus: no vehicle is published: {source} is waiting\n")


def test_finished_replay_is_not_healthy(endpoint: str, health: Judge, monkeypatch: pytest.MonkeyPatch) -> None:
    """The newest message must be fresh, whatever the state of the source; --max-age says how fresh."""
    passed = [0.0]
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + passed[0], time_ns=time.time_ns)
    monkeypatch.setattr("nedbus.daemon.clock.time", clock)
    with serving(endpoint, "sim:?duration=0.1") as daemon:
        wait_for_state(daemon, "done")
        passed[0] = 100.0
        shown = health()
        assert shown.exit_code == 1
        assert re.search(r"the newest message is 1\d\d.\d s old, from vehicle 1: at most 3 s\n", shown.err)
        assert health("--max-age", "3600").exit_code == 0


def test_frozen_service_is_missed(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, health: Judge) -> None:
    """With --services 2 both must answer; one that is stopped does not."""
    other = run_nedbus("serve", "-c", endpoint, "-s", "sim:?vehicle=2")
    with serving(endpoint, "sim:"):
        wait_for(lambda: len(bus.services(timeout=0.3)) == 2, what="both services")
        wait_for(lambda: health("--services", "2").exit_code == 0, what="health")
        other.signal(signal.SIGSTOP)
        try:
            shown = health("--services", "2")
        finally:
            other.signal(signal.SIGCONT)
    assert shown.exit_code == 1
    assert "1 of 2 services answer" in shown.err


def test_one_vehicle_is_judged(endpoint: str, bus: nedbus.Bus, health: Judge) -> None:
    """--vehicle is of that vehicle alone, also of one that a script publishes; one that is not there is missed."""
    with serving(endpoint, "ulog:/gone.ulg", "sim:") as daemon, bus.publisher(VLP, vehicle="script") as publisher:
        wait_for_state(daemon, "retrying")
        wait_for(lambda: len(bus.vehicles()) == 2, what="both vehicles")
        publisher.publish(message(1))
        assert "ulog:/gone.ulg is retrying: " in health().err
        wait_for(lambda: health("--vehicle", "1").exit_code == 0, what="the simulated vehicle")
        assert health("--vehicle", "script", "--max-age", "60").exit_code == 0
        assert "vehicle 9 is not published" in health("--vehicle", "9").err
        assert health("--vehicle", "a/b").exit_code == 2


def test_report_is_json(endpoint: str, bus: nedbus.Bus, health: Judge) -> None:
    """--json has the verdict, the reason, and the age of each vehicle's newest message, whatever the verdict."""
    with serving(endpoint, "sim:"):
        wait_for(lambda: bus.latest() and health().exit_code == 0, what="health")
        report = json.loads(health("--json", "--max-age", "60").out)
        missed = health("--json", "--services", "5")
    assert report.pop("vehicles")["1"] < 60
    assert report == {"healthy": True, "reason": None, "services": 1, "sources": 1}
    assert missed.exit_code == 1
    assert json.loads(missed.out)["reason"].startswith("1 of 5 services answer")
