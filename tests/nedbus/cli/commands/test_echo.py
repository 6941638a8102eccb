"""`nedbus echo`: its output, its exit codes, and the effect of blocked output on a replay."""

from __future__ import annotations

import csv
import fcntl
import json
import math
import os
import signal
import struct
import termios
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest

import nedbus
from nedbus.timings import Timings
from nedbus.transport import Session
from nedbus_msgs import BY_TOPIC, VehicleLocalPosition
from tests.flights.messages import VALID, VLP, message
from tests.flights.replays import open_replay
from tests.nedbus.cli.output.test_terminal import publishing
from tests.peers.command_line import CommandResult, fork_command, run_command
from tests.peers.processes import ForkedProcess, ForkServer, Start
from tests.waits import DEADLINE, repeating, wait_for

from .test_query import simulation

__all__ = ["simulation"]  # a fixture

pytestmark = pytest.mark.process

# 4,000 messages, more than the window of a lossless publisher
REPLAY = f"sim:?duration=40&speed=max&topics={VLP}"
LINE = 1000  # minimum length of a line of JSON [bytes]


def echo(endpoint: str, *options: str) -> CommandResult:
    """Run `nedbus echo` with options that make it exit."""
    ended = run_command("echo", "-c", endpoint, *options)
    assert ended.exit_code == 0, ended.err
    return ended


class Paused(NamedTuple):
    """`nedbus echo` blocked by a full stdout pipe, which is not read until `resume`; `output`: what was read."""

    process: ForkedProcess
    is_full: Callable[[], bool]
    resume: Callable[[], None]
    output: bytearray


@pytest.fixture
def pause_echo(
    fork_server: ForkServer, endpoint: str, bus: nedbus.Bus
) -> Callable[..., AbstractContextManager[Paused]]:
    """Return a context manager that starts `nedbus echo --json` and publishes until its output blocks."""

    @contextmanager
    def pause(*options: str) -> Iterator[Paused]:
        output, write_end = os.pipe()
        capacity = fcntl.fcntl(write_end, fcntl.F_SETPIPE_SZ, 4096)
        process = fork_command(
            fork_server, "echo", "-c", endpoint, "--json", *options, out=write_end
        )
        os.close(write_end)

        def is_full() -> bool:  # writing another line blocks the process
            unread = struct.unpack("i", fcntl.ioctl(output, termios.FIONREAD, bytes(4)))[0]
            return bool(unread > capacity - LINE)

        def publish_until_full() -> bool:
            publisher.publish(message(1))
            return is_full()

        def read_all() -> None:
            while part := os.read(output, 65536):
                content.extend(part)

        content = bytearray()
        reader = threading.Thread(target=read_all)
        try:
            with bus.publisher(VLP, vehicle="filler") as publisher:
                wait_for(publish_until_full, what="the pipe to be full")
            yield Paused(process, is_full, reader.start, content)
        finally:
            process.kill()
            process.wait(DEADLINE)
            if reader.is_alive():
                reader.join(DEADLINE)
            os.close(output)

    return pause


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["--topic", VLP], [VLP], ["/" + VLP], ["1/" + VLP], []])
def test_echo_prints_one_line_per_message(simulation: str, arguments: list[str]) -> None:
    """The topic is an option or an argument, by default vehicle_local_position; --count limits the lines."""
    lines = echo(simulation, "--count", "5", *arguments).out.splitlines()
    assert len(lines) == 5
    assert all(line.startswith("1/vehicle_local_position ") and " ned " in line for line in lines)


