"""Terminal output: tables of any width, malicious text, closed streams, and signals at any time."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Self

import pytest
import typer
from rich.console import Console

import nedbus
from nedbus.cli.options import exit_on_errors
from nedbus.cli.output.samples import Lines
from nedbus.cli.output.streams import printable, to_text
from nedbus.cli.output.table import live_table, to_table
from nedbus.timings import Timings
from nedbus.transport import Session, open_router
from nedbus_msgs import DEFAULT
from tests.flights.messages import VALID, VLP, message
from tests.nedbus.flights.formats import write_flight
from tests.peers.command_line import fork_command, run_command, run_until_shown
from tests.peers.custom_timings import start_with_timings
from tests.peers.ports import free_endpoint, free_port
from tests.peers.processes import ForkServer, Start, without_coverage
from tests.waits import DEADLINE, repeating, wait_for

ROOT = Path(__file__).parents[4]
EVIL = "\x1b]0;owned\x07\x1b[2J\u202e\x9b31m\nforged line"


def has_control(text: str) -> bool:
    """Return whether a text contains a control character other than a newline."""
    return any(not (char.isprintable() or char == "\n") for char in text)


def test_text_of_a_peer_is_one_short_printable_line() -> None:
    """Control characters, bidirectional marks and line breaks are escaped, and long text is truncated."""
    assert to_text(EVIL) == r"\x1b]0;owned\x07\x1b[2J\u202e\x9b31m\nforged line"
    assert len(to_text("x" * 100_000)) == 120
    assert len(to_text("\x1b" * 100_000)) < 500
    assert printable("déjà vu\n世界") == "déjà vu\n世界"
    assert printable("name-\udcff") == r"name-\udcff"


HEAD = ("VEHICLE/TOPIC", "HZ", "JITTER", "LATENCY", "MAX", "LOST", "STATE")
OPTIONAL = ("JITTER", "MAX", "LATENCY", "LOST")
ROWS = [
    (
        "1/vehicle_local_position_groundtruth",
        "100.0",
        "12.3 ms",
        "999 ms",
        "119.9 s",
        "12345",
        "ok",
    ),
    (
        "1/vehicle_local_position",
        "-",
        "-",
        "-",
        "-",
        "0",
        "stale: nothing for 4.2 s, xy z invalid, dead reckoning",
    ),
]


@pytest.mark.parametrize("width", [30, 40, 64, 80, 110])
def test_table_fits_the_terminal(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    """No line is wider than the terminal: optional columns are removed first, then names are folded."""
    monkeypatch.setattr("nedbus.cli.output.table.terminal_width", lambda: width)
    lines = to_table(HEAD, ROWS, optional=OPTIONAL).splitlines()
    assert all(len(line) <= width for line in lines)
    shown = " ".join(lines)
    assert {word in shown for word in ("stale:", "4.2 s", "invalid", "reckoning")} == {True}
    assert ("JITTER" in lines[0]) == (width >= 110)
    assert (ROWS[0][0] in shown) == (width >= 60)


def test_table_without_rows_prints_only_its_header() -> None:
    """Before the first message a table consists of its header only."""
    assert to_table(HEAD, [], optional=OPTIONAL).split() == list(HEAD)


def test_table_is_complete_without_a_terminal() -> None:
    """If stdout is not a terminal, nothing is folded or removed, and text is not parsed as markup."""
    cells = ("1/[bold]", *ROWS[1][1:-1], "x" * 300)
    head, *lines = to_table(HEAD, [*ROWS, cells]).splitlines()
    assert head.split() == list(HEAD)
    assert [line.split()[0] for line in lines] == [ROWS[0][0], ROWS[1][0], "1/[bold]"]
    assert lines[-1].endswith("x" * 300)


def sample(address: nedbus.Address) -> nedbus.Sample:
    position = {
        "x": -1234.5678,
        "y": 2.0,
        "z": -3.0,
        "vx": -1.0,
        "heading": 1.5,
        "eph": 0.5,
        "xy_valid": True,
    }
    return nedbus.Sample(message(99_999_123_456, **position), address, 0, lost=3)


ALL_TOPICS = [
    nedbus.Address("1", name, 0 if topic.instances else None)
    for name, topic in DEFAULT.topics.items()
]


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], Lines]:
    """Return a factory of `Lines` for a terminal of a given width and 24 lines."""
    monkeypatch.setenv("LINES", "24")

    def make(width: int) -> Lines:
        monkeypatch.setattr("nedbus.cli.output.samples.terminal_width", lambda: width)
        return Lines()

    return make


def test_narrow_terminal_removes_columns_in_order(lines: Callable[[int], Lines]) -> None:
    """As the terminal gets narrower, eph, heading and velocity disappear in this order; all other columns stay."""
    one = sample(nedbus.Address("1", VLP))
    seen: list[list[str]] = []
    for width in range(150, 87, -1):
        head, line = lines(width)(one).splitlines()
        assert len(head) <= width
        assert len(line) <= width
        assert all(text in line for text in ("1/veh", "-1234.5", "  z vxy vz unknown", "[3 lost]"))
        columns = [name for name in ("Z m", "VZ m/s", "HDG deg", "EPH m", "STATE") if name in head]
        if not seen or seen[-1] != columns:
            seen.append(columns)
    most = ["Z m", "VZ m/s", "HDG deg", "EPH m"]
    assert seen == [[*most[:count], "STATE"] for count in (4, 3, 2, 1)]


def test_header_is_aligned_with_its_columns(lines: Callable[[int], Lines]) -> None:
    """The header is repeated once per screenful and when the columns change, and every state is below STATE."""
    to_line, with_header, state = lines(150), [], 0
    for number in range(80):
        *head, line = to_line(
            sample(nedbus.Address("1" if number < 40 else "wing", VLP))
        ).splitlines()
        if head:
            with_header.append(number)
            state = head[0].index("STATE")
        assert line.index("z vxy vz unknown") == state
    assert with_header == [0, 22, 40, 62]
    of_fields = lines(150)(sample(nedbus.Address("1", VLP)), ["x", "eph"]).splitlines()
    assert of_fields[0].split() == ["VEHICLE/TOPIC", "TIME", "s", "x", "eph", "STATE"]


class Terminal:
    """A command on a pseudo-terminal, and its output."""

    def __init__(self, fork_server: ForkServer, *arguments: str, **environment: str) -> None:
        self._main, terminal = pty.openpty()
        self._bytes = bytearray()
        environment = {"COLUMNS": "80", "LINES": "24", "TERM": "xterm"} | environment
        self.popen = fork_command(
            fork_server, *arguments, out=terminal, err=terminal, **environment
        )
        os.close(terminal)
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.popen.kill()
        self.wait()

    @property
    def output(self) -> str:
        return self._bytes.decode(errors="replace")

    def wait(self) -> int:
        """Return the exit code after all output has been read."""
        exit_code = self.popen.wait(DEADLINE)
        self._reader.join(DEADLINE)
        return exit_code

    def _read(self) -> None:
        with suppress(OSError):  # the terminal was closed
            while data := os.read(self._main, 4096):
                self._bytes.extend(data)
        os.close(self._main)


OnTerminal = Callable[..., Terminal]


@pytest.fixture
def on_terminal(fork_server: ForkServer) -> OnTerminal:
    """Return a function that runs a command on a terminal of 80 columns."""
    return partial(Terminal, fork_server)


@contextmanager
def publishing(bus: nedbus.Bus, *vehicles: str, topics: tuple[str, ...] = (VLP,)) -> Iterator[None]:
    """Publish valid messages of these vehicles and topics until the block ends."""
    publishers = [bus.publisher(topic, vehicle=vehicle) for vehicle in vehicles for topic in topics]

    def publish() -> None:
        for publisher in publishers:
            publisher.publish(message(1, **VALID))

    with repeating(publish):
        yield


@pytest.mark.slow
@pytest.mark.process
def test_echo_fits_a_terminal(on_terminal: OnTerminal, endpoint: str, bus: nedbus.Bus) -> None:
    """At 80 columns a message is one line below a header, with complete addresses in one column."""
    with publishing(bus, "1", "wing"), on_terminal("echo", "-c", endpoint, "-n", "40") as terminal:
        assert terminal.wait() == 0
    shown = [
        line
        for line in terminal.output.splitlines()
        if line.startswith("VEHICLE/TOPIC  ") or VLP in line
    ]
    assert len([line for line in shown if VLP in line]) == 40
    assert max(map(len, shown)) <= 80
    state = -1
    for line in shown:
        if VLP not in line:
            state = line.index("STATE")
        elif "  ok" in line:
            assert line.index("  ok") + 2 == state


@pytest.mark.slow
@pytest.mark.process
def test_info_lists_gone_streams(
    on_terminal: OnTerminal, endpoint: str, zenoh_session: Session
) -> None:
    """The table shows the number of gone streams; their addresses are listed below it, unsplit on a terminal."""
    gone = [f"wing-1/vehicle_local_position_{number}" for number in range(5)]
    sources = [{"source": "px4-zenoh:", "state": "waiting", "stale": gone}]
    service = answer(
        zenoh_session, "nedbus/@service/wing-1/s/status", {"service": "s", "sources": sources}
    )
    info = run_until_shown("5 gone", "info", "-c", endpoint)
    assert info.exit_code == 0, info.err
    assert "  5 gone\n" in info.out
    assert f"\ngone: {', '.join(gone)}\n" in info.out
    with on_terminal("info", "-c", endpoint) as terminal:
        assert terminal.wait() == 0
    lines = terminal.output.splitlines()
    assert max(map(len, lines)) <= 80
    assert all(any(address in line for line in lines) for address in gone)
    del service


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.parametrize(("number", "exit_code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_hz_redraws_in_place(
    on_terminal: OnTerminal, endpoint: str, bus: nedbus.Bus, number: signal.Signals, exit_code: int
) -> None:
    """On a terminal each table replaces the previous one, is no taller than the terminal, and stays at the end.

    Ctrl-C and SIGTERM, which `timeout` sends, stop the redrawing and show the cursor again.
    """
    vehicles = [str(vehicle) for vehicle in range(12)]
    with publishing(bus, *vehicles), on_terminal("hz", "-c", endpoint, LINES="10") as terminal:
        wait_for(lambda: terminal.output.count("VEHICLE/TOPIC") >= 2, what="a second table")
        terminal.popen.send_signal(number)
        assert terminal.wait() == exit_code
    assert "\x1b[1A\x1b[2K" in terminal.output
    assert " more" in terminal.output
    assert all(drawing.count("\n") <= 10 for drawing in terminal.output.split("VEHICLE/TOPIC")[1:])
    assert terminal.output.rindex("\x1b[?25h") > terminal.output.rindex("\x1b[?25l")
    assert "Traceback" not in terminal.output


@pytest.mark.parametrize(
    ("number", "raised"), [(signal.SIGINT, typer.Exit), (signal.SIGTERM, SystemExit)]
)
def test_signal_during_table_setup_restores_the_cursor(
    monkeypatch: pytest.MonkeyPatch, number: signal.Signals, raised: type[BaseException]
) -> None:
    """A signal while the cursor is being hidden takes effect afterwards, and the cursor is shown again."""
    shown: list[bool] = []

    def show_cursor(console: Console, show: bool = True) -> bool:
        shown.append(show)
        if show is False:
            signal.raise_signal(number)
        return True

    monkeypatch.setattr(Console, "show_cursor", show_cursor)
    monkeypatch.setattr("nedbus.cli.output.table.terminal_width", lambda: 80)
    handlers = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    for each in handlers:
        signal.signal(each, signal.SIG_DFL)
    try:
        with pytest.raises(raised), exit_on_errors(), live_table(HEAD, ()) as show:
            show(ROWS)
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)
    assert shown == [False, True]


@pytest.mark.slow
@pytest.mark.parametrize("command", ["echo", "hz"])
def test_lost_link_is_reported(run_nedbus: Start, command: str) -> None:
    """`echo` and `hz` log when the link to the router is lost and up again; `hz` marks each stream as disconnected."""
    where = free_endpoint()
    router = open_router(listen=(where,))
    run_nedbus("serve", "-c", where, "-s", "sim:")
    follower = run_nedbus(command, "-c", where, "--json")
    wait_for(lambda: follower.out, what="data")
    router.close()
    wait_for(lambda: f"the link to {where} is lost: reconnecting" in follower.err, what="the break")
    if command == "hz":
        wait_for(
            lambda: '"state": "disconnected", "reason": "no link"' in follower.out, what="the state"
        )
    with closing(open_router(listen=(where,))):
        wait_for(lambda: f"the link to {where} is up again" in follower.err, what="the link")
        lines = follower.out.count("\n")
        wait_for(lambda: follower.out.count("\n") > lines + 3, what="more data")


def states(lines: str) -> list[str]:
    return [json.loads(line)["state"] for line in lines.splitlines() if line.endswith("}")]


@pytest.mark.slow
def test_streams_of_killed_service_are_gone(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus
) -> None:
    """After a service was killed, `hz` reports its stream once as "gone"."""
    service = run_nedbus("serve", "-c", endpoint, "-s", "sim:")
    wait_for(bus.latest, what="data")
    with bus.publisher(VLP, vehicle="other") as other:
        hz = run_nedbus("hz", "-c", endpoint, "--json", "-t", VLP)
        wait_for(lambda: "ok" in states(hz.out), what="a healthy stream")
        service.kill()
        wait_for(lambda: "gone" in states(hz.out), what="its end")
        other.publish(message(1))

        def is_seen() -> bool:
            other.publish(message(2))
            return '"vehicle": "other"' in hz.out

        wait_for(is_seen, what="another second")
    assert states(hz.out).count("gone") == 1


@pytest.mark.slow
def test_ended_replay_is_stale(
    start: Start, run_nedbus: Start, endpoint: str, timings: Timings
) -> None:
    """The streams of an ended replay in a running service are stale in `list`, `info` and `hz`."""
    run_nedbus(
        "serve", "-c", endpoint, "-s", "sim:?duration=0.5&wait=1&topics=VehicleLocalPosition"
    )
    hz = start_with_timings(start, Timings(stale=0.5), "hz", "-c", endpoint, "--json", "-t", VLP)
    wait_for(lambda: "stale" in states(hz.out), what="hz to see the end")
    timings.stale = 0.5

    def listed() -> list[str]:
        return [
            line.split()[3] for line in run_command("list", "-c", endpoint).out.splitlines()[1:]
        ]

    wait_for(lambda: listed() == ["stale:"] * 5, what="the streams in `list`")
    wait_for(
        lambda: run_command("info", "-c", endpoint).out.count("stale: nothing for ") == 5,
        what="them in `info`",
    )


def answer(zenoh_session: Session, key: str, status: object) -> object:
    """Reply to queries of a service's status with the given status, which may be malicious."""
    return zenoh_session.declare_queryable(key, lambda query: query.reply(key, json.dumps(status)))


