"""The commands list, get, info, schema and hz, and options common to all: output and exit codes."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import nedbus
from nedbus.cli import follow
from nedbus.cli.app import make_app
from nedbus.cli.commands.pki import pki
from nedbus.client import Subscription
from nedbus.settings import Settings
from nedbus.timings import Timings
from nedbus.transport import liveliness, open_router
from nedbus_msgs import ANY
from tests.flights.local_position import LAYOUTS, json_schema
from tests.flights.messages import VLP, message
from tests.peers.command_line import fork_command, run_command, run_until_shown
from tests.peers.ports import free_endpoint
from tests.peers.processes import ForkServer, Process, Start, without_coverage
from tests.waits import DEADLINE, wait_for

COMMANDS = [str(each.name) for each in make_app().registered_commands]
COMMANDS += [
    f"pki {each.name or getattr(each.callback, '__name__', None)}"
    for each in pki.registered_commands
]


@pytest.fixture(scope="module")
def simulation(fork_server: ForkServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Run a router and a service with a simulated vehicle, for tests that only read."""
    endpoint = free_endpoint()
    router = open_router(listen=(endpoint,))
    command = (sys.executable, "-m", "nedbus", "serve", "--connect", endpoint, "-s", "sim:")
    environment = {
        name: value for name, value in without_coverage().items() if not name.startswith("NEDBUS_")
    }
    service = Process(command, tmp_path_factory.mktemp("simulation"), environment, fork_server)
    with nedbus.connect(endpoint) as bus:
        wait_for(lambda: len(bus.latest(ANY)) == 12, what="twelve streams")
    yield endpoint
    service.kill()
    router.close()


@pytest.mark.parametrize(
    "fresh", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["forked", "fresh"]
)
@pytest.mark.parametrize("command", COMMANDS)
def test_command_starts(run_nedbus: Start, command: str, *, fresh: bool) -> None:
    """Each command starts in a separate process and imports all it needs; most other tests run in-process."""
    result = run_nedbus(*command.split(), "--help", fresh=fresh)
    assert result.wait() == 0, result.err
    assert f" nedbus {command} [OPTIONS]" in result.out


@pytest.mark.slow
@pytest.mark.process
def test_list_shows_published_streams(simulation: str) -> None:
    """`list` prints a row per stream with the age and state of its last message."""
    listed = run_command("list", "-c", simulation)
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
    rows = [
        json.loads(line)
        for line in run_command("list", "-c", simulation, "--json").out.splitlines()
    ]
    assert [row["instance"] for row in rows if "local" in row["topic"]] == [0, 1, None, None, None]
    assert all(row["vehicle"] == "1" and row["age"] >= 0 for row in rows)


def test_list_filters_by_vehicle(endpoint: str, bus: nedbus.Bus) -> None:
    """--vehicle lists one vehicle, even before its first message, and fails if it is not published."""
    for vehicle, topic in (("1", VLP), ("1", f"{VLP}_groundtruth"), ("2", VLP)):
        bus.publisher(topic, vehicle=vehicle).publish(message(1))
    bus.publisher(VLP, vehicle="silent")
    for vehicle, count in (("1", 2), ("2", 1), ("silent", 1), ("3", 0)):
        listed = run_command("list", "-c", endpoint, "--vehicle", vehicle, "--json")
        assert listed.exit_code == (vehicle == "3"), listed.err
        assert [json.loads(line)["vehicle"] for line in listed.out.splitlines()] == [
            vehicle
        ] * count
        assert ("no vehicle 3 is published at" in listed.err) == (vehicle == "3")
        assert ('"no last message"' in listed.out) == (vehicle == "silent")
        assert listed.err.endswith(": choose one of 1, 2, silent\n") == (vehicle == "3"), (
            "no hint about permissions"
        )