def test_echo_json_can_be_parsed_by_the_model(simulation: str) -> None:
    """With --json, each line is an object that the model validates, even with "Infinity"; "*" selects all topics."""
    rows = [
        json.loads(line) for line in echo(simulation, "--json", "-n", "50", "*").out.splitlines()
    ]
    has = {
        each.address.topic: each.fields.keys()
        for each in open_replay("sim:?duration=15&speed=max").messages
    }
    assert len(rows) == 50
    for row in rows:
        assert set(row) == {
            "vehicle",
            "topic",
            "instance",
            "received",
            "sent",
            "lost",
            "source",
            "missing",
            "message",
        }
        assert row["source"] == "sim"
        message = BY_TOPIC[row["topic"]].model.model_validate_json(json.dumps(row["message"]))
        assert set(row["missing"]) == message.DEFINITION.all_fields - has[row["topic"]]
    assert any(row["message"].get("vxy_max") == "Infinity" for row in rows)
    assert len({row["topic"] for row in rows}) > 1


@pytest.mark.slow
def test_echo_and_record_select_several_vehicles_and_topics(
    bus: nedbus.Bus, endpoint: str, tmp_path: Path
) -> None:
    """`-v` several times and several topics select their product, in `echo` and `record`."""
    for vehicle in ("a", "b", "c"):
        bus.publisher(VLP, vehicle=vehicle).publish(message(1))
        bus.publisher("vehicle_attitude", vehicle=vehicle).publish({"q": (1.0, 0.0, 0.0, 0.0)})
        bus.publisher("battery_status", vehicle=vehicle, instance=0).publish({"voltage_v": 16.0})
    selected = {
        f"{vehicle}/{topic}" for vehicle in ("a", "b") for topic in (VLP, "vehicle_attitude")
    }
    options = [VLP, "vehicle_attitude", "-v", "a", "-v", "b"]
    assert {
        line.split()[0] for line in echo(endpoint, "--count", "4", *options).out.splitlines()
    } == selected
    recording = tmp_path / "two.mcap"
    ended = run_command("record", "-c", endpoint, *options, "-o", str(recording), "--duration", "1")
    assert ended.exit_code == 0, ended.err
    with nedbus.open(recording) as flight:
        assert {str(address) for address in flight.addresses} == selected
        assert {sample.vehicle for sample in flight("*", vehicle=["b", "c"])} == {"b"}


def test_echo_shows_flags_that_are_false(bus: nedbus.Bus, endpoint: str) -> None:
    """A flag of a message without a line of its own is shown whether it is true or false."""
    definition = nedbus.define_msg("Gripper", "uint64 timestamp\nbool is_open\nbool is_holding")
    publisher = bus.publisher("gripper", vehicle="1", definition=definition)
    publisher.publish({"timestamp": 1, "is_open": False, "is_holding": True})
    [line] = echo(endpoint, "--once", "gripper").out.splitlines()
    assert line.endswith("  is_holding  is_open False")


def test_echo_full_prints_every_field(simulation: str) -> None:
    """--full prints all 53 fields, one per line."""
    blocks = echo(simulation, "--full", "-n", "2", VLP).out.split("---\n")
    assert len(blocks) == 3
    names = [line.split(":")[0].strip() for line in blocks[0].splitlines()[1:]]
    assert names == list(VehicleLocalPosition.model_fields)


@pytest.mark.slow
def test_interrupt_exits_with_130(run_nedbus: Start, simulation: str) -> None:
    """Ctrl-C ends `nedbus echo` at once, without a traceback."""
    process = run_nedbus("echo", "-c", simulation, coverage=False)
    wait_for(lambda: process.out, what="a line")
    process.signal(signal.SIGINT)
    assert process.wait() == 130
    assert "Traceback" not in process.err


