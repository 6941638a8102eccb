"""The log: JSON for programs, priorities for the journal, levels, a closed list of events, and a limit for floods."""

from __future__ import annotations

import ast
import json
import logging
import re
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import pytest
import zenoh

import nedbus
from nedbus.cli.output.logs import BURST, PER_MINUTE, JournalFormatter, JsonFormatter, RateLimit, TextFormatter
from nedbus.log_event import EVENTS, about
from nedbus.timings import Timings
from nedbus.transport import Session
from nedbus_msgs import Address
from tests.flights.first_message import encode
from tests.flights.messages import VLP, message
from tests.nedbus.sources.px4.test_source import Px4
from tests.peers.command_line import run_command
from tests.peers.custom_timings import start_with_timings
from tests.peers.processes import Start
from tests.waits import wait_for, wait_for_matching

REPLAY = "sim:?duration=1&speed=max"
ROOT = Path(__file__).parents[4]
SERVICE = ROOT / "service" / "nedbus"
EVIL = 'a\x1b[2J\n{"event": "forged"}\u2028'
VEHICLES = 2 * BURST + 10


def record(text: str = "%s is stale", *args: object, event: str | None = "stale", **more: object) -> logging.LogRecord:
    """Return a record as a log call of a service makes it."""
    warning = {"name": "nedbus.x", "levelname": "WARNING", "levelno": logging.WARNING, "msg": text, "args": args}
    return logging.makeLogRecord(warning | (about(event) if event else {}) | more)


