"""The commands as typed: their output and their exit codes."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import nedbus
from nedbus.cli import follow
from nedbus.cli.app import app
from nedbus.cli.commands.pki import pki
from nedbus.client import Subscription
from nedbus.settings import Settings
from nedbus.timings import Timings
from nedbus.transport import liveliness, open_router
from nedbus_msgs import ANY
from tests.flights.local_position import LAYOUTS, json_schema
from tests.flights.messages import VLP, message
from tests.peers.command_line import fork_command, run_command
from tests.peers.ports import free_endpoint
from tests.peers.processes import Process, Start, Zygote, unmeasured
from tests.waits import DEADLINE, wait_for

COMMANDS = [str(each.name) for each in app.registered_commands]
COMMANDS += [f"pki {each.name or getattr(each.callback, '__name__', None)}" for each in pki.registered_commands]


@pytest.fixture(scope="module")
def flying(zygote: Zygote, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Run a router with a service and its simulated vehicle, for all tests that only look at it."""
    endpoint = free_endpoint()
    router = open_router(listen=(endpoint,))
    command = (sys.executable, "-m", "nedbus", "serve", "--connect", endpoint, "-s", "sim:")
    environment = {name: value for name, value in unmeasured().items() if not name.startswith("NEDBUS_")}
    service = Process(command, tmp_path_factory.mktemp("flying"), environment, zygote)
    with nedbus.connect(endpoint) as bus:
        wait_for(lambda: len(bus.latest(ANY)) == 12, what="twelve streams")
    yield endpoint
    service.kill()
    router.close()


@pytest.mark.parametrize("fresh", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["forked", "fresh"])
@pytest.mark.parametrize("command", COMMANDS)
def test_command_starts(run_nedbus: Start, command: str, *, fresh: bool) -> None:
    """Each command is one of a process of its own, and imports all that it needs; most other tests run it in theirs."""
    shown = run_nedbus(*command.split(), "--help", fresh=fresh)
    assert shown.wait() == 0, shown.err
    assert f" nedbus {command} [OPTIONS]" in shown.out


@pytest.mark.process
def test_list_shows_what_is_published(flying: str) -> None:
    """A row for each vehicle and topic: its age, and whether to trust it."""
    listed = run_command("list", "-c", flying)
    assert listed.exit_code == 0, listed.err
    head, *lines = listed.out.splitlines()
    assert head.split() == ["VEHICLE/TOPIC", "AGE", "STATE"]
    assert [line.split()[0] for line in lines if "local" in line] == [
        "1/estimator_local_position/0",
        "1/estimator_local_position/1",
        "1/external_ins_local_position",
        "1/vehicle_local_position",
        "1/vehicle_local_position_groundtruth",
    ]
    assert len(lines) == 12
    assert all(line.endswith("ok") for line in lines)
    rows = [json.loads(line) for line in run_command("list", "-c", flying, "--json").out.splitlines()]
    assert [row["instance"] for row in rows if "local" in row["topic"]] == [0, 1, None, None, None]
    assert all(row["vehicle"] == "1" and row["age"] >= 0 for row in rows)


def test_list_of_one_vehicle(endpoint: str, bus: nedbus.Bus) -> None:
    """--vehicle lists one vehicle, also one of which nobody answers, and says when it is not there."""
    for vehicle, topic in (("1", VLP), ("1", f"{VLP}_groundtruth"), ("2", VLP)):
        bus.publisher(topic, vehicle=vehicle).publish(message(1))
    bus.publisher(VLP, vehicle="silent")
    for vehicle, count in (("1", 2), ("2", 1), ("silent", 1), ("3", 0)):
        listed = run_command("list", "-c", endpoint, "--vehicle", vehicle, "--json")
        assert listed.exit_code == (vehicle == "3"), listed.err
        assert [json.loads(line)["vehicle"] for line in listed.out.splitlines()] == [vehicle] * count
        assert ("no vehicle 3 is published at" in listed.err) == (vehicle == "3")
        assert listed.err.endswith(": choose one of 1, 2, silent\n") == (vehicle == "3"), "nothing of permissions"


