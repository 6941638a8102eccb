"""The commands as typed: their output and their exit codes."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

import nedbus
from nedbus_msgs import ANY, DEFAULT_TOPIC, LAYOUTS, json_schema
from tests.conftest import DEADLINE, Start, free_endpoint, message, wait_for

VLP = DEFAULT_TOPIC


@pytest.fixture
def flying(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> str:
    """Run a service with a simulated vehicle on the test's router."""
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    wait_for(lambda: len(bus.latest(ANY)) == 5, what="five streams")
    return endpoint


def test_list_shows_what_is_published(run_nedbus: Start, flying: str) -> None:
    """A row for each vehicle and topic: its age, and whether to trust it."""
    listed = run_nedbus("list", "-c", flying)
    assert listed.wait() == 0, listed.err
    head, *lines = listed.out.splitlines()
    assert head.split() == ["VEHICLE/TOPIC", "AGE", "STATE"]
    assert [line.split()[0] for line in lines] == [
        "1/estimator_local_position/0",
        "1/estimator_local_position/1",
        "1/external_ins_local_position",
        "1/vehicle_local_position",
        "1/vehicle_local_position_groundtruth",
    ]
    assert all(line.endswith("ok") for line in lines)
    machine = run_nedbus("list", "-c", flying, "--json")
    assert machine.wait() == 0
    rows = [json.loads(line) for line in machine.out.splitlines()]
    assert [row["instance"] for row in rows] == [0, 1, None, None, None]
    assert all(row["vehicle"] == "1" and row["age"] >= 0 for row in rows)


def test_list_of_one_vehicle(run_nedbus: Start, flying: str, bus: nedbus.Bus) -> None:
    """--vehicle lists one vehicle, also one of which nobody answers, and says when it is not there."""
    bus.publisher(VLP, vehicle="2").publish(message(1))
    bus.publisher(VLP, vehicle="silent")
    for vehicle, count in (("1", 5), ("2", 1), ("silent", 1), ("3", 0)):
        listed = run_nedbus("list", "-c", flying, "--vehicle", vehicle, "--json")
        assert listed.wait() == 0, listed.err
        assert [json.loads(line)["vehicle"] for line in listed.out.splitlines()] == [vehicle] * count
        assert ("no vehicle 3 is published at" in listed.err) == (vehicle == "3")


def test_hz_measures(run_nedbus: Start, flying: str) -> None:
    """Rate, jitter, latency and loss of each stream; the rate of the estimate is near 100 Hz."""
    hz = run_nedbus("hz", "-c", flying, "--duration", "3")
    assert hz.wait() == 0, hz.err
    lines = hz.out.splitlines()
    assert lines[0].split() == ["VEHICLE/TOPIC", "HZ", "JITTER", "LATENCY", "MAX", "LOST", "STATE"]
    machine = run_nedbus("hz", "-c", flying, "-d", "2.5", "--json", "-t", VLP)
    assert machine.wait() == 0
    rows = [json.loads(line) for line in machine.out.splitlines()]
    assert {row["topic"] for row in rows} == {VLP}
    assert all(
        set(row) >= {"rate", "jitter", "latency", "latency_max", "lost", "flags", "gaps", "reboots"} for row in rows
    )
    assert any(row["rate"] is not None and 20 < row["rate"] < 500 for row in rows)
    assert rows[-1]["lost"] == 0


def test_get_shows_the_last_message(run_nedbus: Start, flying: str) -> None:
    """All fields of the last message, of vehicle_local_position unless a topic is given; exit 1 when there is none."""
    got = run_nedbus("get", "-c", flying, "estimator_local_position", "--instance", "1")
    assert got.wait() == 0, got.err
    assert got.out.startswith("1/estimator_local_position/1, ")
    assert "  hagl_max_xy: inf" in got.out
    machine = run_nedbus("get", "-c", flying, "--json", "*")
    assert machine.wait() == 0
    assert len(machine.out.splitlines()) == 5
    default = run_nedbus("get", "-c", flying, "--json")
    assert default.wait() == 0
    assert [json.loads(line)["topic"] for line in default.out.splitlines()] == [VLP]
    chosen = run_nedbus("get", "-c", flying, "--field", "x,eph")
    assert chosen.wait() == 0, chosen.err
    assert [line.split(":")[0] for line in chosen.out.splitlines()[1:]] == ["  x", "  eph", "---"]
    machine = run_nedbus("get", "-c", flying, "--json", "--field", "x")
    assert machine.wait() == 0, machine.err
    assert json.loads(machine.out)["message"].keys() == {"x"}
    nobody = run_nedbus("get", "-c", flying, "--vehicle", "99")
    assert nobody.wait() == 1
    assert f"nothing is published on nedbus/99/{VLP}" in nobody.err


def test_info_shows_the_services(run_nedbus: Start, flying: str) -> None:
    """The services, what their sources do, and what was rejected."""
    info = run_nedbus("info", "-c", flying)
    assert info.wait() == 0, info.err
    assert f"router    {flying}" in info.out
    assert "vehicles  1" in info.out
    assert "SOURCE" in info.out
    assert "running" in info.out
    machine = run_nedbus("info", "-c", flying, "--json")
    assert machine.wait() == 0
    assert json.loads(machine.out)["sources"][0]["source"] == "sim:"


