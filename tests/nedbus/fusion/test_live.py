"""Fusion on the bus: the flight of a real PX4 with vision, replayed by a service."""

from __future__ import annotations

import asyncio
import json
from typing import Final

import pytest

import nedbus
from nedbus.health import Fusion
from tests.flights.ulogs import LOGS
from tests.peers.command_line import run_command
from tests.peers.ports import free_endpoint
from tests.peers.processes import Start

RIGHT: Final = LOGS.parent / "px4" / "ev_right.ulg"
pytestmark = [
    pytest.mark.logs,
    pytest.mark.skipif(not RIGHT.exists(), reason=f"no recording: {RIGHT}"),
]


@pytest.fixture
def endpoint(start: Start) -> str:
    """Replay the flight, which has vision from 3.3 s on, twice as fast."""
    endpoint = free_endpoint()
    start(
        "-m", "nedbus", "serve", "--source", f"ulog:{RIGHT}?topics=*&speed=2", "--listen", endpoint
    )
    return endpoint


def until_fused(bus: nedbus.Bus) -> Fusion:
    """Return the first report with a position that is fused; the flight has one for 25 s."""
    for _ in range(20):
        try:
            report = bus.fusion("2", duration=1.0)
        except nedbus.NoDataError:
            continue
        if report.used:
            return report
    raise AssertionError("never fused")


@pytest.mark.slow
def test_fusion_of_a_vehicle(endpoint: str) -> None:
    """`bus.fusion` reports the state of each quantity and its evidence; AsyncBus returns the same."""
    with nedbus.connect(endpoint, timeout=20) as bus:
        report = until_fused(bus)
    assert {quantity.name: quantity.state for quantity in report.quantities} == dict.fromkeys(
        ("position", "height", "velocity", "yaw"), "fused"
    )
    assert report.echoed == pytest.approx(12.5, abs=3)
    assert (report.sent, report.causes, report.missing) == (None, (), ())

    async def read() -> Fusion:
        async with nedbus.connect_async(endpoint) as bus:
            return await bus.fusion("2", duration=1.0)

    assert asyncio.run(read()).vehicle == "2"


@pytest.mark.long
def test_command_follows_a_vehicle(endpoint: str) -> None:
    """`nedbus fusion` prints each change, as text or JSON; a vehicle without messages is an error."""
    with nedbus.connect(endpoint, timeout=20) as bus:
        until_fused(bus)
    out = run_command("fusion", "-c", endpoint, "--vehicle", "2", "--duration", "2").out
    assert "position, height, velocity, yaw fused since " in out
    [line, *_] = run_command("fusion", "-c", endpoint, "--duration", "2", "--json").out.splitlines()
    assert json.loads(line)["vehicle"] == "2"
    missing = run_command("fusion", "-c", endpoint, "--vehicle", "9", "--duration", "1")
    assert missing.exit_code == 1
    assert "9" in missing.err