def test_malicious_status_is_escaped(endpoint: str, zenoh_session: Session) -> None:
    """Escape sequences, forged lines and long texts of a service are escaped and truncated, or omitted."""
    flood = [
        {
            "source": EVIL * 1000,
            "state": "retrying",
            "error": EVIL * 1000,
            "published": [EVIL] * 1000,
        }
    ]
    stream = {"address": EVIL, "health": {"rate": "\x1b[2J"}}
    source = {
        **flood[0],
        "stale": [EVIL],
        "streams": [stream, None, {"address": 1}],
        "addresses": EVIL,
    }
    status = {
        "service": EVIL,
        "host": EVIL,
        "version": EVIL,
        "role": EVIL,
        "sources": [source, "\x1b[2J", None],
    }
    hostile = answer(zenoh_session, "nedbus/@service/1/hostile/status", status)
    for arguments in (
        ["info"],
        ["health", "--services", "1"],
        ["health", "--services", "1", "--json"],
    ):
        result = run_command(*arguments, "-c", endpoint)
        assert result.exit_code == (arguments[0] == "health"), result.err
        assert not has_control(result.out + result.err)
        assert "\nforged line" not in result.out + result.err
        assert len(result.out + result.err) < 5000
    del hostile


@pytest.mark.slow
def test_malicious_keys_are_escaped(endpoint: str, zenoh_session: Session) -> None:
    """Escape sequences in keys and tokens reach neither the output nor the log."""
    tokens = [
        zenoh_session.liveliness().declare_token(f"nedbus/{name}/@alive/1a/{VLP}")
        for name in ("\x1b[2J", "a\nb", "x" * 5000)
    ]

    def put() -> None:
        zenoh_session.put("nedbus/\x1b[2J/vehicle_local_position", b"garbage")
        zenoh_session.put("nedbus/1/vehicle_local_position", b"\x1b[2J" * 1000)

    with repeating(put):
        for arguments, exit_code in (
            (["list"], 0),
            (["echo", "*", "-d", "0.5"], 1),
            (["hz", "-d", "0.5"], 1),
        ):
            result = run_command(*arguments, "-c", endpoint)
            assert result.exit_code == exit_code, result.err
            assert not has_control(result.out + result.err)
            assert len(result.out + result.err) < 5000
            assert exit_code == 0 or "not a VehicleLocalPosition" in result.err
    assert len(tokens) == 3


