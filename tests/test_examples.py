"""The examples, run unchanged with a simulated vehicle."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from subprocess import PIPE

import numpy as np
import pytest

import nedbus
from tests.flights.messages import VALID, VLP, message
from tests.flights.replays import convert_replay
from tests.nedbus.cli.commands.test_query import simulation
from tests.peers.ports import free_endpoint
from tests.peers.processes import Process, Start
from tests.waits import DEADLINE, wait_for

__all__ = ["simulation"]  # a fixture

EXAMPLES = Path(__file__).parents[1] / "examples"
PRINTS = {
    "position.py": " m up",
    "position_async.py": "Counts(received=",
    "fleet.py": "vehicle 1: 12 streams",
    "compare_estimators.py": "estimator 1: ",
    "batches.py": " m/s",
    "fastest.py": " m/s",
    "plain_zenoh.py": "nedbus/1/vehicle_local_position timestamp ",
    "health.py": "1/vehicle_local_position: ",
    "alarm.py": "vehicle 1: good",
    "mocap.py": "publishing mocap/vehicle_visual_odometry at 50 Hz",
}

RARE = {"fleet.py", "fastest.py", "alarm.py", "mocap.py"}
"""Examples that print rarely, or once."""


def run_example(start: Start, name: str, endpoint: str, folder: Path) -> Process:
    """Run an example with the test's endpoint instead of the default one."""
    script = folder / name
    script.write_text((EXAMPLES / name).read_text().replace("tcp/127.0.0.1:7447", endpoint))
    return start(str(script), NEDBUS_CONNECT=endpoint, PYTHONUNBUFFERED="1", coverage=False)


def test_all_examples_are_tested() -> None:
    """Every script of examples/ has a test."""
    assert {path.name for path in EXAMPLES.glob("*.py")} == {*PRINTS, "publish.py", "resets.py"}