def test_incomplete_list_exits_with_1(
    bus: nedbus.Bus, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If replies are missing, `list` shows the others with a warning and exits with 1."""
    monkeypatch.setattr("nedbus.limits.REPLIES", 1)
    publishers = [bus.publisher(VLP, vehicle=number) for number in (1, 2)]
    listed = run_command("list", "-c", endpoint)
    assert listed.exit_code == 1
    assert "some streams are missing" in listed.err
    assert sum(str(each.address) in listed.out for each in publishers) == 1


def test_list_is_not_reported_as_empty_before_the_router_replies(
    bus: nedbus.Bus, endpoint: str, monkeypatch: pytest.MonkeyPatch, timings: Timings
) -> None:
    """Before the router has replied, `list` does not claim that no vehicle is published."""
    monkeypatch.setattr(liveliness.LivelinessTokens, "poll", lambda _: [])
    timings.list_timeout = 0.01
    listed = run_command("list", "-c", endpoint)
    assert listed.exit_code == 1
    assert "the router listed only 0 streams within 0.01 s" in listed.err
    assert f"no vehicle is known yet at {endpoint}" in listed.err
    assert "is published" not in listed.err


@pytest.mark.slow
def test_hz_measures_rate_latency_and_loss(run_nedbus: Start, simulation: str) -> None:
    """`hz` prints rate, jitter, latency and loss per stream, as table, JSON or CSV; positions arrive at 100 Hz."""
    table, csv_form = (
        run_nedbus("hz", "-c", simulation, "-t", VLP, *form, coverage=False)
        for form in ([], ["--csv"])
    )
    measured: list[dict[str, Any]] = []

    def is_near() -> bool:
        """Measure the rate, and return whether it is near 100 Hz; a busy machine needs several attempts."""
        result = run_command("hz", "-c", simulation, "-d", "2.1", "--json", "-t", VLP)
        assert result.exit_code == 0, result.err
        measured[:] = [json.loads(line) for line in result.out.splitlines()]
        return any(row["rate"] is not None and 20 < row["rate"] < 500 for row in measured)

    wait_for(is_near, what="a rate near 100 Hz")
    assert {row["topic"] for row in measured} == {VLP}
    assert all(
        set(row) >= {"rate", "jitter", "latency", "latency_max", "lost", "flags", "gaps", "reboots"}
        for row in measured
    )
    assert measured[-1]["lost"] == 0
    for form, row in ((table, "1/"), (csv_form, ",1,")):
        has_two_rows = partial(lambda form, row: form.out.count(row) >= 2, form, row)
        wait_for(has_two_rows, what="two seconds")
        form.kill()
    assert table.out.splitlines()[0].split() == [
        "VEHICLE/TOPIC",
        "HZ",
        "JITTER",
        "LATENCY",
        "MAX",
        "LOST",
        "STATE",
    ]
    rows = list(csv.DictReader(csv_form.out.splitlines()))
    assert {(row["vehicle"], row["topic"]) for row in rows} == {("1", VLP)}
    assert {row["state"] for row in rows} <= {"ok", "slow"}  # slow on a busy machine
    assert float(rows[-1]["rate"]) > 1
    assert float(rows[0]["time"]) < float(rows[-1]["time"])


@pytest.mark.slow
@pytest.mark.process
def test_get_shows_the_last_message(simulation: str) -> None:
    """`get` prints the last message, by default vehicle_local_position; if nothing is published, it exits with 1."""

    def get(*arguments: str) -> str:
        got = run_command("get", "-c", simulation, *arguments)
        assert got.exit_code == 0, got.err
        return got.out

    estimate = get("estimator_local_position", "--instance", "1")
    assert estimate.startswith("1/estimator_local_position/1, ")
    assert "  hagl_max_xy: inf" in estimate
    assert len(get("--json", "*").splitlines()) == 12
    assert [json.loads(line)["topic"] for line in get("--json").splitlines()] == [VLP]
    assert [line.split(":")[0] for line in get("--field", "x,eph").splitlines()[1:]] == [
        "  x",
        "  eph",
        "---",
    ]
    assert json.loads(get("--json", "--field", "x"))["message"].keys() == {"x"}
    nothing = run_command("get", "-c", simulation, "--vehicle", "99")
    assert nothing.exit_code == 1
    assert f"nothing is published on nedbus/99/{VLP}" in nothing.err


@pytest.mark.process
def test_info_shows_the_services(simulation: str) -> None:
    """`info` prints the router, the vehicles, and the services with their sources."""
    info = run_until_shown("running", "info", "-c", simulation)
    assert info.exit_code == 0, info.err
    assert all(
        text in info.out for text in (f"router    {simulation}", "vehicles  1", "SOURCE", "running")
    )
    machine = run_until_shown('"state": "running"', "info", "-c", simulation, "--json")
    assert json.loads(machine.out)["sources"][0]["source"] == "sim:"


def test_schema_needs_no_network() -> None:
    """`schema` prints JSON Schema and layouts without a router."""
    assert json.loads(run_command("schema").out) == json_schema()
    assert [
        layout["name"] for layout in json.loads(run_command("schema", "--layouts").out)
    ] == list(LAYOUTS)


@pytest.mark.slow
def test_absence_of_vehicles_is_reported(
    endpoint: str, bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch, timings: Timings
) -> None:
    """If no vehicle is published, `list` and `echo` print a notice; `list` then exits, and `echo` waits."""
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


@pytest.mark.parametrize(
    ("command", "key_expr"), [("echo", f"nedbus/*/{VLP}"), ("hz", "nedbus/*/**")]
)
def test_duration_without_data_exits_with_1(endpoint: str, command: str, key_expr: str) -> None:
    """A command with --duration exits with 1 if no message arrived."""
    watch = run_command(command, "-c", endpoint, "--duration", "0.1")
    assert watch.exit_code == 1
    assert f"nothing arrived on {key_expr} within 0.1 s" in watch.err


@pytest.mark.parametrize("command", ["list", "echo", "hz", "get", "info"])
def test_missing_router_is_a_one_line_error(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a router, a command exits with 1 and prints one line with the endpoint, the time waited and a remedy."""
    bus_class = nedbus.Bus

    def connect_soon(settings: Settings, *, timeout: float) -> nedbus.Bus:
        return bus_class(settings, timeout=timeout / 10)

    monkeypatch.setattr("nedbus.Bus", connect_soon)
    where = free_endpoint()
    ended = run_command(command, "-c", where)
    assert ended.exit_code == 1
    assert ended.err.startswith(
        f"nedbus: nothing answers at {where} (tried for 0.1 s): start 'nedbus serve'"
    )
    assert len(ended.err.splitlines()) == 1


@pytest.mark.slow
def test_wait_option_waits_for_a_router(run_nedbus: Start) -> None:
    """--wait makes a command wait until a router is started."""
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
        (
            ["echo", "--field", "xy_vallid"],
            "--field: unknown field 'xy_vallid': did you mean xy_valid",
        ),
        (
            ["echo", "--field", "qqq"],
            "unknown field 'qqq': 'nedbus schema VehicleLocalPosition' lists the fields",
        ),
        (
            ["echo", "vehicle_attitude", "--field", "x"],
            "'nedbus schema VehicleAttitude' lists the fields",
        ),
        (["echo", "vehicle_attitude", "--field", "q[1]"], "unknown field 'q[1]': did you mean q?"),
        (
            ["echo", "VehicleAttitude"],
            "expected one of vehicle_attitude, vehicle_attitude_groundtruth",
        ),
        (["get", "--topic", "sensor_gps/0"], "expected sensor_gps with instance 0"),
        (
            ["serve", "-s", "sim:?topics=vehicle_attitud"],
            "expected vehicle_attitude (looks like a mis",
        ),
        (
            ["serve", "-s", "mavlink:udpin:0.0.0.0:14540?topics=wheel_encoders"],
            "MAVLink has none of these topics",
        ),
        (["schema", "vehicle_attitud"], "did you mean vehicle_attitude or VehicleAttitude?"),
        (["echo", f"/px4_1/fmu/out/{VLP}"], f"expected {VLP}, without the ROS 2 prefix"),
        (
            ["echo", f"/fmu/out/{VLP}"],
            f"topic 'fmu/out/{VLP}' is not valid: expected {VLP}, without the ROS 2 prefix",
        ),
        (
            ["echo", "vehicle_attitude", "-t", VLP],
            "--topic: the argument already names the topic 'vehicle_attitude'",
        ),
        (["echo", "--csv", "--json"], "--csv: cannot be combined with --json"),
        (["echo", "--once", "-n", "3"], "--count: cannot be combined with --once"),
        (["get", "--field", "xx"], "--field: unknown field 'xx'"),
        (["list", "--vehicle", "a/b"], "vehicle 'a/b' is not valid: expected 1 to 64 of"),
        (["get", "-t", VLP, "-i", "0"], "instance 0 is not valid: expected none"),
        (["list", "--connect", "nonsense"], "connect: 'nonsense' is not an endpoint"),
        (
            ["echo", "--wait", "--connect", "tcp/127.0.0.1:1", "--max-rate", "nan"],
            "max_rate nan is not valid",
        ),
    ],
)
def test_invalid_option_exits_with_2(endpoint: str, arguments: list[str], text: str) -> None:
    """A usage error is one line with the expected value or a suggestion, and exit code 2."""
    ended = run_command(*arguments, NEDBUS_CONNECT=endpoint)
    assert ended.exit_code == 2
    assert text in ended.err
    assert len(ended.err.splitlines()) == 1
    assert run_command(*arguments, "--no-such-flag").exit_code == 2


