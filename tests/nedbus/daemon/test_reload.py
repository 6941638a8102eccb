"""SIGHUP: a running service reads its settings again, and what is unchanged is not disturbed."""

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


def write(file: Path, vehicles: Iterable[object], *, more: str = "") -> None:
    """Write a settings file with a simulated vehicle for each name."""
    sources = [f'[[source]]\nkind = "sim"\nvehicle = "{vehicle}"\n' for vehicle in vehicles]
    file.write_text(more + "\n".join(sources))


def reload(service: Process, answers: int) -> str:
    """Send SIGHUP, wait until the service has said so often what came of it, and return its last words."""
    service.popen.send_signal(signal.SIGHUP)
    wait_for(lambda: service.err.count("reloaded") == answers, what="the answer")
    return [line for line in service.err.splitlines() if "reloaded" in line][-1]


def test_ten_reloads_under_load_lose_nothing(run_nedbus: Start, tmp_path: Path) -> None:
    """Ten vehicles with all their topics go on, message by message, while an eleventh comes and goes."""
    endpoint, file, vehicles = free_endpoint(), tmp_path / "fleet.toml", [str(number) for number in range(10)]
    write(file, vehicles)
    service = run_nedbus("serve", "--listen", endpoint, "--config", str(file))
    wait_for(lambda: service.err.count("seed 0") == len(vehicles), what="the vehicles")
    with nedbus.connect(endpoint, timeout=DEADLINE) as bus, bus.subscribe(VLP, mode="every") as subscription:
        times: dict[str, list[int]] = {}

        def take_until(vehicle: str) -> None:
            begin = time.time_ns()
            while True:
                sample = subscription.receive(DEADLINE)
                times.setdefault(sample.vehicle, []).append(sample.message.timestamp)
                if sample.vehicle == vehicle and (sample.sent or 0) > begin:
                    return

        for number in range(1, 11):
            take_until("0")
            write(file, [*vehicles, "guest"] if number % 2 else vehicles)
            changed = "1 started, 0 stopped" if number % 2 else "0 started, 1 stopped"
            assert f"{changed}, 10 unchanged" in reload(service, number)
            if number % 2:
                take_until("guest")
        for vehicle in vehicles:
            take_until(vehicle)
        assert subscription.counts.lost == subscription.counts.dropped == 0
    assert times.keys() == {*vehicles, "guest"}
    for vehicle in vehicles:
        steps = {after - before for before, after in pairwise(times[vehicle])}
        assert steps == {10_000}, vehicle  # us; a source that began anew would begin at 0
    assert "retrying" not in service.err


def test_broken_settings_change_nothing(run_nedbus: Start, tmp_path: Path) -> None:
    """A file is taken whole or not at all: one wrong source among good ones, or another prefix, refuses it."""
    endpoint, file = free_endpoint(), tmp_path / "nedbus.toml"
    write(file, ["1"])
    service = run_nedbus("serve", "--listen", endpoint, "--config", str(file))
    wait_for(lambda: "seed 0" in service.err, what="the vehicle")
    with nedbus.connect(endpoint, timeout=DEADLINE) as bus:
        write(file, ["1", "2", "a b"])
        assert f"{file}, line 11, column 1: source 'sim:?vehicle=a+b': " in reload(service, 1)
        write(file, ["2"], more='prefix = "other"\n')
        reason = "prefix cannot be changed by a reload: restart the service"
        assert f"{file}, line 1, column 1: {reason}" in reload(service, 2)
        file.write_text("[[source")
        assert f"{file}, line 1, column 9: " in reload(service, 3)
        file.unlink()
        assert "there is no such file" in reload(service, 4)
        assert list(bus.vehicles()) == ["1"]
        write(file, ["2"])
        assert "1 started, 1 stopped, 0 unchanged" in reload(service, 5)
        wait_for(lambda: list(bus.vehicles()) == ["2"], what="the other vehicle")


def test_address_can_move_from_one_source_to_another(run_nedbus: Start, tmp_path: Path) -> None:
    """A removed source has given its addresses back before a new one takes them; a replay at full speed too.

    A source that names no vehicle is another one where the default vehicle is.
    """
    endpoint, file = free_endpoint(), tmp_path / "nedbus.toml"
    file.write_text('source = "sim:?speed=max&duration=1e8"\n')
    service = run_nedbus("serve", "--listen", endpoint, "--config", str(file))
    wait_for(lambda: "seed 0" in service.err, what="the first")
    with nedbus.connect(endpoint, timeout=DEADLINE) as bus:
        for number, vehicle in enumerate(("1", "2"), 1):
            file.write_text(f'vehicle = "{vehicle}"\nsource = "sim:?seed=5"\n')
            assert "1 started, 1 stopped, 0 unchanged" in reload(service, number)
            with bus.subscribe(VLP, vehicle=vehicle) as subscription:
                subscription.receive(DEADLINE)
    assert "this process already publishes" not in service.err


def test_sources_of_flags_stay(run_nedbus: Start) -> None:
    """Flags are above the file: without a change there SIGHUP does nothing, and says so."""
    service = run_nedbus("serve", "--listen", free_endpoint(), "-s", "sim:", "-s", "sim:?vehicle=2")
    wait_for(lambda: service.err.count("seed 0") == 2, what="the vehicles")
    assert "0 started, 0 stopped, 2 unchanged" in reload(service, 1)


def test_reload_before_the_start_is_taken_at_the_start(tmp_path: Path) -> None:
    """A service that still waits for its router starts with what was read last."""
    daemon = Daemon(load_settings(connect=(free_endpoint(),), source=("sim:",)), version="test")
    assert (
        daemon.reload(load_settings(connect=daemon.endpoints, source=("sim:?vehicle=2",))) == "no source is running yet"
    )
    with pytest.raises(ConfigError, match=r"connect cannot be changed by a reload: restart the service"):
        daemon.reload(load_settings(connect=(free_endpoint(),), source=("sim:",)))