@pytest.mark.slow
@pytest.mark.parametrize("name", PRINTS)
def test_example_runs(start: Start, simulation: str, tmp_path: Path, name: str) -> None:
    """Each example prints its result, and Ctrl-C ends it without an error message."""
    process = run_example(start, name, simulation, tmp_path)
    wait_for(
        lambda: PRINTS[name] in process.out or process.popen.poll() not in {None, 0},
        what=f"{name}: {process.err}",
    )
    assert PRINTS[name] in process.out, process.err
    if name != "fleet.py":  # it ends on its own
        process.signal(signal.SIGINT)
    assert process.wait() == 0, process.err
    assert process.err == ""


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.parametrize("name", sorted(PRINTS.keys() - RARE))
def test_example_ends_quietly_when_its_pipe_is_closed(
    simulation: str, tmp_path: Path, name: str
) -> None:
    """An example whose reader leaves, as in `| head -1`, prints no traceback.

    The default action of SIGPIPE is not used: it would also end a script whose connection to the router breaks.
    """
    script = tmp_path / name
    script.write_text((EXAMPLES / name).read_text().replace("tcp/127.0.0.1:7447", simulation))
    command, environment = (
        [sys.executable, "-u", str(script)],
        os.environ | {"NEDBUS_CONNECT": simulation},
    )
    with subprocess.Popen(command, env=environment, stdout=PIPE, stderr=PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline()
            process.stdout.close()
            assert process.wait(DEADLINE) == 0
            assert process.stderr is not None
            assert process.stderr.read() == ""
        finally:
            process.kill()


@pytest.mark.slow
def test_examples_name_the_endpoint_that_does_not_answer(start: Start, tmp_path: Path) -> None:
    """Without a service, each example prints one line that names the endpoint, and exits with 1."""
    endpoint = free_endpoint()
    names = [*PRINTS.keys() - {"alarm.py"}, "publish.py"]
    for process in [run_example(start, name, endpoint, tmp_path) for name in names]:
        assert process.wait() == 1, process.err
        [line] = process.err.splitlines()
        assert endpoint in line


@pytest.mark.slow
def test_fastest_example_reads_files(start: Start, tmp_path: Path) -> None:
    """The loop of examples/fastest.py over a bus runs on files unchanged; it needs no router."""
    convert_replay("sim:?duration=20", tmp_path / "flight.mcap")
    process = start(str(EXAMPLES / "fastest.py"), str(tmp_path / "flight.mcap"))
    assert process.wait() == 0, process.err
    assert process.out.splitlines()[-1].startswith("1: ")


@pytest.mark.slow
def test_publish_example_moves_its_vehicle(
    start: Start, endpoint: str, bus: nedbus.Bus, tmp_path: Path
) -> None:
    """examples/publish.py publishes changing positions with increasing timestamps."""
    process = run_example(start, "publish.py", endpoint, tmp_path)
    position, topic = nedbus.VehicleLocalPosition, "external_ins_local_position"
    with bus.subscribe(position, topic=topic, vehicle="mine", mode="every") as subscription:
        first, second = (subscription.receive(30).message for _ in range(2))
    assert second.timestamp > first.timestamp
    assert (first.x, first.y) != (second.x, second.y)
    assert process.popen.poll() is None


@pytest.mark.slow
def test_alarm_example_survives_a_restart(run_nedbus: Start, start: Start, tmp_path: Path) -> None:
    """examples/alarm.py waits for the service's router at startup, and again after the service was killed."""
    endpoint = free_endpoint()
    states = ["vehicle 1: good", "vehicle 1: ALARM: nothing arrived for 1 s", "vehicle 1: good"]

    def serve() -> Process:
        service = run_nedbus("serve", "--listen", endpoint, "-s", "sim:", coverage=False)
        wait_for(lambda: "router on" in service.err, what="the router")
        return service

    alarm = run_example(start, "alarm.py", endpoint, tmp_path)
    wait_for(
        lambda: f"vehicle 1: ALARM: nothing answers at {endpoint}" in alarm.out,
        what="the alarm of no router",
    )
    service = serve()
    wait_for(lambda: alarm.out.splitlines()[-1:] == states[:1], what="the first message")
    service.kill()
    wait_for(lambda: alarm.out.splitlines()[-2:] == states[:2], what="the alarm")
    serve()
    wait_for(lambda: alarm.out.splitlines()[-3:] == states, what="the end of the alarm")
    alarm.signal(signal.SIGINT)
    assert alarm.wait() == 0


@pytest.mark.slow
def test_alarm_example_names_the_flags(
    start: Start, endpoint: str, bus: nedbus.Bus, tmp_path: Path
) -> None:
    """examples/alarm.py reports each flag that makes a position doubtful, once."""
    alarm = run_example(start, "alarm.py", endpoint, tmp_path)
    publisher = bus.publisher(VLP, vehicle="1")

    def is_printed(text: str, flags: dict[str, bool]) -> bool:
        publisher.publish(message(1, **VALID | flags))
        return alarm.out.rstrip().endswith(text)

    for text, flags in (
        ("good", {}),
        ("ALARM: xy_valid is false", {"xy_valid": False}),
        ("good", {}),
        (
            "ALARM: z_valid is false, dead_reckoning is true",
            {"z_valid": False, "dead_reckoning": True},
        ),
        (
            "ALARM: v_xy_valid is false, v_z_valid is false",
            {"v_xy_valid": False, "v_z_valid": False},
        ),
    ):
        wait_for(lambda text=text, flags=flags: is_printed(text, flags), what=text)  # type: ignore[misc]
    assert alarm.out.count("xy_valid is false") == 2


@pytest.mark.long
def test_resets_example_plots_both_tracks(start: Start, tmp_path: Path) -> None:
    """examples/resets.py prints the reset after the simulated outage, and plots both tracks and one marker."""
    flight, picture = tmp_path / "flight.mcap", tmp_path / "resets.png"
    convert_replay("sim:?duration=80", flight)
    process = start(str(EXAMPLES / "resets.py"), str(flight), str(picture), MPLBACKEND="agg")
    assert process.wait(60) == 0, process.err
    assert process.out.count("xy reset by") == 1
    pixels = pytest.importorskip("matplotlib.image").imread(picture)[..., :3]
    assert pixels.shape == (600, 800, 3)

    def drawn(color: tuple[float, float, float]) -> tuple[np.ndarray, ...]:
        return np.nonzero(np.abs(pixels - color).max(axis=2) < 0.1)

    dotted, solid, cross = (
        drawn(color) for color in ((0.12, 0.47, 0.71), (1.0, 0.5, 0.05), (1.0, 0.0, 0.0))
    )
    # The figure of eight fills the plot; the dotted track differs from it only after the reset, marked by the cross.
    assert len(solid[0]) > 2000
    assert np.ptp(solid[0]) > 300
    assert np.ptp(solid[1]) > 600
    assert len(dotted[0]) > 60
    assert np.ptp(dotted[0]) > 100
    assert len(cross[0]) >= 10
    assert max(np.ptp(cross[0]), np.ptp(cross[1])) < 12
    distances = np.hypot(dotted[0] - cross[0].mean(), dotted[1] - cross[1].mean())
    assert distances.min() < 12