@pytest.mark.parametrize(
    "arguments",
    [
        ["web", "--listen", "127.0.0.1:0"],
        ["export", "--listen", "127.0.0.1:0"],
        ["foxglove", "--port", "0"],
    ],
    ids=" ".join,
)
def test_http_option_is_identical_in_all_commands(endpoint: str, arguments: list[str]) -> None:
    """Every command that serves HTTP or a WebSocket accepts --http, and validates the address before it connects."""
    assert run_command(*arguments, NEDBUS_CONNECT=endpoint).exit_code == 2
    wrong = run_command(arguments[0], "--http", "8765", NEDBUS_CONNECT=free_endpoint())
    assert wrong.exit_code == 2
    assert "--http: '8765' is not an address: write HOST:PORT" in wrong.err


def test_version_and_help_are_printed(run_nedbus: Start) -> None:
    """--version prints the package's version, with and without the fast path; --help lists every command."""
    version = run_nedbus("--version")
    assert version.wait() == 0
    assert version.out == run_command("--version").out == f"nedbus {nedbus.__version__}\n"
    overview = run_command("--help")
    assert overview.exit_code == 0
    assert all(f" {command.split()[0]} " in overview.out for command in COMMANDS)


@pytest.mark.slow
@pytest.mark.process
def test_full_disk_is_a_one_line_error(
    endpoint: str, bus: nedbus.Bus, fork_server: ForkServer
) -> None:
    """A failed write to stdout is a one-line error, not a traceback."""
    bus.publisher(VLP, vehicle="1").publish(message(1))
    with Path("/dev/full").open("wb") as full, Path("err").open("wb") as err:
        ended = fork_command(
            fork_server, "get", "-c", endpoint, out=full.fileno(), err=err.fileno()
        )
    assert ended.wait(DEADLINE) == 1
    assert Path("err").read_text() == "nedbus: cannot write to stdout: no space left on device\n"
