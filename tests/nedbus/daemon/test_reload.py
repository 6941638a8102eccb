"""Reload on SIGHUP: the service applies changed settings, and does not interrupt unchanged sources."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import pytest

import nedbus
from nedbus.daemon import Daemon
from nedbus.errors import ConfigError
from nedbus.settings import load_settings
from tests.flights.messages import VLP
from tests.peers.ports import free_endpoint
from tests.peers.processes import Process, Start
from tests.waits import DEADLINE, wait_for


def write_settings(file: Path, vehicles: Iterable[object], *, header: str = "") -> None:
    """Write a settings file with one simulated vehicle per name."""
    sources = [f'[[source]]\nkind = "sim"\nvehicle = "{vehicle}"\n' for vehicle in vehicles]
    file.write_text(header + "\n".join(sources))


def reload(service: Process, count: int) -> str:
    """Send SIGHUP, wait until the service has logged `count` results, and return the last one."""
    service.popen.send_signal(signal.SIGHUP)
    wait_for(lambda: service.err.count("reloaded") == count, what="the result")
    return [line for line in service.err.splitlines() if "reloaded" in line][-1]


@pytest.mark.slow
def test_reload_does_not_interrupt_unchanged_sources(run_nedbus: Start, tmp_path: Path) -> None:
    """Ten vehicles lose no message during ten reloads that add and remove an eleventh."""
    endpoint, file, vehicles = (
        free_endpoint(),
        tmp_path / "fleet.toml",
        [str(number) for number in range(10)],
    )
    write_settings(file, vehicles)
    service = run_nedbus("serve", "--listen", endpoint, "--config", str(file))
    wait_for(lambda: service.err.count("seed 0") == len(vehicles), what="the vehicles")
    with (
        nedbus.connect(endpoint, timeout=DEADLINE) as bus,
        bus.subscribe(VLP, mode="every") as subscription,
    ):
        times: dict[str, list[int]] = {}

        def receive_until(vehicle: str) -> None:
            begin = time.time_ns()
            while True:
                sample = subscription.receive(DEADLINE)
                times.setdefault(sample.vehicle, []).append(sample.message.timestamp)
                if sample.vehicle == vehicle and (sample.sent or 0) > begin:
                    return

        for number in range(1, 11):
            receive_until("0")
            write_settings(file, [*vehicles, "guest"] if number % 2 else vehicles)
            changed = "1 started, 0 stopped" if number % 2 else "0 started, 1 stopped"
            assert f"{changed}, 10 unchanged" in reload(service, number)
            if number % 2:
                receive_until("guest")
        for vehicle in vehicles:
            receive_until(vehicle)
        assert subscription.counts.lost == subscription.counts.dropped == 0
    assert times.keys() == {*vehicles, "guest"}
    for vehicle in vehicles:
        steps = {after - before for before, after in pairwise(times[vehicle])}
        assert steps == {10_000}, vehicle  # us; a restarted source would begin at 0
    assert "retrying" not in service.err


@pytest.mark.slow
def test_invalid_settings_change_nothing(run_nedbus: Start, tmp_path: Path) -> None:
    """A file with an invalid source or a changed prefix is rejected, and none of its changes are applied."""
    endpoint, file = free_endpoint(), tmp_path / "nedbus.toml"
    write_settings(file, ["1"])
    service = run_nedbus("serve", "--listen", endpoint, "--config", str(file))
    wait_for(lambda: "seed 0" in service.err, what="the vehicle")
    with nedbus.connect(endpoint, timeout=DEADLINE) as bus:
        write_settings(file, ["1", "2", "a b"])
        assert f"{file}, line 11, column 1: source 'sim:?vehicle=a%20b': " in reload(service, 1)
        write_settings(file, ["2"], header='prefix = "other"\n')
        reason = "prefix cannot be changed by a reload: restart the service"
        assert f"{file}, line 1, column 1: {reason}" in reload(service, 2)
        file.write_text("[[source")
        assert f"{file}: Expected ']]' at the end of" in reload(service, 3)
        file.unlink()
        assert "there is no such file" in reload(service, 4)
        assert list(bus.vehicles()) == ["1"]
        write_settings(file, ["2"])
        assert "1 started, 1 stopped, 0 unchanged" in reload(service, 5)
        wait_for(lambda: list(bus.vehicles()) == ["2"], what="the other vehicle")


@pytest.mark.slow
def test_reload_can_move_an_address_to_another_source(run_nedbus: Start, tmp_path: Path) -> None:
    """A removed source, even a replay at full speed, releases its addresses before a new source claims them.

    A source without a vehicle is restarted if the default vehicle changes.
    """
    endpoint, file = free_endpoint(), tmp_path / "nedbus.toml"
    file.write_text('source = "sim:?speed=max&duration=1e8"\n')
    service = run_nedbus("serve", "--listen", endpoint, "--config", str(file))
    wait_for(lambda: "seed 0" in service.err, what="the first source")
    with nedbus.connect(endpoint, timeout=DEADLINE) as bus:
        for number, vehicle in enumerate(("1", "2"), 1):
            file.write_text(f'vehicle = "{vehicle}"\nsource = "sim:?seed=5"\n')
            assert "1 started, 1 stopped, 0 unchanged" in reload(service, number)
            with bus.subscribe(VLP, vehicle=vehicle) as subscription:
                subscription.receive(DEADLINE)
    assert "this process already publishes" not in service.err


@pytest.mark.slow
def test_reload_keeps_sources_given_by_flags(run_nedbus: Start) -> None:
    """Sources given by flags override the file, so a reload changes nothing and logs this result."""
    service = run_nedbus("serve", "--listen", free_endpoint(), "-s", "sim:", "-s", "sim:?vehicle=2")
    wait_for(lambda: service.err.count("seed 0") == 2, what="the vehicles")
    assert "0 started, 0 stopped, 2 unchanged" in reload(service, 1)


def test_reload_during_startup_is_applied(tmp_path: Path) -> None:
    """A service that is still waiting for its router starts with the latest settings."""
    daemon = Daemon(load_settings(connect=(free_endpoint(),), source=("sim:",)), version="test")
    assert (
        daemon.reload(load_settings(connect=daemon.endpoints, source=("sim:?vehicle=2",)))
        == "no source is running yet"
    )
    with pytest.raises(
        ConfigError, match=r"connect cannot be changed by a reload: restart the service"
    ):
        daemon.reload(load_settings(connect=(free_endpoint(),), source=("sim:",)))