@pytest.mark.slow
def test_hz_limits_rows(endpoint: str, bus: nedbus.Bus) -> None:
    """For 100 vehicles `hz` prints 50 rows per second, and the number of omitted vehicles."""
    with publishing(bus, *(f"flood-{number}" for number in range(100))):
        # by then each vehicle has sent a message
        hz = run_command("hz", "-c", endpoint, "-n", "1000")
    assert hz.exit_code == 0
    assert "\n50 more\n" in hz.out
    assert max(table.count("\n") for table in hz.out.split("VEHICLE/TOPIC")) <= 53


CLOSING = {
    "exec >&-": "os.close(1); sys.stdout = None",  # as Python itself represents a closed stream
    "exec 2>&-": "os.close(2); sys.stderr = None",
}
CLOSED = "nedbus: cannot write to stdout: standard output is closed\n"


@pytest.mark.parametrize(
    "shell", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["forked", "shell"]
)
@pytest.mark.parametrize(
    ("limit", "command", "expected"),  # exit code, number of lines on stdout, stderr
    [
        *(
            ("exec >&-", command, (1, 0, CLOSED))
            for command in ("list", "schema", "get", "--version", "pki ca .")
        ),
        ("exec 2>&-", "list", (0, 2, "")),
        ("exec 2>&-", "get -v 9", (1, 0, "")),
    ],
)
def test_closed_stdout_is_a_one_line_error(
    start: Start,
    endpoint: str,
    bus: nedbus.Bus,
    *,
    limit: str,
    command: str,
    expected: object,
    shell: bool,
) -> None:
    """`nedbus list >&-` fails with a one-line error; a closed stderr is ignored."""
    bus.publisher(VLP, vehicle="1").publish(message(1))
    script = f"import os, sys\n{CLOSING[limit]}\nfrom nedbus.cli import main\nmain()"
    if shell:
        line = f"{limit}; NEDBUS_CONNECT={endpoint} exec {sys.executable} -m nedbus {command}"
        ended = subprocess.run(
            ["bash", "-c", line], capture_output=True, timeout=DEADLINE, check=False, text=True
        )
        result = ended.returncode, len(ended.stdout.splitlines()), ended.stderr
    else:
        process = start("-c", script, *command.split(), NEDBUS_CONNECT=endpoint)
        result = process.wait(), len(process.out.splitlines()), process.err
    assert result == expected


