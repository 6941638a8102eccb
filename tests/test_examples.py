"""The examples, as they stand, against a service with a simulated flight."""

from __future__ import annotations

from pathlib import Path

import pytest

import nedbus
from nedbus.recorder import convert
from tests.conftest import Process, Start, wait_for
from tests.replays import open_replay

EXAMPLES = Path(__file__).parents[1] / "examples"
SAYS = {
    "position.py": "1 external_ins_local_position ",
    "position_async.py": "Counts(received=",
    "fleet.py": "vehicle 1: 5 streams",
    "compare_estimators.py": "estimator 1: ",
    "batches.py": " m/s",
    "plain_zenoh.py": "nedbus/1/vehicle_local_position timestamp ",
    "health.py": "1/vehicle_local_position: ",
}


@pytest.fixture
def flying(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> str:
    """Run a service with a simulated vehicle on the test's router."""
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    wait_for(lambda: len(bus.latest()) == 5, what="five streams")
    return endpoint


def run_example(start: Start, name: str, endpoint: str, where: Path) -> Process:
    """Run an example; one that names the default endpoint is given this test's."""
    script = where / name
    script.write_text((EXAMPLES / name).read_text().replace("tcp/127.0.0.1:7447", endpoint))
    return start(str(script), NEDBUS_CONNECT=endpoint, PYTHONUNBUFFERED="1")


def test_all_examples_are_tested() -> None:
    """No example without a test."""
    assert {path.name for path in EXAMPLES.glob("*.py")} == {*SAYS, "publish.py", "resets.py"}


@pytest.mark.parametrize("name", SAYS)
def test_example_runs(start: Start, flying: str, tmp_path: Path, name: str) -> None:
    """Each example says what it is for, and no error."""
    process = run_example(start, name, flying, tmp_path)
    wait_for(lambda: SAYS[name] in process.out or process.popen.poll() not in {None, 0}, what=f"{name}: {process.err}")
    assert SAYS[name] in process.out, process.err
    assert process.err == ""


def test_publishing_example_publishes(start: Start, endpoint: str, bus: nedbus.Bus, tmp_path: Path) -> None:
    """The vehicle of examples/publish.py moves."""
    process = run_example(start, "publish.py", endpoint, tmp_path)
    with bus.subscribe("external_ins_local_position", vehicle="mine", mode="every") as subscription:
        first, second = (subscription.receive(30).message for _ in range(2))
    assert second.timestamp > first.timestamp
    assert (first.x, first.y) != (second.x, second.y)
    assert process.popen.poll() is None


def test_resets_are_drawn(start: Start, tmp_path: Path) -> None:
    """examples/resets.py finds the reset at the end of the simulated outage, and draws both tracks."""
    flight, picture = tmp_path / "flight.mcap", tmp_path / "resets.png"
    convert(open_replay("sim:?duration=80"), flight, source="sim", on_progress=lambda _: None)
    process = start(str(EXAMPLES / "resets.py"), str(flight), str(picture), MPLBACKEND="agg")
    assert process.wait(60) == 0, process.err
    assert process.out.count("xy reset by") == 1
    assert picture.read_bytes().startswith(b"\x89PNG")