def log_calls(tree: ast.AST) -> Iterator[ast.Call]:
    """Yield the calls that log something above DEBUG."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            logger, level = node.func.value, node.func.attr
            name = logger.id if isinstance(logger, ast.Name) else ""
            if name == "_log" and level in {"info", "warning", "error", "exception", "critical", "log"}:
                yield node


def is_about(node: ast.expr | None) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "about"


def values_of(node: ast.expr, tree: ast.AST) -> Iterator[ast.expr]:
    """Yield what an expression can be: itself, either side of a condition, or what is assigned to its name."""
    if isinstance(node, ast.IfExp):
        yield from values_of(node.body, tree)
        yield from values_of(node.orelse, tree)
    elif isinstance(node, ast.Name):
        for other in ast.walk(tree):
            targets = other.targets if isinstance(other, ast.Assign) else []
            if isinstance(other, ast.Assign) and node.id in [getattr(target, "id", None) for target in targets]:
                yield from values_of(other.value, tree)
    else:
        yield node


def events_of(call: ast.Call, tree: ast.AST) -> set[str]:
    """Return the events that a log call may have."""
    extras = [value for each in call.keywords if each.arg == "extra" for value in values_of(each.value, tree)]
    assert extras, f"line {call.lineno} has no event: extra=about(...)"
    assert all(is_about(each) for each in extras), f"line {call.lineno}: extra is not about(...)"
    events = [value for each in extras if isinstance(each, ast.Call) for value in values_of(each.args[0], tree)]
    return {str(each.value) if isinstance(each, ast.Constant) else ast.unparse(each) for each in events}


def test_each_line_has_an_event_of_the_table() -> None:
    """Whatever is logged above DEBUG has an event that EVENTS documents; no event of the table is left over."""
    used: set[str] = set()
    for path, text in ((path, path.read_text()) for path in sorted(SERVICE.rglob("*.py"))):
        tree = ast.parse(text if "_log." in text else "")
        for call in log_calls(tree):
            events = events_of(call, tree)
            assert events <= EVENTS.keys(), f"{path}, line {call.lineno}"
            used |= events
    assert used == EVENTS.keys() - {"left-out"}


def test_manual_says_what_is_limited() -> None:
    """The page about logs has the limits of the code, and names events that there are."""
    section = (ROOT / "docs" / "operate.md").read_text().partition("\n## Logs\n")[2]
    named = re.findall(r"^\| ((?:`[a-z-]+`(?:, )?)+) \| [a-z ]", section, re.MULTILINE)
    events = {each for names in named for each in re.findall(r"`([a-z-]+)`", names)} & EVENTS.keys()
    assert {"error", "rejected", "client-refused"} <= events
    assert f"{BURST} lines" in section
    assert f"{PER_MINUTE} a minute" in section


def test_json_is_one_harmless_object() -> None:
    """Whatever a peer sent, a line is one object of ASCII that acts on no terminal; null is only a missing event."""
    address = Address("7", "estimator_local_position", 2)
    extra = about("rejected", address, source=EVIL, reason=EVIL * 1000)
    line = JsonFormatter().format(record("%s: rejected", EVIL * 1000, about=extra["about"], created=1.5))
    assert line.isascii()
    assert line.isprintable()
    assert len(line) < 20_000
    fields = json.loads(line)
    names = ["time", "level", "event", "message", "logger"]
    assert list(fields) == [*names, "vehicle", "topic", "instance", "source", "reason"]
    assert (fields["time"], fields["level"]) == ("1970-01-01T00:00:01.500Z", "warning")
    assert (fields["vehicle"], fields["topic"], fields["instance"]) == ("7", "estimator_local_position", 2)
    assert all(text.isprintable() for text in fields.values() if isinstance(text, str))
    fields = json.loads(JsonFormatter().format(record("plain", event=None)))
    assert list(fields) == names
    assert fields["event"] is None


def test_traceback_is_one_text() -> None:
    """In JSON a traceback is one string; the end of a long one is kept, where the error is named."""
    try:
        raise ValueError("x" * 100_000 + EVIL + "the end")
    except ValueError:
        line = JsonFormatter().format(record(exc_info=sys.exc_info()))
    exception = json.loads(line)["exception"]
    assert exception.endswith("the end")
    assert exception.replace("\n", "").isprintable()
    assert len(exception) < 30_000


def test_journal_gets_a_priority_for_each_line() -> None:
    """Each line of a traceback has the priority of syslog, 3 for errors to 7 for debug."""
    formatter = JournalFormatter(TextFormatter("%(message)s"))
    assert formatter.format(record("%s\nforged", "x")) == "<4>x\\nforged"
    for level, number in ((logging.DEBUG, 7), (logging.INFO, 6), (logging.ERROR, 3), (logging.CRITICAL, 3)):
        assert formatter.format(record("text", levelno=level)) == f"<{number}>text"
    try:
        raise ValueError("two\nlines")
    except ValueError:
        lines = formatter.format(record(exc_info=sys.exc_info())).split("\n")
    assert len(lines) >= 5
    assert all(line.startswith("<4>") for line in lines)


def test_service_logs_json(start: Start) -> None:
    """Each line of a service is an object with an event, of its source if there is one.

    What a person would read beside the log is in an object; what to type in a second terminal is left out.
    """
    sources = ("-s", REPLAY, "-s", "sim:?vehicle=2")
    soon = Timings(reports=(0.2,))
    service = start_with_timings(start, soon, "serve", "-l", "tcp/127.0.0.1:0", *sources, NEDBUS_LOG_FORMAT="json")
    for event in ("done", "progress"):  # a report comes after what to type
        wait_for(lambda: f'"event": "{event}"' in service.err, what=event)  # noqa: B023 - it is called at once
    service.signal(signal.SIGTERM)
    assert service.wait() == 0
    lines = [json.loads(line) for line in service.err.splitlines()]
    events = [line["event"] for line in lines]
    assert set(events) <= EVENTS.keys() - {"notice"}
    assert (events[0], events.count("opened"), events[-1]) == ("router", 2, "ending")
    assert {line["source"] for line in lines if line["event"] == "opened"} == {REPLAY, "sim:?vehicle=2"}


@pytest.mark.parametrize("level", ["info", "debug"])
def test_error_of_a_command_is_an_object(run_nedbus: Start, level: str) -> None:
    """The error that ends a command is one object too, with the traceback where the level is debug."""
    ended = run_nedbus("--log-format", "json", "--log-level", level, "get", "-c", "tcp/127.0.0.1:1")
    assert ended.wait() == 1
    (fields,) = [json.loads(line) for line in ended.err.splitlines()]
    assert (fields["event"], fields["level"]) == ("error", "error")
    assert fields["message"].startswith("nothing answers at tcp/127.0.0.1:1")
    assert ("exception" in fields) == (level == "debug")


def test_level_selects(endpoint: str) -> None:
    """With --log-level warning a service says nothing while all is well; --debug wins; other words are refused."""
    quiet = run_command("--log-level", "warning", "serve", "-c", endpoint, "-s", REPLAY, "--until-done")
    assert (quiet.exit_code, quiet.err) == (0, "")
    loud = run_command("--log-level", "error", "--debug", "get", "-c", "tcp/127.0.0.1:1")
    assert (loud.exit_code, "Traceback" in loud.err, "(tried for 1 s)" in loud.err) == (1, True, True)
    wrong = run_command("list", "-c", endpoint, NEDBUS_LOG_LEVEL="loud")
    assert wrong.exit_code == 2
    assert "NEDBUS_LOG_LEVEL" in wrong.err


@pytest.mark.parametrize("other", [0, 1], ids=["journal", "another file"])
def test_journal_is_recognised(start: Start, endpoint: str, other: int) -> None:
    """Lines have priorities and no date where JOURNAL_STREAM names stderr, and only there."""
    script = """