# a script's `&` starts a job with SIGINT ignored
IN_BACKGROUND = ("sh", "-c", 'trap "" INT; exec "$@"', "sh")
MOMENTS = [
    pytest.param("echo", imports, (), id=f"echo-{imports}") for imports in (1, 50, 150, 300, 10_000)
]
MOMENTS += [
    pytest.param("echo", imports, IN_BACKGROUND, id=f"background-{imports}")
    for imports in (1, 10_000)
]
MOMENTS += [
    pytest.param(each, 10_000, (), marks=pytest.mark.slow)
    for each in ("hz", "list", "serve -s sim:", "router")
]


@pytest.mark.process
@pytest.mark.parametrize(
    ("command", "imports", "prefix"), MOMENTS
)  # imports between nedbus.cli and the signal; 10,000: all
def test_interrupt_during_imports_prints_no_traceback(
    endpoint: str, command: str, imports: int, prefix: tuple[str, ...]
) -> None:
    """Ctrl-C at any time after `main` has started ends a command without a traceback; a shell sees exit code 130.

    This includes a background job of a shell script, which inherits SIGINT as ignored.
    """
    environment = without_coverage() | {
        "NEDBUS_CONNECT": endpoint,
        "NEDBUS_LISTEN": free_endpoint(),
    }
    arguments = [*prefix, sys.executable, "-X", "importtime", "-m", "nedbus", *command.split()]
    null, pipe = subprocess.DEVNULL, subprocess.PIPE
    with subprocess.Popen(
        arguments, stdout=null, stderr=pipe, text=True, env=environment
    ) as process:
        assert process.stderr is not None
        started, seen = False, 0
        for line in process.stderr:  # interrupt at a line of the import log, not at a time
            seen += started
            started = started or line.rstrip().endswith(" nedbus.cli")
            if seen == imports or line.rstrip().endswith(" nedbus.cli.app"):
                break
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
        assert process.wait(DEADLINE) in {-signal.SIGINT, 130, 0}
    assert "Traceback" not in rest


