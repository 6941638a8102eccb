"""`nedbus echo`: what it prints, how it ends, and what a paused one costs a replay."""

from __future__ import annotations

import csv
import fcntl
import json
import math
import os
import signal
import struct
import subprocess
import sys
import termios
import threading
from collections.abc import Callable, Iterator
from itertools import pairwise

import pytest

import nedbus
from nedbus_msgs import DEFAULT_TOPIC, VehicleLocalPosition
from tests.conftest import DEADLINE, Start, message, wait_for

from .test_cli import flying

__all__ = ["flying"]  # a fixture

pytestmark = pytest.mark.process

VLP = DEFAULT_TOPIC
REPLAY = "sim:?duration=150&speed=max"  # 15,000 messages: more than the queues of a paused reader hold
LINE = 1000  # bytes that a line of JSON has at least


class PausedEcho:
    """`nedbus echo` whose stdout is a full pipe that nobody reads, until `resume`."""

    def __init__(self, endpoint: str, *options: str) -> None:
        self._output, write_end = os.pipe()
        self._capacity = fcntl.fcntl(write_end, fcntl.F_SETPIPE_SZ, 4096)
        command = [sys.executable, "-m", "nedbus", "echo", "-c", endpoint, "--json", *options]
        self.popen = subprocess.Popen(command, stdout=write_end, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL)
        os.close(write_end)
        self._reader = threading.Thread(target=self._read_all)

    @property
    def is_full(self) -> bool:
        """Whether the pipe cannot hold another line, so that the next one blocks the process."""
        unread = struct.unpack("i", fcntl.ioctl(self._output, termios.FIONREAD, bytes(4)))[0]
        return bool(unread > self._capacity - LINE)

    def resume(self) -> None:
        self._reader.start()

    def close(self) -> None:
        self.popen.kill()
        self.popen.wait(DEADLINE)
        if self._reader.is_alive():
            self._reader.join(DEADLINE)
        os.close(self._output)

    def _read_all(self) -> None:
        while os.read(self._output, 65536):
            pass


@pytest.fixture
def pause_echo(endpoint: str, bus: nedbus.Bus) -> Iterator[Callable[..., PausedEcho]]:
    """Start `nedbus echo --json` with more options, and publish until its output blocks."""
    started: list[PausedEcho] = []

    def start_echo(*options: str) -> PausedEcho:
        echo = PausedEcho(endpoint, *options)
        started.append(echo)
        with bus.publisher(VLP, vehicle="filler") as publisher:

            def publish_until_full() -> bool:
                publisher.publish(message(1))
                return echo.is_full

            wait_for(publish_until_full, what="the pipe to be full")
        return echo

    yield start_echo
    for echo in started:
        echo.close()


def test_echo_prints_a_line_each(run_nedbus: Start, flying: str) -> None:
    """--topic, --vehicle and --count choose; the topic may also be an argument, as in ros2 topic echo."""
    for arguments in (["--topic", VLP], [VLP], ["/" + VLP], ["1/" + VLP]):
        echo = run_nedbus("echo", "-c", flying, "--count", "20", *arguments)
        assert echo.wait() == 0, echo.err
        lines = echo.out.splitlines()
        assert len(lines) == 20
        assert all(line.startswith("1/vehicle_local_position ") and " ned " in line for line in lines)


def test_echo_json_is_the_message(run_nedbus: Start, flying: str) -> None:
    """Each line is JSON that the model reads back, "Infinity" included."""
    echo = run_nedbus("echo", "-c", flying, "--json", "-n", "30")
    assert echo.wait() == 0
    rows = [json.loads(line) for line in echo.out.splitlines()]
    assert len(rows) == 30
    for row in rows:
        assert set(row) == {"vehicle", "topic", "instance", "received", "sent", "lost", "source", "missing", "message"}
        assert (row["source"], row["missing"]) == ("sim", [])
        VehicleLocalPosition.model_validate_json(json.dumps(row["message"]))
    assert any(row["message"]["vxy_max"] == "Infinity" for row in rows)