def test_incomplete_list_fails(bus: nedbus.Bus, endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A list that lacks a vehicle shows the others, a warning, and exits with 1."""
    monkeypatch.setattr(liveliness, "MAX_REPLIES", 1)
    publishers = [bus.publisher(VLP, vehicle=number) for number in (1, 2)]
    listed = run_command("list", "-c", endpoint)
    assert listed.exit_code == 1
    assert "some vehicles are missing" in listed.err
    assert sum(str(each.address) in listed.out for each in publishers) == 1


def test_list_that_has_not_arrived_is_no_empty_list(
    bus: nedbus.Bus, endpoint: str, monkeypatch: pytest.MonkeyPatch, timings: Timings
) -> None:
    """While the router has not listed the vehicles, the command does not claim that there are none."""
    monkeypatch.setattr(liveliness.LivelinessTokens, "poll", lambda _: [])
    timings.list_timeout = 0.01
    listed = run_command("list", "-c", endpoint)
    assert listed.exit_code == 1
    assert "the router has not listed all vehicles within 0.01 s" in listed.err
    assert f"no vehicle is known yet at {endpoint}" in listed.err
    assert "is published" not in listed.err


def test_hz_measures(run_nedbus: Start, flying: str) -> None:
    """Rate, jitter, latency and loss of each stream, as a table, JSON or CSV; that of the estimate is near 100 Hz."""
    table, csv_form = (run_nedbus("hz", "-c", flying, "-t", VLP, *form, measured=False) for form in ([], ["--csv"]))
    measured: list[dict[str, Any]] = []

    def is_near() -> bool:
        """Measure; return whether a rate is near that of the estimate, as it is unless the machine is too busy."""
        shown = run_command("hz", "-c", flying, "-d", "2.1", "--json", "-t", VLP)
        assert shown.exit_code == 0, shown.err
        measured[:] = [json.loads(line) for line in shown.out.splitlines()]
        return any(row["rate"] is not None and 20 < row["rate"] < 500 for row in measured)

    wait_for(is_near, what="a rate near 100 Hz")
    assert {row["topic"] for row in measured} == {VLP}
    assert all(
        set(row) >= {"rate", "jitter", "latency", "latency_max", "lost", "flags", "gaps", "reboots"} for row in measured
    )
    assert measured[-1]["lost"] == 0
    for form in (table, csv_form):
        wait_for(lambda form=form: form.out.count("1/" if form is table else ",1,") >= 2, what="two seconds")  # type: ignore[misc]
        form.kill()
    assert table.out.splitlines()[0].split() == ["VEHICLE/TOPIC", "HZ", "JITTER", "LATENCY", "MAX", "LOST", "STATE"]
    rows = list(csv.DictReader(csv_form.out.splitlines()))
    assert {(row["vehicle"], row["topic"]) for row in rows} == {("1", VLP)}
    assert {row["state"] for row in rows} <= {"ok", "slow"}  # slow on a machine that is busy
    assert float(rows[-1]["rate"]) > 1
    assert float(rows[0]["time"]) < float(rows[-1]["time"])


@pytest.mark.process
def test_get_shows_the_last_message(flying: str) -> None:
    """All fields of the last message, of vehicle_local_position unless a topic is given; exit 1 when there is none."""

    def get(*arguments: str) -> str:
        got = run_command("get", "-c", flying, *arguments)
        assert got.exit_code == 0, got.err
        return got.out

    estimate = get("estimator_local_position", "--instance", "1")
    assert estimate.startswith("1/estimator_local_position/1, ")
    assert "  hagl_max_xy: inf" in estimate
    assert len(get("--json", "*").splitlines()) == 12
    assert [json.loads(line)["topic"] for line in get("--json").splitlines()] == [VLP]
    assert [line.split(":")[0] for line in get("--field", "x,eph").splitlines()[1:]] == ["  x", "  eph", "---"]
    assert json.loads(get("--json", "--field", "x"))["message"].keys() == {"x"}
    nothing = run_command("get", "-c", flying, "--vehicle", "99")
    assert nothing.exit_code == 1
    assert f"nothing is published on nedbus/99/{VLP}" in nothing.err


@pytest.mark.process
def test_info_shows_the_services(flying: str) -> None:
    """The services, what their sources do, and what was rejected."""
    info = run_command("info", "-c", flying)
    assert info.exit_code == 0, info.err
    assert all(text in info.out for text in (f"router    {flying}", "vehicles  1", "SOURCE", "running"))
    machine = run_command("info", "-c", flying, "--json")
    assert json.loads(machine.out)["sources"][0]["source"] == "sim:"


def test_schema_needs_no_network() -> None:
    """The JSON Schema, and the layouts, as JSON."""
    assert json.loads(run_command("schema").out) == json_schema()
    assert [layout["name"] for layout in json.loads(run_command("schema", "--layouts").out)] == list(LAYOUTS)


def test_no_data_yet_is_reported(
    endpoint: str, bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch, timings: Timings
) -> None:
    """With a router but no vehicle: list says so, echo says so and waits."""
    listed = run_command("list", "-c", endpoint)
    assert (listed.exit_code, listed.out, "no vehicle is published" in listed.err) == (0, "", True)
    notice = follow.write_notice

    def publish_after_notice(subscription: Subscription) -> None:
        notice(subscription)
        bus.publisher(VLP, vehicle="7").publish(message(5, x=1.0))

    monkeypatch.setattr(follow, "write_notice", publish_after_notice)
    timings.first_sample = 0.1
    echo = run_command("echo", "-c", endpoint, "-n", "1")
    assert echo.exit_code == 0
    assert echo.err.count("yet, still waiting") == 1
    assert echo.out.startswith("7/vehicle_local_position ")


@pytest.mark.parametrize(("command", "key_expr"), [("echo", f"nedbus/*/{VLP}"), ("hz", "nedbus/*/**")])
def test_duration_without_data_fails(endpoint: str, command: str, key_expr: str) -> None:
    """A script that follows for a while learns from the exit code that nothing came."""
    watch = run_command(command, "-c", endpoint, "--duration", "0.1")
    assert watch.exit_code == 1
    assert f"nothing arrived on {key_expr} within 0.1 s" in watch.err


@pytest.mark.parametrize("command", ["list", "echo", "hz", "get", "info"])
def test_no_router_is_one_clear_line(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exit 1, one line: where, for how long, what to do; a traceback only with --debug."""

    def connect_soon(settings: Settings, *, timeout: float) -> nedbus.Bus:
        return nedbus.Bus(settings, timeout=timeout / 10)

    monkeypatch.setattr("nedbus.cli.options.Bus", connect_soon)
    where = free_endpoint()
    ended = run_command(command, "-c", where)
    assert ended.exit_code == 1
    assert ended.err.startswith(f"nedbus: nothing answers at {where} (tried for 0.1 s): start 'nedbus serve'")
    assert len(ended.err.splitlines()) == 1


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
        (
            ["echo", "vehicle_local_positon"],
            "topic 'vehicle_local_positon' is not valid: expected vehicle_local_position or ",
        ),
        (["echo", "--field", "xy_vallid"], "--field: unknown field 'xy_vallid': did you mean xy_valid"),
        (["echo", "--field", "qqq"], "--field: unknown field 'qqq': 'nedbus schema' lists the fields"),
        (["echo", "vehicle_attitude", "--field", "x"], "'nedbus schema VehicleAttitude' lists the fields"),
        (["echo", "vehicle_attitude", "--field", "q[1]"], "unknown field 'q[1]': did you mean q?"),
        (["echo", "VehicleAttitude"], "expected one of vehicle_attitude, vehicle_attitude_groundtruth"),
        (["get", "--topic", "sensor_gps/0"], "expected sensor_gps with instance 0"),
        (["serve", "-s", "sim:?topics=vehicle_attitud"], "expected vehicle_attitude (looks like a mis"),
        (["serve", "-s", "mavlink:udpin:0.0.0.0:14540?topics=wheel_encoders"], "MAVLink has none of these topics"),
        (["schema", "vehicle_attitud"], "did you mean vehicle_attitude or VehicleAttitude?"),
        (["echo", "vehicle_attitude", "-t", VLP], "--topic: the argument already names the topic 'vehicle_attitude'"),
        (["echo", "--csv", "--json"], "--csv: cannot be combined with --json"),
        (["echo", "--once", "-n", "3"], "--count: cannot be combined with --once"),
        (["get", "--field", "xx"], "--field: unknown field 'xx'"),
        (["list", "--vehicle", "a/b"], "vehicle 'a/b' is not valid: expected 1 to 64 of"),
        (["get", "-t", VLP, "-i", "0"], "instance 0 is not valid: expected none"),
        (["list", "--connect", "nonsense"], "connect: 'nonsense' is not an endpoint"),
        (["echo", "--wait", "--connect", "tcp/127.0.0.1:1", "--max-rate", "nan"], "max_rate nan is not valid"),
    ],
)
def test_invalid_option_is_a_usage_error(endpoint: str, arguments: list[str], text: str) -> None:
    """Exit 2, one line with what is expected, or what to write instead."""
    ended = run_command(*arguments, NEDBUS_CONNECT=endpoint)
    assert ended.exit_code == 2
    assert text in ended.err
    assert len(ended.err.splitlines()) == 1
    assert run_command(*arguments, "--no-such-flag").exit_code == 2