IGNORED = """
import signal, sys, time
from nedbus import settings
from nedbus.cli import main

number = int(sys.argv.pop())

class Interrupted:
    def __del__(self):
        signal.raise_signal(number)

def load(*_, **__):
    Interrupted()
    time.sleep(100)

settings.load_settings = load
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize(("number", "exit_code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signal_inside_a_destructor_is_repeated(
    start: Start, number: signal.Signals, exit_code: int
) -> None:
    """A signal ends a command even if it arrives inside a destructor or callback, where Python ignores it."""
    health = start("-c", IGNORED, "health", str(int(number)), coverage=False)
    assert health.wait() == exit_code
    assert not health.err


PAUSED = """
import time
from nedbus.cli import main
from nedbus.flights import conversion

def pause(*_):
    print("converting", flush=True)
    time.sleep(100)

conversion._CHUNK = 1
convert = conversion.convert_flight
conversion.convert_flight = lambda flight, path, on_progress: convert(flight, path, on_progress=pause)
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "exit_code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_signal_during_a_conversion_leaves_no_file(
    start: Start, tmp_path: Path, number: signal.Signals, exit_code: int
) -> None:
    """A conversion that Ctrl-C, `timeout` or a closed terminal ends removes its unfinished file."""
    log = write_flight(tmp_path / "a.ulg")
    convert = start("-c", PAUSED, "convert", str(log), str(tmp_path / "a.mcap"), coverage=False)
    wait_for(lambda: "converting" in convert.out, what="the conversion")
    assert [*tmp_path.glob("*.mcap")]
    convert.signal(number)
    assert convert.wait() == exit_code
    assert not [*tmp_path.glob("*.mcap")]
    assert not convert.err