@pytest.mark.slow
@pytest.mark.parametrize(("number", "exit_code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_echo_prints_received_messages_before_a_signal_ends_it(
    bus: nedbus.Bus,
    pause_echo: Callable[..., AbstractContextManager[Paused]],
    number: signal.Signals,
    exit_code: int,
) -> None:
    """Messages that `echo --every` has received, but not printed yet, are printed before it exits."""
    with pause_echo("--every") as paused:
        with bus.publisher(VLP, vehicle="last") as publisher:
            for timestamp in range(1, 51):
                publisher.publish(message(timestamp))
            assert publisher.flush(DEADLINE)
        paused.process.send_signal(number)
        paused.resume()
        assert paused.process.wait(DEADLINE) == exit_code
        wait_for(lambda: paused.output.count(b"\n") >= 50, what="the output")
        lines = [json.loads(line) for line in paused.output.splitlines()]
    printed = [each["message"]["timestamp"] for each in lines if each["vehicle"] == "last"]
    assert printed == [*range(1, 51)]


@pytest.mark.slow
def test_closed_pipe_exits_with_0(simulation: str, fork_server: ForkServer) -> None:
    """`nedbus echo | head` ends without an error message."""
    read_end, write_end = os.pipe()
    with Path("err").open("wb") as err, os.fdopen(read_end) as head:
        process = fork_command(
            fork_server, "echo", "-c", simulation, out=write_end, err=err.fileno()
        )
        os.close(write_end)
        assert all(head.readline().startswith(f"1/{VLP} ") for _ in range(3))
    assert process.wait(DEADLINE) == 0
    assert Path("err").read_text() == ""


@pytest.mark.slow
def test_echo_prints_counts_at_exit(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus, zenoh_session: Session
) -> None:
    """At exit, stderr reports the numbers of lost messages and invalid payloads."""
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1))
    process = run_nedbus("echo", "-c", endpoint, "-n", "2")
    wait_for(lambda: process.out, what="the first line")
    zenoh_session.put(publisher.key, b"garbage")
    wait_for(lambda: "not a VehicleLocalPosition" in process.err, what="the warning")
    publisher.publish(message(2))
    assert process.wait() == 0
    assert "2 received, 0 lost, 0 skipped (--every prints all), 1 invalid" in process.err


def test_old_last_message_is_marked(endpoint: str, bus: nedbus.Bus, timings: Timings) -> None:
    """`echo` marks a retained message beyond the age limit as old, and `hz` does not count it."""
    timings.old = 0.01
    bus.publisher(VLP, vehicle="1").publish(message(1))
    wait_for(
        lambda: any((sample.latency or 0) > 0.01 for sample in bus.latest()),
        what="the message to be old",
    )
    assert "s old]" in echo(endpoint, "-n", "1").out
    hz = run_command("hz", "-c", endpoint, "-d", "0.5")
    assert hz.exit_code == 1
    assert "nothing arrived" in hz.err


@pytest.mark.long
def test_blocked_echo_does_not_delay_a_replay(
    run_nedbus: Start, endpoint: str, pause_echo: Callable[..., AbstractContextManager[Paused]]
) -> None:
    """A replay at speed=max ends even if `echo` is blocked, because `echo` subscribes in mode "latest".

    With --every the replay waits until the output of `echo` is read.
    """
    replay = ("serve", "--connect", endpoint, "--until-done", "-s", REPLAY)
    with pause_echo() as paused:
        service = run_nedbus(*replay)
        assert service.wait() == 0, service.err
        assert "slow reader" not in service.err
        assert paused.process.poll() is None
        assert paused.is_full()
    with pause_echo("--every") as paused:
        service = run_nedbus(*replay)
        wait_for(lambda: "waiting for a slow reader" in service.err, what="the replay to wait")
        assert service.popen.poll() is None
        paused.resume()
        assert service.wait() == 0, service.err


@pytest.mark.slow
def test_echo_every_prints_all_messages(run_nedbus: Start, endpoint: str) -> None:
    """--every prints all messages of a replay in order, at any speed; its help warns that the replay waits."""
    assert "a replay at speed=max waits" in run_command("echo", "--help", COLUMNS="300").out
    run_nedbus(
        "serve", "--connect", endpoint, "-s", f"sim:?duration=10&speed=max&wait=1&topics={VLP}"
    )
    lines = echo(endpoint, "--json", "--every", "-n", "1000").out.splitlines()
    timestamps = [json.loads(line)["message"]["timestamp"] for line in lines]
    assert len(timestamps) == 1000
    assert {later - earlier for earlier, later in pairwise(timestamps)} == {10_000}