@pytest.mark.parametrize(
    "arguments",
    [["web", "--listen", "127.0.0.1:0"], ["export", "--listen", "127.0.0.1:0"], ["foxglove", "--port", "0"]],
    ids=" ".join,
)
def test_address_of_http_has_one_name(endpoint: str, arguments: list[str]) -> None:
    """Each command that serves HTTP or a WebSocket listens at --http, which is checked before it connects anywhere."""
    assert run_command(*arguments, NEDBUS_CONNECT=endpoint).exit_code == 2
    wrong = run_command(arguments[0], "--http", "8765", NEDBUS_CONNECT=free_endpoint())
    assert wrong.exit_code == 2
    assert "--http: '8765' is not an address: write HOST:PORT" in wrong.err


def test_version_and_help(run_nedbus: Start) -> None:
    """--version is the package's, before anything is imported and after; help names every command."""
    version = run_nedbus("--version")
    assert version.wait() == 0
    assert version.out == run_command("--version").out == f"nedbus {nedbus.__version__}\n"
    overview = run_command("--help")
    assert overview.exit_code == 0
    assert all(f" {command.split()[0]} " in overview.out for command in COMMANDS)


@pytest.mark.process
def test_full_disk_is_one_line(endpoint: str, bus: nedbus.Bus, zygote: Zygote) -> None:
    """An output that cannot be written is an error, not a traceback."""
    bus.publisher(VLP, vehicle="1").publish(message(1))
    with Path("/dev/full").open("wb") as full, Path("err").open("wb") as err:
        ended = fork_command(zygote, "get", "-c", endpoint, out=full.fileno(), err=err.fileno())
    assert ended.wait(DEADLINE) == 1
    assert Path("err").read_text() == "nedbus: cannot write to stdout: no space left on device\n"