FINALIZED = """
import sys, threading, time
import zenoh
from nedbus.cli import main

config = zenoh.Config()
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("listen/endpoints", "[]")
session = zenoh.open(config)
subscriber = session.declare_subscriber("end", zenoh.handlers.RingChannel(1))
threading.Thread(target=subscriber.handler.recv, daemon=True).start()

class Finalized:
    def __del__(self, put=session.put, sleep=time.sleep):
        put("end", b"")
        sleep(100)

sys.finalized = Finalized()
main()
"""


@pytest.mark.slow
def test_thread_in_zenoh_does_not_abort_the_exit(start: Start) -> None:
    """A command ends with its exit code and its whole output, even if a thread returns from Zenoh meanwhile."""
    schema = start("-c", FINALIZED, "schema", "VehicleAttitude", coverage=False)
    assert schema.wait() == 0
    assert json.loads(schema.out)["title"] == "VehicleAttitude"


STUCK = """
import time
from nedbus.cli import run

def stand_still(stop):
    print("started", flush=True)
    time.sleep(100)

run._END_TIMEOUT = 100.0
run.run_until_stopped(stand_still, on_stop=lambda: print("stopping", flush=True))
"""


@pytest.mark.parametrize(("number", "exit_code"), [(signal.SIGINT, 130), (signal.SIGTERM, 1)])
def test_second_signal_exits_at_once(start: Start, number: signal.Signals, exit_code: int) -> None:
    """A second signal ends a hanging command at once, before the timeout."""
    stuck = start("-c", STUCK, coverage=False)
    for text in ("started", "stopping"):
        wait_for(lambda text=text: text in stuck.out, what=text)  # type: ignore[misc]
        stuck.signal(number)
    assert stuck.wait() == exit_code


