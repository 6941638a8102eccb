"""What a person meets at a terminal: tables of any width, hostile text, closed streams, signals at any moment."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import pytest
from rich.console import Console

import nedbus
from nedbus.cli.format import printable, to_text
from nedbus.cli.lines import Lines
from nedbus.cli.live_table import LiveTable
from nedbus.cli.table import to_table
from nedbus.transport import Session, open_router
from nedbus_msgs import DEFAULT_TOPIC, TOPICS
from tests.conftest import DEADLINE, Start, free_endpoint, free_port, message, unmeasured, wait_for

ROOT = Path(__file__).parents[2]
VLP = DEFAULT_TOPIC
EVIL = "\x1b]0;owned\x07\x1b[2J\u202e\x9b31m\nforged line"


def has_control(text: str) -> bool:
    """Return whether anything in a text would act on a terminal."""
    return any(not (char.isprintable() or char == "\n") for char in text)


# Text


def test_text_of_a_peer_is_one_short_printable_line() -> None:
    """Escape sequences, directions of writing and line breaks are spelt out, and what is long is cut."""
    assert to_text(EVIL) == r"\x1b]0;owned\x07\x1b[2J\u202e\x9b31m\nforged line"
    assert len(to_text("x" * 100_000)) == 120
    assert len(to_text("\x1b" * 100_000)) < 500
    assert printable("déjà vu\n世界") == "déjà vu\n世界"
    assert printable("name-\udcff") == r"name-\udcff"


# Tables

HEAD = ("VEHICLE/TOPIC", "HZ", "JITTER", "LATENCY", "MAX", "LOST", "STATE")
ROWS = [
    ("1/vehicle_local_position_groundtruth", "100.0", "12.3 ms", "999 ms", "119.9 s", "12345", "ok"),
    ("1/vehicle_local_position", "-", "-", "-", "-", "0", "stale: nothing for 4.2 s, xy z invalid, dead reckoning"),
]


@pytest.mark.parametrize("width", [30, 40, 80, 110])
def test_table_fits(width: int) -> None:
    """No line is longer than the terminal, the name and the state are complete, and wide ones show more columns."""
    optional = ("JITTER", "MAX", "LATENCY", "LOST")
    lines = to_table(HEAD, ROWS, width=width, optional=optional).splitlines()
    assert all(len(line) <= width for line in lines)
    shown = "".join("".join(lines).split())
    assert shown.count("vehicle") == 2
    assert {word in shown for word in ("stale:", "nothing", "invalid", "reckoning")} == {True}
    assert ("JITTER" in lines[0]) == (width >= 110)


@pytest.mark.parametrize("width", [30, 40, 64, 80])
def test_names_are_not_broken_inside_words(width: int) -> None:
    """A name is whole while there are columns to leave out; then it is folded after slashes, then after underscores."""
    optional = ("JITTER", "MAX", "LATENCY", "LOST")
    lines = to_table(HEAD, ROWS, width=width, optional=optional).splitlines()
    names = [line.split()[0] for line in lines if not line.startswith(" ")]
    assert (ROWS[0][0] in names) == (width >= 60)
    assert all(re.search(r"[/_]$|groundtruth$|position$|^VEHICLE|^TOPIC$", name) for name in names)
    remark = "/a/rather/long/path/to/some/flight_of_today.ulg: no such file or directory"
    folded = to_table(("SOURCE", "REMARK"), [("sim:", remark)], width=24)
    assert [line[8:] for line in folded.splitlines()[1:]] == [
        "/a/rather/long/",
        "path/to/some/",
        "flight_of_today.",
        "ulg: no such",
        "file or",
        "directory",
    ]
    long = f"{'v' * 64}/vehicle_local_position"
    lines = to_table(HEAD, [(long, *ROWS[0][1:])], width=80, optional=optional).splitlines()
    assert [line.split()[0] for line in lines[1:]] == ["v" * 64 + "/", "vehicle_local_position"]
    assert all(len(line) <= 80 for line in lines)


# Lines


def sample(address: nedbus.Address) -> nedbus.Sample:
    position = {"x": -1234.5678, "y": 2.0, "z": -3.0, "vx": -1.0, "heading": 1.5, "eph": 0.5, "xy_valid": True}
    return nedbus.Sample(message(99_999_123_456, **position), address, 0, lost=3)


ALL_TOPICS = [nedbus.Address("1", topic, 0 if topic.startswith("estimator") else None) for topic in TOPICS]


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], Lines]:
    """Return what makes lines of all topics for a terminal of a width, and of 24 lines."""
    monkeypatch.setenv("LINES", "24")

    def make(width: int) -> Lines:
        monkeypatch.setattr("nedbus.cli.lines.terminal_width", lambda: width)
        return Lines(nedbus.Selection())

    return make


def test_line_leaves_out_columns_in_order(lines: Callable[[int], Lines]) -> None:
    """Narrower and narrower: eph goes first, then heading, then velocity; position, doubts and loss never."""
    one = sample(nedbus.Address("1", VLP))
    seen: list[list[str]] = []
    for width in range(150, 73, -1):
        head, line = lines(width)(one).splitlines()
        assert len(head) <= width
        assert len(line) <= width
        assert all(text in line for text in ("1/veh", "-1234.5", "  z vxy vz invalid", "[3 lost]"))
        columns = [name for name in ("Z m", "VZ m/s", "HDG deg", "EPH m", "STATE") if name in head]
        if not seen or seen[-1] != columns:
            seen.append(columns)
    most = ["Z m", "VZ m/s", "HDG deg", "EPH m"]
    assert seen == [[*most[:count], "STATE"] for count in (4, 3, 2, 1)]


def test_addresses_are_cut_only_where_nothing_is_free(lines: Callable[[int], Lines]) -> None:
    """The middle of a topic is left out as far as its line has no room for it, and a narrow one has no free columns."""
    for width in range(74, 110):
        line = lines(width)(sample(nedbus.Address("1", "vehicle_local_position_groundtruth"))).splitlines()[1]
        assert len(line) == width or "1/vehicle_local_position_groundtruth " in line
    flags = dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"), True)
    fine = message(1, **flags, **dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), 0.0))
    to_line = lines(80)
    for address in ALL_TOPICS:
        assert f"{address} " in to_line(nedbus.Sample(fine, address, 0))


def test_short_addresses_remain_different(lines: Callable[[int], Lines]) -> None:
    """The four topics of a vehicle are told apart where only a part of their names has room."""
    for width in (1, 80, 85, 90):
        to_line = lines(width)
        shown = {to_line(sample(address)).splitlines()[-1].split()[0] for address in ALL_TOPICS}
        assert len(shown) == len(TOPICS)
        assert width > 1 or "1/veh…tion" in shown


def test_heading_is_above_its_columns(lines: Callable[[int], Lines]) -> None:
    """There is one at first, one in each screenful, and one when the columns change; every state is below STATE."""
    to_line, headed, state = lines(150), [], 0
    for number in range(80):
        *head, line = to_line(sample(nedbus.Address("1" if number < 40 else "wing", VLP))).splitlines()
        if head:
            headed.append(number)
            state = head[0].index("STATE")
        assert line.index("z vxy vz invalid") == state
    assert headed == [0, 22, 40, 62]
    of_fields = lines(150)(sample(nedbus.Address("1", VLP)), ["x", "eph"]).splitlines()
    assert of_fields[0].split() == ["VEHICLE/TOPIC", "TIME", "s", "x", "eph", "STATE"]


@pytest.mark.process
def test_echo_fits_a_terminal(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """At 80 columns a line is a line, below a heading; the addresses of two vehicles are a column, and whole."""
    run_nedbus("serve", "-c", endpoint, "-s", "sim:", "-s", "sim:?vehicle=wing")
    wait_for(lambda: len(bus.latest()) == 2, what="two vehicles")
    with on_terminal("echo", "-c", endpoint, "-n", "40") as terminal:
        assert terminal.popen.wait(DEADLINE) == 0
    shown = [line for line in terminal.shown.splitlines() if line.startswith("VEHICLE/TOPIC  ") or VLP in line]
    lines = [line for line in shown if VLP in line]
    assert len(lines) == 40
    assert max(map(len, shown)) <= 80
    state = -1
    for line in shown:
        if VLP not in line:
            state = line.index("STATE")
        elif "  ok" in line:
            assert line.index("  ok") + 2 == state


def test_info_names_what_is_gone(run_nedbus: Start, endpoint: str, raw: Session) -> None:
    """The number stands in the table, the addresses below it; on a terminal no address is broken."""
    gone = [f"wing-{number}/vehicle_local_position" for number in range(5)]
    sources = [{"source": "px4-zenoh:", "state": "waiting", "stale": gone}]
    service = answer(raw, "nedbus/@service/s/status", {"service": "s", "sources": sources})
    info = run_nedbus("info", "-c", endpoint)
    assert info.wait() == 0, info.err
    assert "  5 gone\n" in info.out
    assert f"\ngone: {', '.join(gone)}\n" in info.out
    with on_terminal("info", "-c", endpoint) as terminal:
        assert terminal.popen.wait(DEADLINE) == 0
    lines = terminal.shown.splitlines()
    assert max(map(len, lines)) <= 80
    assert all(any(address in line for line in lines) for address in gone)
    del service


def test_table_without_a_terminal_is_complete() -> None:
    """A row is a line."""
    assert len(to_table(HEAD, ROWS).splitlines()) == 3


# On a terminal


class Terminal:
    """A command on a terminal of its own, and what it shows."""

    def __init__(self, *arguments: str, columns: int = 80, lines: int = 24) -> None:
        self._main, terminal = pty.openpty()
        self._output = bytearray()
        self._stopping = threading.Event()
        environment = {**unmeasured(), "COLUMNS": str(columns), "LINES": str(lines), "TERM": "xterm"}
        self.popen = subprocess.Popen(
            [sys.executable, "-m", "nedbus", *arguments],
            stdout=terminal,
            stderr=terminal,
            stdin=subprocess.DEVNULL,
            env=environment,
        )
        os.close(terminal)
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    @property
    def shown(self) -> str:
        return self._output.decode(errors="replace")

    def has_shown(self, text: str) -> bool:
        return text in self.shown

    def close(self) -> None:
        self.popen.kill()
        self.popen.wait(DEADLINE)
        self._reader.join(DEADLINE)

    def hang_up(self) -> None:
        """Close the terminal, as `sshd` does when a connection breaks."""
        self._stopping.set()
        self._reader.join(DEADLINE)
        self.popen.send_signal(signal.SIGHUP)

    def _read(self) -> None:
        with suppress(OSError):  # the other side is closed
            while not self._stopping.is_set():
                if select.select([self._main], [], [], 0.1)[0]:
                    self._output.extend(os.read(self._main, 4096))
        os.close(self._main)


@contextmanager
def on_terminal(*arguments: str, columns: int = 80, lines: int = 24) -> Iterator[Terminal]:
    terminal = Terminal(*arguments, columns=columns, lines=lines)
    try:
        yield terminal
    finally:
        terminal.close()


@pytest.mark.process
def test_hz_redraws_in_place(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """On a terminal the table is drawn over the last one, as high as the terminal at most, and stays at the end."""
    run_nedbus("serve", "-c", endpoint, "-s", "sim:", *(f"-ssim:?vehicle={number}" for number in range(2, 5)))
    wait_for(lambda: len(bus.latest("*")) == 20, what="four vehicles")
    with on_terminal("hz", "-c", endpoint, "-d", "4", lines=10) as terminal:
        assert terminal.popen.wait(DEADLINE) == 0
    assert "\x1b[1A\x1b[2K" in terminal.shown
    assert " more" in terminal.shown
    drawings = terminal.shown.split("VEHICLE/TOPIC")[1:]
    assert len(drawings) >= 3
    assert all(drawing.count("\n") <= 10 for drawing in drawings)


@pytest.mark.process
def test_hz_leaves_the_cursor_as_it_was(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """Ctrl-C and SIGTERM, as of `timeout`, end the redrawing and show the cursor again."""
    run_nedbus("serve", "-c", endpoint, "-s", "sim:")
    for number, code in ((signal.SIGINT, 130), (signal.SIGTERM, 143)):
        with on_terminal("hz", "-c", endpoint) as terminal:
            wait_for(partial(terminal.has_shown, "\x1b[?25l"), what="the table")
            terminal.popen.send_signal(number)
            assert terminal.popen.wait(DEADLINE) == code
        assert terminal.shown.rindex("\x1b[?25h") > terminal.shown.rindex("\x1b[?25l")
        assert "Traceback" not in terminal.shown


@pytest.mark.parametrize(("number", "raised"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)])
def test_signal_while_a_table_starts(
    monkeypatch: pytest.MonkeyPatch, number: signal.Signals, raised: type[BaseException]
) -> None:
    """It has its effect when the table has started, and can be stopped: the cursor is shown again."""
    shown: list[bool] = []

    def show_cursor(console: Console, show: bool = True) -> bool:
        shown.append(show)
        if show is False:
            signal.raise_signal(number)
        return True

    monkeypatch.setattr(Console, "show_cursor", show_cursor)
    monkeypatch.setattr("nedbus.cli.live_table.terminal_width", lambda: 80)
    handlers = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(raised), LiveTable(HEAD, ()) as table:
            table.show(ROWS)
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)
    assert shown == [False, True]


# Links and states


@pytest.fixture
def restarted_router() -> Iterator[tuple[str, Callable[[], None], Callable[[], None]]]:
    """Run a router that a test can end and start again."""
    where = free_endpoint()
    sessions = [open_router(listen=(where,))]

    def begin() -> None:
        sessions.append(open_router(listen=(where,)))

    yield where, lambda: sessions.pop().close(), begin
    for session in sessions:
        session.close()


@pytest.mark.parametrize("command", ["echo", "hz"])
def test_link_that_breaks_is_reported(
    run_nedbus: Start, restarted_router: tuple[str, Callable[[], None], Callable[[], None]], command: str
) -> None:
    """`echo` and `hz` say when the link to the router breaks, and when it is back; `hz` says so of each stream."""
    where, end, begin = restarted_router
    run_nedbus("serve", "-c", where, "-s", "sim:")
    follower = run_nedbus(command, "-c", where, "--json")
    wait_for(lambda: follower.out, what="data")
    end()
    wait_for(lambda: f"the link to {where} is broken: waiting for it" in follower.err, what="the break")
    if command == "hz":
        wait_for(lambda: '"state": "disconnected", "reason": "no link"' in follower.out, what="the state")
    begin()
    wait_for(lambda: f"the link to {where} is back" in follower.err, what="the link")
    lines = follower.out.count("\n")
    wait_for(lambda: follower.out.count("\n") > lines + 3, what="more data")


def states(lines: str) -> list[str]:
    return [json.loads(line)["state"] for line in lines.splitlines() if line.endswith("}")]


def test_killed_service_is_gone(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """A stream whose service was killed is not "ok", in `hz` as in `list`, and `hz` tells it once, first of all."""
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


def test_finished_replay_is_stale(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """A replay that has ended, in a service that still runs, has no state "ok" in `list`, `info` and `hz`."""
    run_nedbus("serve", "-c", endpoint, "-s", "sim:?duration=4&wait=1")
    hz = run_nedbus("hz", "-c", endpoint, "--json", "-t", VLP)
    wait_for(lambda: "stale" in states(hz.out), what="hz to see the end")
    listed = run_nedbus("list", "-c", endpoint)
    assert listed.wait() == 0
    assert [line.split()[3] for line in listed.out.splitlines()[1:]] == ["stale:"] * 5
    info = run_nedbus("info", "-c", endpoint)
    assert info.wait() == 0
    assert info.out.count("stale: nothing for ") == 5


# What peers send


def answer(raw: Session, key: str, status: object) -> object:
    """Answer queries for a status as a hostile service would."""
    return raw.declare_queryable(key, lambda query: query.reply(key, json.dumps(status)))


def test_hostile_status_is_shown_harmless(run_nedbus: Start, endpoint: str, raw: Session) -> None:
    """Escape sequences, forged lines and endless texts of a service are shown as short text, or left out."""
    flood = [{"source": EVIL * 1000, "state": "retrying", "error": EVIL * 1000, "published": [EVIL] * 1000}]
    stream = {"address": EVIL, "health": {"rate": "\x1b[2J"}}
    source = {**flood[0], "stale": [EVIL], "streams": [stream, None, {"address": 1}], "addresses": EVIL}
    status = {"service": EVIL, "host": EVIL, "version": EVIL, "role": EVIL, "sources": [source, "\x1b[2J", None]}
    hostile = answer(raw, "nedbus/@service/hostile/status", status)
    for arguments in (["info"], ["health", "--services", "1"], ["health", "--services", "1", "--json"]):
        shown = run_nedbus(*arguments, "-c", endpoint)
        assert shown.wait() == (arguments[0] == "health"), shown.err
        assert not has_control(shown.out + shown.err)
        assert "\nforged line" not in shown.out + shown.err
        assert len(shown.out + shown.err) < 5000
    del hostile


def test_hostile_keys_are_shown_harmless(run_nedbus: Start, endpoint: str, raw: Session) -> None:
    """Keys and tokens with escape sequences reach neither the output nor the log."""
    tokens = [raw.liveliness().declare_token(f"nedbus/{name}/@alive/{VLP}") for name in ("\x1b[2J", "a\nb", "x" * 5000)]
    listed = run_nedbus("list", "-c", endpoint)
    assert listed.wait() == 0, listed.err
    echo = run_nedbus("echo", "-c", endpoint, "*", "-d", "2")
    hz = run_nedbus("hz", "-c", endpoint, "-d", "2")
    while echo.popen.poll() is None or hz.popen.poll() is None:
        raw.put("nedbus/\x1b[2J/vehicle_local_position", b"garbage")
        raw.put("nedbus/1/vehicle_local_position", b"\x1b[2J" * 1000)
    for process in (listed, echo, hz):
        assert not has_control(process.out + process.err)
        assert len(process.out + process.err) < 5000
    assert len(tokens) == 3


def test_flood_of_keys_leaves_hz_small(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """Of 1000 vehicles there are 50 rows a second and a number, not 1000."""
    hz = run_nedbus("hz", "-c", endpoint, measured=False)
    publishers = [bus.publisher(VLP, vehicle=f"flood-{number}") for number in range(1000)]

    def is_shown() -> bool:
        for each in publishers:
            each.publish(message(1))
        return " more\n" in hz.out

    wait_for(is_shown, what="more than 50 rows")
    hz.signal(signal.SIGINT)
    assert hz.wait() == 130
    assert max(table.count("\n") for table in hz.out.split("VEHICLE/TOPIC")) <= 53


# Streams and signals


@pytest.mark.process
@pytest.mark.parametrize("command", ["list", "schema", "get", "--version", "pki ca ."])
def test_closed_stdout_is_one_line(endpoint: str, bus: nedbus.Bus, command: str) -> None:
    """`nedbus list >&-` says that nothing can be written, and exits with 1."""
    bus.publisher(VLP, vehicle="1").publish(message(1))
    wait_for(bus.latest, what="the message")
    connect = f"-c {endpoint}" if command in {"list", "get"} else ""
    line = f"{sys.executable} -m nedbus {command} {connect} >&-"
    ended = subprocess.run(["bash", "-c", line], capture_output=True, timeout=DEADLINE, check=False, text=True)
    assert (ended.returncode, ended.stderr) == (1, "nedbus: cannot write: standard output is closed\n")


@pytest.mark.process
def test_closed_stderr_changes_nothing(endpoint: str, bus: nedbus.Bus) -> None:
    """Without stderr there is nowhere to complain, and output and exit codes are as ever."""
    bus.publisher(VLP, vehicle="1").publish(message(1))
    wait_for(bus.latest, what="the message")
    for command, code, lines in (("list", 0, 2), ("get -v 9", 1, 0)):
        line = f"{sys.executable} -m nedbus {command} -c {endpoint} 2>&-"
        ended = subprocess.run(["bash", "-c", line], capture_output=True, timeout=DEADLINE, check=False, text=True)
        assert (ended.returncode, len(ended.stdout.splitlines())) == (code, lines)


@pytest.mark.process
@pytest.mark.parametrize("command", [["list"], ["serve", "-s", "sim:"], ["schema"]])
def test_too_few_files_are_no_traceback(command: list[str]) -> None:
    """`ulimit -n 12` ends in a sentence: Zenoh would abort the process with a page of Rust."""
    ended = subprocess.run(
        ["bash", "-c", f"ulimit -n 12; {sys.executable} -m nedbus {' '.join(command)}"],
        capture_output=True,
        timeout=DEADLINE,
        check=False,
        text=True,
    )
    expected = "nedbus: only 12 open files are allowed: set 'ulimit -n 64' or more\n"
    assert (ended.returncode, ended.stderr) == (1, expected)


@pytest.mark.process
@pytest.mark.parametrize("command", [["echo"], ["hz"], ["list"], ["serve", "-s", "sim:"], ["router"]])
def test_interrupt_in_the_first_second_is_quiet(endpoint: str, command: list[str]) -> None:
    """Ctrl-C at any moment from the start of `main` on ends without a traceback, as 130 in a shell."""
    where = ["-l", free_endpoint()] if command[0] in {"serve", "router"} else ["-c", endpoint]
    for imports in (1, 50, 150, 300, 10_000):
        arguments = [sys.executable, "-X", "importtime", "-m", "nedbus", *command, *where]
        with subprocess.Popen(
            arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=unmeasured()
        ) as process:
            assert process.stderr is not None
            started, seen = False, 0
            for line in process.stderr:  # the moment is one of the program, not of a clock
                seen += started
                started = started or line.rstrip().endswith(" nedbus.cli")
                if seen == imports or line.rstrip().endswith(" nedbus.cli.app"):
                    break
            process.send_signal(signal.SIGINT)
            rest = process.stderr.read()
            assert process.wait(DEADLINE) in {-signal.SIGINT, 130, 0}
        assert "Traceback" not in rest


@pytest.mark.parametrize(
    ("command", "answer"),
    [(["serve", "-s", "sim:"], "0 started, 0 stopped, 1 unchanged"), (["router"], "SIGHUP is ignored")],
)
def test_hangup_ends_no_service(run_nedbus: Start, command: list[str], answer: str) -> None:
    """SIGHUP, which a closed terminal sends, ends nothing; what ends a service is logged, with the date."""
    where = free_endpoint()
    service = run_nedbus(*command, "-l", where)
    wait_for(lambda: f"router on {where}" in service.err, what="the service")
    service.signal(signal.SIGHUP)
    wait_for(lambda: answer in service.err, what="the hang-up")
    service.signal(signal.SIGTERM)
    assert service.wait() == 0
    last = service.err.splitlines()[-1]
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d INFO    ending: SIGTERM", last)


@pytest.mark.process
def test_closed_terminal_ends_no_service(bus: nedbus.Bus, endpoint: str) -> None:
    """A service whose terminal is gone publishes on."""
    with on_terminal("serve", "-c", endpoint, "-s", "sim:") as terminal:
        wait_for(bus.latest, what="data")
        terminal.hang_up()
        with bus.subscribe(mode="every") as subscription:
            for _ in range(100):
                subscription.receive(DEADLINE)
        assert terminal.popen.poll() is None
        terminal.popen.send_signal(signal.SIGTERM)
        assert terminal.popen.wait(DEADLINE) == 0


@pytest.mark.process
def test_make_run(tmp_path: Path) -> None:
    """A second one says that a nedbus runs already, and how to choose; Ctrl-C ends the first without make's error."""
    program = tmp_path / "venv" / "bin" / "nedbus"
    program.parent.mkdir(parents=True)
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m nedbus "$@"\n')
    program.chmod(0o755)
    (tmp_path / "venv" / ".ready").touch()
    options = f"-s sim: -l {free_endpoint()} --http 127.0.0.1:{free_port()}"
    command = ["make", "-C", str(ROOT), "run", f"VENV={tmp_path}/venv", f"ARGS={options}"]
    log = tmp_path / "log"
    with log.open("w") as written:
        first = subprocess.Popen(command, stdout=written, stderr=written, env=unmeasured(), start_new_session=True)
    try:
        wait_for(lambda: "In a second terminal" in log.read_text(), what="the service")
        second = subprocess.run(
            command, capture_output=True, check=False, text=True, timeout=DEADLINE, env=unmeasured()
        )
        assert second.returncode == 2
        assert "(a nedbus runs there already): end it, or choose another address with --http\n" in second.stderr
        assert 'make run ARGS="' in second.stderr
        os.killpg(first.pid, signal.SIGINT)
        assert first.wait(DEADLINE) in {0, -signal.SIGINT}
    finally:
        with suppress(ProcessLookupError):
            os.killpg(first.pid, signal.SIGKILL)
    assert "ending: SIGINT" in log.read_text()
    assert "***" not in log.read_text()