def test_echo_csv_has_a_row_per_message(endpoint: str, bus: nedbus.Bus) -> None:
    """--csv writes a header line and one row per message of all vehicles; arrays have one column per element."""
    with publishing(bus, "1", "2"):
        lines = echo(
            endpoint, "--csv", "--field", "x,y,delta_xy,xy_valid", "-n", "10"
        ).out.splitlines()
        head, row = csv.reader(echo(endpoint, "--csv", "--once").out.splitlines())
    assert len(head) == len(row) == 5 + len(VehicleLocalPosition.model_fields) + 2 + 1
    rows = list(csv.DictReader(lines))
    fields = ["x", "y", "delta_xy[0]", "delta_xy[1]", "xy_valid"]
    assert list(rows[0]) == [
        "vehicle",
        "topic",
        "instance",
        "utc",
        "sent",
        "timestamp",
        *fields,
        "state",
    ]
    assert len(rows) == 10
    assert {each["vehicle"] for each in rows} == {"1", "2"}
    assert all(int(each["sent"]) > 10**18 and each["timestamp"] == "1" for each in rows)
    assert all(math.isfinite(float(each["x"])) and each["xy_valid"] == "True" for each in rows)
    for each in rows:
        assert datetime.fromisoformat(each["utc"]).timestamp() == pytest.approx(
            int(each["sent"]) / 1e9, abs=1e-5
        )


def test_echo_offers_derived_fields_by_name(endpoint: str, bus: nedbus.Bus) -> None:
    """--field accepts height, speed and angles in every format; they are NaN while invalid."""
    fields = VALID | {"z": -12.5, "vx": 3.0, "vy": 4.0, "v_xy_valid": False}
    publisher = bus.publisher(VLP, vehicle="1")
    publisher.publish(message(1, **fields))
    names = "--field", "height,speed"
    [row] = csv.DictReader(echo(endpoint, "--csv", *names, "--once").out.splitlines())
    assert (row["height"], row["speed"]) == ("12.5", "nan")
    found = json.loads(echo(endpoint, "--json", *names, "--once").out)["message"]
    assert found == {"height": 12.5, "speed": "NaN"}
    assert "height 12.5  speed nan" in echo(endpoint, *names, "--once").out


def test_echo_csv_marks_invalid_positions_and_ends_with_counts(
    endpoint: str, bus: nedbus.Bus
) -> None:
    """Every position row includes its state, whatever fields are selected; the message counts follow on stderr."""
    bus.publisher(VLP, vehicle="1").publish(message(1, **VALID | {"xy_valid": False}))
    result = echo(endpoint, "--csv", "--field", "x", "--duration", "0.5")
    [row] = csv.DictReader(result.out.splitlines())
    assert row["state"] == "xy invalid"
    assert result.err == "1 received, 0 lost, 0 skipped (--every prints all), 0 invalid\n"


def test_echo_field_selects_fields(simulation: str) -> None:
    """--field selects fields in every format; --once exits after one message."""
    for form, text in (([], "  x "), (["--full"], "\n  x: "), (["--json"], '"message": {"x":')):
        out = echo(simulation, "--once", "--field", "x,z", *form).out
        assert text in out
        assert "vx" not in out
        assert out.count("vehicle_local_position") == 1


@pytest.mark.slow
def test_notice_of_silence_is_written_once(endpoint: str, timings: Timings) -> None:
    """`echo` says once that it waits, however long it does."""
    timings.first_sample = 0.1
    ended = run_command("echo", "-c", endpoint, "--duration", "2.2")
    assert ended.exit_code == 1
    assert ended.err.count("yet, still waiting") == 1


def test_count_is_that_of_printed_messages(endpoint: str, bus: nedbus.Bus) -> None:
    """With --interval, messages that are not printed do not count, so --count waits for further ones."""
    publisher = bus.publisher(VLP, vehicle="1")
    with repeating(lambda: publisher.publish(message(1))):
        ended = run_command("echo", "-c", endpoint, "--every", "--interval", "0.3", "-n", "3")
    assert ended.exit_code == 0
    assert len(ended.out.splitlines()) == 3