SLOW = """
import sys, time
from nedbus.cli import run
from nedbus.cli.app import make_app
from nedbus.daemon import daemon

run._END_TIMEOUT = 100.0

def open_slowly(**settings):
    print("opening", flush=True)
    time.sleep(2.0)
    return open_router(**settings)

open_router, daemon.open_router = daemon.open_router, open_slowly
make_app()(["serve", "-s", "sim:", "-l", sys.argv[1]])
"""


@pytest.mark.slow
def test_interrupt_during_a_slow_start_exits_with_130(start: Start) -> None:
    """Ctrl-C during a slow router start exits with 130, even if the start takes longer than the close timeout."""
    service = start("-c", SLOW, free_endpoint(), coverage=False)
    wait_for(lambda: "opening" in service.out, what="the service to open its router")
    service.signal(signal.SIGINT)
    assert service.wait() == 130
    assert "lost" not in service.err


ENDLESS = """
import threading, time
from nedbus.cli import run

def work(stop):
    print("started", flush=True)
    stop.wait()
    if "LIMIT" == "_CLOSE_TIMEOUT":
        closing.set()
    time.sleep(100)

closing = threading.Event()
run.LIMIT = 0.1
run.run_until_stopped(work, closing=closing)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("number", "exit_code"), [(signal.SIGINT, 130), (signal.SIGTERM, 1)])
@pytest.mark.parametrize(
    ("limit", "reason"),
    [
        ("_END_TIMEOUT", "still running 0.1 s after the signal"),
        ("_CLOSE_TIMEOUT", "links not closed within 0.1 s"),
    ],
)
def test_hanging_command_is_terminated_after_timeout(
    start: Start, number: signal.Signals, exit_code: int, limit: str, reason: str
) -> None:
    """A command's work and the closing of its session each have a timeout, and the log names the one that expired."""
    endless = start("-c", ENDLESS.replace("LIMIT", limit), coverage=False)
    wait_for(lambda: "started" in endless.out, what="the start")
    endless.signal(number)
    assert endless.wait() == exit_code
    assert reason in endless.err


@pytest.mark.slow
def test_hangup_stops_a_router(run_nedbus: Start) -> None:
    """SIGHUP stops a command without settings to reload; the log names the signal."""
    where = free_endpoint()
    router = run_nedbus("router", "-l", where)
    wait_for(lambda: f"router on {where}" in router.err, what="the router")
    router.signal(signal.SIGHUP)
    assert router.wait() == 0
    last = router.err.splitlines()[-1]
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d INFO    stopping on SIGHUP", last)


ON_TERMINAL = (
    "import fcntl, os, sys, termios; "
    "fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execv(sys.argv[1], sys.argv[1:])"
)


@contextmanager
def on_controlling_terminal(
    log: Path, *command: str
) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """Run `nedbus` as the session leader of a terminal; yield the process and the other side of the terminal."""
    main, terminal = pty.openpty()
    python = (sys.executable, "-c", ON_TERMINAL, sys.executable, "-m", "nedbus", *command)
    with log.open("wb") as err, subprocess.Popen(
        python, stdin=terminal, stdout=terminal, stderr=err, start_new_session=True, env=without_coverage()
    ) as process:  # fmt: skip
        os.close(terminal)
        yield process, main
        process.kill()


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.parametrize(
    "command", ["serve -s sim:", "record -o flight.mcap", "web --http 127.0.0.1:PORT"]
)
def test_closed_terminal_stops_commands(
    bus: nedbus.Bus, endpoint: str, tmp_path: Path, command: str
) -> None:
    """Closing the terminal stops a service, a recording and a web page, as Ctrl-C does."""
    log, arguments = tmp_path / "log", command.replace("PORT", str(free_port())).split()
    with (
        publishing(bus, "9"),
        on_controlling_terminal(log, *arguments, "-c", endpoint) as (process, main),
    ):
        begun = {
            "serve": lambda: "1" in bus.vehicles(),
            "record": lambda: (
                Path("flight.mcap").exists() and Path("flight.mcap").stat().st_size > 1000
            ),
            "web": lambda: "open http" in log.read_text(),
        }
        wait_for(begun[arguments[0]], what="the command")
        os.close(main)
        assert process.wait(DEADLINE) == 0
    assert "stopping on SIGHUP" in log.read_text()