def test_schema_needs_no_network(run_nedbus: Start) -> None:
    """The JSON Schema, and the layouts, as JSON."""
    schema = run_nedbus("schema")
    assert schema.wait() == 0
    assert json.loads(schema.out) == json_schema()
    layouts = run_nedbus("schema", "--layouts")
    assert layouts.wait() == 0
    assert [layout["name"] for layout in json.loads(layouts.out)] == list(LAYOUTS)


def test_no_data_yet_is_reported(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """With a router but no vehicle: list says so, echo says so and waits."""
    listed = run_nedbus("list", "-c", endpoint)
    assert listed.wait() == 0
    assert (listed.out, "no vehicle is published" in listed.err) == ("", True)
    echo = run_nedbus("echo", "-c", endpoint, "-n", "1")
    wait_for(lambda: "yet, waiting" in echo.err, what="echo to report that nothing is there")
    bus.publisher(VLP, vehicle="7").publish(message(5, x=1.0))
    assert echo.wait() == 0
    assert echo.out.startswith("7/vehicle_local_position ")


@pytest.mark.parametrize(("command", "key_expr"), [("echo", f"nedbus/*/{VLP}"), ("hz", "nedbus/*/**")])
def test_duration_without_data_fails(run_nedbus: Start, endpoint: str, command: str, key_expr: str) -> None:
    """A script that follows for a while learns from the exit code that nothing came."""
    watch = run_nedbus(command, "-c", endpoint, "--duration", "0.3")
    assert watch.wait() == 1
    assert f"nothing arrived on {key_expr} within 0.3 s" in watch.err


@pytest.mark.parametrize("command", ["list", "echo", "hz", "get", "info"])
def test_no_router_is_one_clear_line(run_nedbus: Start, command: str) -> None:
    """Exit 1, one line: where, for how long, what to do; a traceback only with --debug."""
    where = free_endpoint()
    process = run_nedbus(command, "-c", where)
    assert process.wait() == 1
    assert process.err.startswith(f"nedbus: nothing answers at {where}")
    assert len(process.err.splitlines()) == 1


def test_wait_waits_for_a_router(run_nedbus: Start) -> None:
    """--wait is for whoever starts everything at once."""
    where = free_endpoint()
    echo = run_nedbus("echo", "-c", where, "--wait", "-n", "3")
    wait_for(lambda: "waiting" in echo.err, what="echo to report that it waits")
    run_nedbus("serve", "-l", where, "-s", "sim:")
    assert echo.wait() == 0
    assert len(echo.out.splitlines()) == 3


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["echo", "--vehicle", "a/b"], "vehicle 'a/b' is not valid: expected 1 to 64 of"),
        (["echo", "vehicle_local_positon"], "topic 'vehicle_local_positon' is not valid: expected one of"),
        (["get", "--field", "xx"], "--field: there is no field 'xx'"),
        (["list", "--vehicle", "a/b"], "vehicle 'a/b' is not valid: expected 1 to 64 of"),
        (["get", "-t", VLP, "-i", "0"], "instance 0 is not valid: expected none"),
        (["list", "--connect", "nonsense"], "connect: 'nonsense' is not an endpoint"),
    ],
)
def test_invalid_name_is_a_usage_error(run_nedbus: Start, endpoint: str, arguments: list[str], text: str) -> None:
    """Exit 2, one line with what is expected."""
    process = run_nedbus(*arguments, NEDBUS_CONNECT=endpoint)
    assert process.wait() == 2
    assert text in process.err
    assert len(process.err.splitlines()) == 1


def test_unknown_flag_is_a_usage_error(run_nedbus: Start) -> None:
    """Exit 2."""
    assert run_nedbus("list", "--no-such-flag").wait() == 2


def test_debug_shows_a_traceback(run_nedbus: Start) -> None:
    """Only --debug shows where an error came from."""
    process = run_nedbus("--debug", "list", "-c", free_endpoint())
    assert process.wait() == 1
    assert "Traceback" in process.err


def test_version_and_help(run_nedbus: Start) -> None:
    """--version is the package's; help names every command."""
    version = run_nedbus("--version")
    assert version.wait() == 0
    assert version.out == f"nedbus {nedbus.__version__}\n"
    overview = run_nedbus("--help")
    assert overview.wait() == 0
    for command in ("serve", "router", "list", "echo", "hz", "get", "info", "schema"):
        assert f" {command} " in overview.out


@pytest.mark.process
def test_full_disk_is_one_line(endpoint: str, bus: nedbus.Bus) -> None:
    """An output that cannot be written is an error, not a traceback."""
    bus.publisher(VLP, vehicle="1").publish(message(1))
    wait_for(bus.latest, what="the message")
    command = f"{sys.executable} -m nedbus get -c {endpoint} > /dev/full"
    ended = subprocess.run(["bash", "-c", command], capture_output=True, timeout=DEADLINE, check=False, text=True)
    assert (ended.returncode, ended.stderr) == (1, "nedbus: cannot write: no space left on device\n")