import os, sys
from nedbus.cli import main
status = os.fstat(2)
os.environ["JOURNAL_STREAM"] = f"{status.st_dev}:{status.st_ino + int(sys.argv.pop(1))}"
main()
"""
    service = start("-c", script, str(other), "serve", "-c", endpoint, "-s", REPLAY, "--until-done")
    assert service.wait() == 0
    lines = service.err.splitlines()
    pattern = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d INFO    .*" if other else r"<6>[^\d<].*"
    assert lines
    assert all(re.fullmatch(pattern, line) for line in lines), lines


class Limited:
    """A rate limit with a clock of the test's, and what passed."""

    def __init__(self) -> None:
        self.now = 0.0
        self.lines: list[str] = []
        self.limit = RateLimit(self.handle, now=lambda: self.now)

    def handle(self, record: logging.LogRecord) -> None:
        if self.limit.filter(record):
            self.lines.append(record.getMessage())

    def flood(self, count: int, text: str = "%s is stale", *, event: str | None = "stale") -> int:
        """Log this many; return how many passed."""
        before = len(self.lines)
        for number in range(count):
            self.handle(record(text, number, event=event))
        return len(self.lines) - before


def test_flood_of_any_length_is_bounded() -> None:
    """A burst passes, then a limited number a minute, each after a line with the number left out before it."""
    limited = Limited()
    assert limited.flood(1000) == BURST
    limited.now += 60 / PER_MINUTE
    assert limited.flood(1000) == 2
    left_out = f"suppressed {1000 - BURST} more lines like this one: {BURST} is stale"
    assert limited.lines[-2:] == [left_out, "0 is stale"]
    limited.now += 3600
    assert limited.flood(1000) == 1 + BURST
    limited = Limited()
    for _ in range(600):
        limited.flood(10)
        limited.now += 1
    assert len(limited.lines) <= BURST + 2 * 10 * PER_MINUTE
    limited.limit.report()
    told = [int(line.split()[1]) for line in limited.lines if line.startswith("suppressed")]
    assert sum(told) + len(limited.lines) - len(told) == 6000


def test_kinds_are_limited_each_for_itself() -> None:
    """A flood leaves lines of other events and texts alone, and lines of the life of the process always pass."""
    limited = Limited()
    limited.flood(1000)
    assert limited.flood(3, "%s is back", event="back") == 3
    assert limited.flood(3, event="back") == 3
    own = [name for name, event in EVENTS.items() if not event.limited]
    assert {"retrying", "failed", "done", "router", "ending", "error"} <= set(own)
    for name in own:
        assert limited.flood(2 * BURST, event=name) == 2 * BURST


def test_what_a_flood_left_out_is_told_by_the_next_line() -> None:
    """When a flood has ended, the next line of any kind says what was left out of it; the end of the process, too."""
    limited = Limited()
    limited.flood(BURST + 5)
    assert limited.flood(1, "%s", event="done") == 1
    limited.now += 60
    assert limited.flood(1, "%s", event="done") == 2
    assert limited.lines[-2].startswith("suppressed 5 more lines")
    limited.limit.report()
    limited.flood(BURST + 5, "%s is back", event="back")
    limited.limit.report()
    assert limited.lines[-1].startswith("suppressed 5 more lines")