@pytest.mark.process
def test_hangup_on_an_open_terminal_reloads(endpoint: str, tmp_path: Path) -> None:
    """`kill -HUP` reloads a service that runs on an open terminal."""
    log = tmp_path / "log"
    with on_controlling_terminal(log, "serve", "-s", "sim:", "-c", endpoint) as (process, main):
        wait_for(lambda: "sim:" in log.read_text(), what="the source")
        process.send_signal(signal.SIGHUP)
        wait_for(
            lambda: "settings reloaded: 0 started, 0 stopped, 1 unchanged" in log.read_text(),
            what="the reload",
        )
        process.terminate()
        assert process.wait(DEADLINE) == 0
        os.close(main)


def _make_run(folder: Path) -> list[str]:
    """Return `make run` with a virtual environment in a folder, which runs this nedbus, and free ports."""
    program = folder / "venv" / "bin" / "nedbus"
    program.parent.mkdir(parents=True)
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m nedbus "$@"\n')
    program.chmod(0o755)
    (folder / "venv" / ".ready").touch()
    options = f"-s sim: -l {free_endpoint()} --http 127.0.0.1:{free_port()}"
    return ["make", "-C", str(ROOT), "run", f"VENV={folder}/venv", f"ARGS={options}"]


@pytest.mark.slow
@pytest.mark.process
def test_kill_of_make_run_ends_the_service(tmp_path: Path) -> None:
    """`make run & kill $!` ends the service, too, which frees its port."""
    command, log = _make_run(tmp_path), tmp_path / "log"
    with log.open("w") as written:
        make = subprocess.Popen(
            command, stdout=written, stderr=written, env=without_coverage(), start_new_session=True
        )
    try:
        wait_for(lambda: "In a second terminal" in log.read_text(), what="the service")
        make.terminate()
        assert make.wait(DEADLINE) in {2, -signal.SIGTERM}
        wait_for(lambda: not _is_alive(make.pid), what="the end of all its processes")
    finally:
        with suppress(ProcessLookupError):
            os.killpg(make.pid, signal.SIGKILL)
    assert "stopping on SIGTERM" in log.read_text()


def _is_alive(group: int) -> bool:
    with suppress(ProcessLookupError):
        os.killpg(group, 0)
        return True
    return False


@pytest.mark.slow
@pytest.mark.process
def test_make_run_twice_explains_the_address_conflict(tmp_path: Path) -> None:
    """A second `make run` names the address in use and the remedy; Ctrl-C ends the first without a make error."""
    command = _make_run(tmp_path)
    log = tmp_path / "log"
    with log.open("w") as written:
        first = subprocess.Popen(
            command, stdout=written, stderr=written, env=without_coverage(), start_new_session=True
        )
    try:
        wait_for(lambda: "In a second terminal" in log.read_text(), what="the service")
        second = subprocess.run(
            command, capture_output=True, check=False, text=True, timeout=DEADLINE
        )
        assert second.returncode == 2
        assert "(address already in use): choose another address with --http\n" in second.stderr
        assert 'make run ARGS="' in second.stderr
        os.killpg(first.pid, signal.SIGINT)
        assert first.wait(DEADLINE) in {0, -signal.SIGINT}
    finally:
        with suppress(ProcessLookupError):
            os.killpg(first.pid, signal.SIGKILL)
    assert "stopping on SIGINT" in log.read_text()
    assert "***" not in log.read_text()