def test_echo_full_prints_every_field(run_nedbus: Start, flying: str) -> None:
    """--full has all 53 fields, each on its line."""
    echo = run_nedbus("echo", "-c", flying, "--full", "-n", "2", VLP)
    assert echo.wait() == 0
    blocks = echo.out.split("---\n")
    assert len(blocks) == 3
    names = [line.split(":")[0].strip() for line in blocks[0].splitlines()[1:]]
    assert names == list(VehicleLocalPosition.model_fields)


def test_interrupt_is_130(run_nedbus: Start, flying: str) -> None:
    """Ctrl-C ends echo at once and quietly."""
    echo = run_nedbus("echo", "-c", flying, measured=False)
    wait_for(lambda: echo.out, what="a line")
    echo.signal(signal.SIGINT)
    assert echo.wait() == 130
    assert "Traceback" not in echo.err


def test_closed_pipe_is_no_error(flying: str) -> None:
    """`nedbus echo | head` ends without a message."""
    command = f"{sys.executable} -m nedbus echo -c {flying} | head -n 3"
    ended = subprocess.run(["bash", "-c", command], capture_output=True, timeout=DEADLINE, check=True, text=True)
    assert len(ended.stdout.splitlines()) == 3
    assert ended.stderr == ""


def test_echo_reports_losses_and_invalid_payloads(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """Losses and invalid payloads are counted on stderr at the end."""
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    echo = run_nedbus("echo", "-c", endpoint, "-n", "2")
    wait_for(lambda: echo.out, what="the first line")
    bus._session.put("nedbus/1/vehicle_local_position", b"garbage")
    wait_for(lambda: "not a VehicleLocalPosition" in echo.err, what="the warning")
    publisher.publish(message(2))
    assert echo.wait() == 0
    assert "2 received, 0 lost, 0 dropped, 1 invalid" in echo.err


def test_last_value_of_an_ended_stream_is_marked(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """A last value is marked as old by echo, and hz does not measure it."""
    bus.publisher(VLP, vehicle="1").publish(message(1))
    wait_for(lambda: any((sample.latency or 0) > 1.1 for sample in bus.latest()), what="the message to be old")
    echo = run_nedbus("echo", "-c", endpoint, "-n", "1")
    assert echo.wait() == 0
    assert " s old]" in echo.out
    hz = run_nedbus("hz", "-c", endpoint, "-d", "1.5")
    assert hz.wait() == 1
    assert "nothing arrived" in hz.err


def test_paused_echo_does_not_hold_up_a_replay(
    run_nedbus: Start, endpoint: str, pause_echo: Callable[..., PausedEcho]
) -> None:
    """A replay as fast as its readers take it ends, though the output of an echo is blocked.

    The next test is the same with --every, where the replay waits: that it can end here is due to mode "latest".
    """
    echo = pause_echo()
    service = run_nedbus("serve", "--connect", endpoint, "--until-done", "-s", REPLAY)
    assert service.wait() == 0, service.err
    assert "slow reader" not in service.err
    assert echo.popen.poll() is None
    assert echo.is_full


def test_replay_waits_for_echo_every(run_nedbus: Start, endpoint: str, pause_echo: Callable[..., PausedEcho]) -> None:
    """With --every a replay at speed=max waits for the output of an echo, and ends when that is read."""
    echo = pause_echo("--every")
    service = run_nedbus("serve", "--connect", endpoint, "--until-done", "-s", REPLAY)
    wait_for(lambda: "waiting for a slow reader" in service.err, what="the replay to wait")
    assert service.popen.poll() is None
    echo.resume()
    assert service.wait() == 0, service.err


def test_echo_every_skips_nothing(run_nedbus: Start, endpoint: str) -> None:
    """--every prints each message of a replay, in order, however fast it comes."""
    echo = run_nedbus("echo", "-c", endpoint, "--json", "--every", "-n", "1000")
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:?duration=10&speed=max&wait=1")
    assert echo.wait() == 0, echo.err
    timestamps = [json.loads(line)["message"]["timestamp"] for line in echo.out.splitlines()]
    assert len(timestamps) == 1000
    assert {later - earlier for earlier, later in pairwise(timestamps)} == {10_000}


def test_echo_without_a_topic_is_the_position(run_nedbus: Start, flying: str) -> None:
    """Without a topic it is vehicle_local_position of all vehicles; "*" is all topics."""
    echo = run_nedbus("echo", "-c", flying, "--json", "-n", "20")
    assert echo.wait() == 0, echo.err
    assert {json.loads(line)["topic"] for line in echo.out.splitlines()} == {VLP}
    every = run_nedbus("echo", "-c", flying, "--json", "-n", "50", "*")
    assert every.wait() == 0, every.err
    assert len({json.loads(line)["topic"] for line in every.out.splitlines()}) > 1


def test_help_explains_every(run_nedbus: Start) -> None:
    """The help of --every warns that a replay waits."""
    shown = run_nedbus("echo", "--help", COLUMNS="300")
    assert shown.wait() == 0
    assert "a replay at speed=max then waits" in shown.out


def test_echo_csv_of_two_vehicles(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """--csv --field x,y,z writes names, then a row for each message of all vehicles; NaN and pairs included."""
    run_nedbus("serve", "-c", endpoint, "-s", "sim:", "-s", "sim:?vehicle=2")
    wait_for(lambda: len(bus.latest()) == 2, what="two vehicles")
    echo = run_nedbus("echo", "-c", endpoint, "--csv", "--field", "x,y,delta_xy,xy_valid", "-n", "50")
    assert echo.wait() == 0, echo.err
    rows = list(csv.DictReader(echo.out.splitlines()))
    names = ["vehicle", "topic", "instance", "sent", "timestamp", "x", "y", "delta_xy[0]", "delta_xy[1]", "xy_valid"]
    assert list(rows[0]) == names
    assert len(rows) == 50
    assert {row["vehicle"] for row in rows} == {"1", "2"}
    assert all(int(row["sent"]) > int(row["timestamp"]) * 1000 and row["xy_valid"] == "True" for row in rows)
    assert all(math.isfinite(float(row["x"])) for row in rows)
    complete = run_nedbus("echo", "-c", endpoint, "--csv", "--once")
    assert complete.wait() == 0, complete.err
    head, row = csv.reader(complete.out.splitlines())
    assert len(head) == len(row) == 4 + len(VehicleLocalPosition.model_fields) + 2


def test_echo_shows_chosen_fields(run_nedbus: Start, flying: str) -> None:
    """--field chooses in every form; --once ends after one message."""
    for form, text in (([], "  x "), (["--full"], "\n  x: "), (["--json"], '"message": {"x":')):
        echo = run_nedbus("echo", "-c", flying, "--once", "--field", "x,z", *form)
        assert echo.wait() == 0, echo.err
        assert text in echo.out
        assert "vx" not in echo.out
        assert echo.out.count("vehicle_local_position") == 1


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--field", "xy_vallid"], "--field: there is no field 'xy_vallid': did you mean xy_valid"),
        (["--field", "qqq"], "--field: there is no field 'qqq': 'nedbus schema' lists them"),
        (["--csv", "--json"], "--csv: cannot be combined with --json"),
        (["--once", "-n", "3"], "--count: cannot be combined with --once"),
    ],
)
def test_echo_options_that_contradict(run_nedbus: Start, endpoint: str, options: list[str], text: str) -> None:
    """Exit 2, and what to write instead."""
    echo = run_nedbus("echo", "-c", endpoint, *options)
    assert echo.wait() == 2
    assert text in echo.err


def test_hz_csv(run_nedbus: Start, flying: str) -> None:
    """A line of names, then one for each stream and second, with its state."""
    hz = run_nedbus("hz", "-c", flying, "--csv", "-d", "3", "-t", VLP)
    assert hz.wait() == 0, hz.err
    rows = list(csv.DictReader(hz.out.splitlines()))
    assert len(rows) >= 2
    assert {(row["vehicle"], row["topic"]) for row in rows} == {("1", VLP)}
    assert {row["state"] for row in rows} <= {"ok", "slow"}  # slow on a machine that is busy
    assert float(rows[-1]["rate"]) > 1
    assert float(rows[0]["time"]) < float(rows[-1]["time"])