def test_lines_of_other_packages_are_limited() -> None:
    """A line without an event is limited; beyond a number of texts without placeholders all others are one kind."""
    limited = Limited()
    assert limited.flood(1000, event=None) == BURST
    assert sum(limited.flood(1, f"text {number} %s", event=None) for number in range(5000)) <= 1000 + BURST


def test_report_is_an_event() -> None:
    """A line that says what was left out has its number, the event, and the level of what it stands for."""
    reports: list[logging.LogRecord] = []
    limit = RateLimit(reports.append, now=lambda: 0.0)
    for _ in range(BURST + 3):
        limit.filter(record("\x1b[2J"))
    limit.report()
    (report,) = reports
    fields = json.loads(JsonFormatter().format(report))
    assert (fields["event"], fields["of"], fields["count"], fields["level"]) == ("left-out", "stale", 3, "warning")
    assert fields["message"].isprintable()


def count_lines(text: str, elapsed: float) -> Counter[str]:
    """Return how often each event happened, logged or left out; hold that few were logged."""
    happened: Counter[str] = Counter()
    logged: Counter[str] = Counter()
    for line in text.splitlines():
        fields = json.loads(line)
        event = str(fields["event"])
        happened[fields.get("of", event)] += fields.get("count", 1)
        logged[f"left-out {fields['of']}" if event == "left-out" else event] += 1
    due = elapsed / 60 * PER_MINUTE + 1
    for event, count in logged.items():
        # The last report is at the end of the process.
        assert count <= (due + 1 if event.startswith("left-out") else BURST + due), event
    return happened


def test_flood_of_invalid_payloads_is_bounded(run_nedbus: Start, endpoint: str, zenoh_session: Session) -> None:
    """A peer that sends nonsense under ever new keys makes a reader log a few lines, and the number of the rest."""
    start = time.monotonic()
    echo = run_nedbus("--log-format", "json", "echo", "*", "-c", endpoint, coverage=False)
    wait_for_matching(zenoh_session, f"nedbus/1/{VLP}")
    block = zenoh.CongestionControl.BLOCK
    for number in range(1000):
        zenoh_session.put(f"nedbus/flood-{number}/{VLP}", b"garbage", congestion_control=block)
    zenoh_session.put(f"nedbus/1/{VLP}", encode(message(1)), congestion_control=block)
    wait_for(lambda: echo.out, what="the last message")
    echo.signal(signal.SIGINT)
    assert echo.wait() == 130
    happened = count_lines(echo.err, time.monotonic() - start)
    assert happened["invalid"] == 100  # keys; further ones are only counted


def test_flapping_vehicles_are_bounded(start: Start, endpoint: str, zenoh_session: Session, bus: nedbus.Bus) -> None:
    """Vehicles that appear, reboot and fall silent by the hundred make a service log a few lines of each event."""
    began = time.monotonic()
    soon = Timings(stale=0.5)
    service = start_with_timings(start, soon, "--log-format", "json", "serve", "-c", endpoint, "-s", "px4-zenoh:")
    wait_for(lambda: '"listening"' in service.err, what="the source")
    fleet = [Px4(zenoh_session, namespace=f"wing{number}") for number in range(VEHICLES)]

    def status(name: str) -> object:
        (answer,) = bus.services()
        (source,) = answer.sources
        return getattr(source, name)

    for px4 in fleet:
        px4.put(2_000_000)
        px4.put(2_010_000)
        px4.reboot()
        px4.put(1_000_000)
        px4.raw(b"garbage")
    wait_for(lambda: status("reboots") == VEHICLES, what="the reboots")
    wait_for(lambda: len(cast("list[str]", status("stale"))) == VEHICLES, what="the silence")
    service.signal(signal.SIGTERM)
    assert service.wait() == 0
    happened = count_lines(service.err, time.monotonic() - began)
    assert happened["published"] == happened["rebooted"] == VEHICLES
    assert happened["stale"] >= VEHICLES
    assert happened["ending"] == 1
