"""The log: JSON for programs, priorities for the journal, levels, a closed list of events, and rate limits."""

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

import pytest
import zenoh

import nedbus
from nedbus.cli.output.logs import (
    BURST,
    PER_MINUTE,
    JournalFormatter,
    JsonFormatter,
    RateLimit,
    TextFormatter,
)
from nedbus.client import SourceStatus
from nedbus.log_event import EVENTS, about
from nedbus.timings import Timings
from nedbus.transport import Session
from nedbus_msgs import Address
from tests.flights.local_position import encode
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


def record(
    text: str = "%s is stale", *args: object, event: str | None = "stale", **more: object
) -> logging.LogRecord:
    """Return a log record as a log call in a service creates it."""
    warning = {
        "name": "nedbus.x",
        "levelname": "WARNING",
        "levelno": logging.WARNING,
        "msg": text,
        "args": args,
    }
    return logging.makeLogRecord(warning | (about(event) if event else {}) | more)


def log_calls(tree: ast.AST) -> Iterator[ast.Call]:
    """Yield the log calls above level DEBUG."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            logger, level = node.func.value, node.func.attr
            name = logger.id if isinstance(logger, ast.Name) else ""
            if name == "_log" and level in {
                "info",
                "warning",
                "error",
                "exception",
                "critical",
                "log",
            }:
                yield node


def is_about(node: ast.expr | None) -> bool:
    return (
        isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "about"
    )


def values_of(node: ast.expr, tree: ast.AST) -> Iterator[ast.expr]:
    """Yield the possible values of an expression: itself, both branches of a condition, or assignments to its name."""
    if isinstance(node, ast.IfExp):
        yield from values_of(node.body, tree)
        yield from values_of(node.orelse, tree)
    elif isinstance(node, ast.Name):
        for other in ast.walk(tree):
            targets = other.targets if isinstance(other, ast.Assign) else []
            if isinstance(other, ast.Assign) and node.id in [
                getattr(target, "id", None) for target in targets
            ]:
                yield from values_of(other.value, tree)
    else:
        yield node


def events_of(call: ast.Call, tree: ast.AST) -> set[str]:
    """Return the events that a log call may emit."""
    extras = [
        value
        for each in call.keywords
        if each.arg == "extra"
        for value in values_of(each.value, tree)
    ]
    assert extras, f"line {call.lineno} has no event: extra=about(...)"
    assert all(is_about(each) for each in extras), f"line {call.lineno}: extra is not about(...)"
    events = [
        value
        for each in extras
        if isinstance(each, ast.Call)
        for value in values_of(each.args[0], tree)
    ]
    return {
        str(each.value) if isinstance(each, ast.Constant) else ast.unparse(each) for each in events
    }


@pytest.mark.slow
def test_log_calls_use_exactly_the_documented_events() -> None:
    """Every log call above DEBUG uses an event from the table EVENTS, and every event in the table is used."""
    used: set[str] = set()
    for path, text in ((path, path.read_text()) for path in sorted(SERVICE.rglob("*.py"))):
        tree = ast.parse(text if "_log." in text else "")
        for call in log_calls(tree):
            events = events_of(call, tree)
            assert events <= EVENTS.keys(), f"{path}, line {call.lineno}"
            used |= events
    assert used == EVENTS.keys() - {"suppressed"}


def test_documented_log_limits_match_the_code() -> None:
    """docs/operate.md states the rate limits of the code, and every event it names exists."""
    section = (ROOT / "docs" / "operate.md").read_text().partition("\n## Logs\n")[2]
    named = re.findall(r"^\| ((?:`[a-z_]+`(?:, )?)+) \| [a-z ]", section, re.MULTILINE)
    events = {each for names in named for each in re.findall(r"`([a-z_]+)`", names)} & EVENTS.keys()
    assert {"error", "rejected", "access_denied"} <= events
    assert f"{BURST} lines" in section
    assert f"{PER_MINUTE} per minute" in section


def test_json_line_escapes_text_of_peers() -> None:
    """A line is one JSON object in printable ASCII, whatever a peer sent; only the event can be null."""
    address = Address("7", "estimator_local_position", 2)
    extra = about("rejected", address, source=EVIL, reason=EVIL * 1000)
    line = JsonFormatter().format(
        record("%s: rejected", EVIL * 1000, about=extra["about"], created=1.5)
    )
    assert line.isascii()
    assert line.isprintable()
    assert len(line) < 20_000
    fields = json.loads(line)
    names = ["time", "level", "event", "message", "logger"]
    assert list(fields) == [*names, "vehicle", "topic", "instance", "source", "reason"]
    assert (fields["time"], fields["level"]) == ("1970-01-01T00:00:01.500Z", "warning")
    assert (fields["vehicle"], fields["topic"], fields["instance"]) == (
        "7",
        "estimator_local_position",
        2,
    )
    assert all(text.isprintable() for text in fields.values() if isinstance(text, str))
    fields = json.loads(JsonFormatter().format(record("plain", event=None)))
    assert list(fields) == names
    assert fields["event"] is None


def test_json_traceback_is_one_string() -> None:
    """A traceback in JSON is one string; a long traceback keeps its end, which names the error."""
    try:
        raise ValueError("x" * 100_000 + EVIL + "the end")
    except ValueError:
        line = JsonFormatter().format(record(exc_info=sys.exc_info()))
    exception = json.loads(line)["exception"]
    assert exception.endswith("the end")
    assert exception.replace("\n", "").isprintable()
    assert len(exception) < 30_000


def test_journal_lines_have_syslog_priorities() -> None:
    """Each line, including those of a traceback, has a syslog priority, from 3 for errors to 7 for debug."""
    formatter = JournalFormatter(TextFormatter("%(message)s"))
    assert formatter.format(record("%s\nforged", "x")) == "<4>x\\nforged"
    for level, number in (
        (logging.DEBUG, 7),
        (logging.INFO, 6),
        (logging.ERROR, 3),
        (logging.CRITICAL, 3),
    ):
        assert formatter.format(record("text", levelno=level)) == f"<{number}>text"
    try:
        raise ValueError("two\nlines")
    except ValueError:
        lines = formatter.format(record(exc_info=sys.exc_info())).split("\n")
    assert len(lines) >= 5
    assert all(line.startswith("<4>") for line in lines)


@pytest.mark.slow
def test_service_logs_json(start: Start) -> None:
    """Each line of a service is a JSON object with an event, and with the source if a source logged it.

    Notices to the user are objects as well; the suggested commands are omitted.
    """
    sources = ("-s", REPLAY, "-s", "sim:?vehicle=2")
    soon = Timings(reports=(0.2,))
    service = start_with_timings(
        start, soon, "serve", "-l", "tcp/127.0.0.1:0", *sources, NEDBUS_LOG_FORMAT="json"
    )
    for event in ("done", "progress"):  # the first report follows the suggested commands
        wait_for(lambda: f'"event": "{event}"' in service.err, what=event)  # noqa: B023 - called at once
    service.signal(signal.SIGTERM)
    assert service.wait() == 0
    lines = [json.loads(line) for line in service.err.splitlines()]
    events = [line["event"] for line in lines]
    assert set(events) <= EVENTS.keys() - {"notice"}
    assert (events[0], events.count("replay_opened"), events[-1]) == ("router", 2, "shutdown")
    assert {line["source"] for line in lines if line["event"] == "replay_opened"} == {
        REPLAY,
        "sim:?vehicle=2",
    }


@pytest.mark.slow
@pytest.mark.parametrize("level", ["info", "debug"])
def test_error_of_a_command_is_a_json_object(run_nedbus: Start, level: str) -> None:
    """The error that ends a command is one JSON object, with a traceback at level debug."""
    ended = run_nedbus("--log-format", "json", "--log-level", level, "get", "-c", "tcp/127.0.0.1:1")
    assert ended.wait() == 1
    (fields,) = [json.loads(line) for line in ended.err.splitlines()]
    assert (fields["event"], fields["level"]) == ("error", "error")
    assert fields["message"].startswith("nothing answers at tcp/127.0.0.1:1")
    assert ("exception" in fields) == (level == "debug")


@pytest.mark.slow
def test_log_level_selects_lines(endpoint: str) -> None:
    """--log-level warning hides lines of normal operation; --debug overrides it; an unknown level is a usage error."""
    quiet = run_command(
        "--log-level", "warning", "serve", "-c", endpoint, "-s", REPLAY, "--until-done"
    )
    assert (quiet.exit_code, quiet.err) == (0, "")
    loud = run_command("--log-level", "error", "--debug", "get", "-c", "tcp/127.0.0.1:1")
    assert (loud.exit_code, "Traceback" in loud.err, "(tried for 1 s)" in loud.err) == (
        1,
        True,
        True,
    )
    wrong = run_command("list", "-c", endpoint, NEDBUS_LOG_LEVEL="loud")
    assert wrong.exit_code == 2
    assert "NEDBUS_LOG_LEVEL" in wrong.err


@pytest.mark.slow
@pytest.mark.parametrize("other", [0, 1], ids=["journal", "another file"])
def test_journal_is_detected(start: Start, endpoint: str, other: int) -> None:
    """Lines have priorities instead of dates only if JOURNAL_STREAM identifies stderr."""
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
    """A rate limit with a fake clock, and the lines that passed it."""

    def __init__(self) -> None:
        self.now = 0.0
        self.lines: list[str] = []
        self.limit = RateLimit(self.handle, now=lambda: self.now)

    def handle(self, record: logging.LogRecord) -> None:
        if self.limit.filter(record):
            self.lines.append(record.getMessage())

    def flood(self, count: int, text: str = "%s is stale", *, event: str | None = "stale") -> int:
        """Log `count` lines; return the number that passed."""
        before = len(self.lines)
        for number in range(count):
            self.handle(record(text, number, event=event))
        return len(self.lines) - before


def test_flood_of_log_lines_is_rate_limited() -> None:
    """A burst passes, then a few lines a minute, each preceded by the number of suppressed lines."""
    limited = Limited()
    assert limited.flood(1000) == BURST
    limited.now += 60 / PER_MINUTE
    assert limited.flood(1000) == 2
    report = f"suppressed {1000 - BURST} more lines like this one: {BURST} is stale"
    assert limited.lines[-2:] == [report, "0 is stale"]
    limited.now += 3600
    assert limited.flood(1000) == 1 + BURST
    limited = Limited()
    for _ in range(600):
        limited.flood(10)
        limited.now += 1
    assert len(limited.lines) <= BURST + 2 * 10 * PER_MINUTE
    limited.limit.report()
    counts = [int(line.split()[1]) for line in limited.lines if line.startswith("suppressed")]
    assert sum(counts) + len(limited.lines) - len(counts) == 6000


def test_each_kind_of_log_line_has_its_own_rate_limit() -> None:
    """A flood does not suppress lines with other events or texts, and lifecycle events are never limited."""
    limited = Limited()
    limited.flood(1000)
    assert limited.flood(3, "%s is back", event="stream_resumed") == 3
    assert limited.flood(3, event="stream_resumed") == 3
    unlimited = [name for name, event in EVENTS.items() if not event.limited]
    assert {"retrying", "failed", "done", "router", "shutdown", "error"} <= set(unlimited)
    for name in unlimited:
        assert limited.flood(2 * BURST, event=name) == 2 * BURST


def test_suppressed_lines_are_reported_after_a_flood() -> None:
    """Suppressed lines are reported with the next line of any kind, and at exit."""
    limited = Limited()
    limited.flood(BURST + 5)
    assert limited.flood(1, "%s", event="done") == 1
    limited.now += 60
    assert limited.flood(1, "%s", event="done") == 2
    assert limited.lines[-2].startswith("suppressed 5 more lines")
    limited.limit.report()
    limited.flood(BURST + 5, "%s is back", event="stream_resumed")
    limited.limit.report()
    assert limited.lines[-1].startswith("suppressed 5 more lines")


@pytest.mark.slow
def test_log_lines_of_other_packages_are_rate_limited() -> None:
    """Lines without an event are limited per text; beyond the maximum number of texts, all others share one limit."""
    limited = Limited()
    assert limited.flood(1000, event=None) == BURST
    assert (
        sum(limited.flood(1, f"text {number} %s", event=None) for number in range(5000))
        <= 1000 + BURST
    )


def test_report_of_suppressed_lines_is_an_event() -> None:
    """A report of suppressed lines states their number, event and level."""
    reports: list[logging.LogRecord] = []
    limit = RateLimit(reports.append, now=lambda: 0.0)
    for _ in range(BURST + 3):
        limit.filter(record("\x1b[2J"))
    limit.report()
    (report,) = reports
    fields = json.loads(JsonFormatter().format(report))
    assert (fields["event"], fields["of"], fields["count"], fields["level"]) == (
        "suppressed",
        "stale",
        3,
        "warning",
    )
    assert fields["message"].isprintable()


def count_lines(text: str, elapsed: float) -> Counter[str]:
    """Return the number of lines of each event, logged or suppressed; assert that few were logged."""
    total: Counter[str] = Counter()
    logged: Counter[str] = Counter()
    for line in text.splitlines():
        fields = json.loads(line)
        event = str(fields["event"])
        total[fields.get("of", event)] += fields.get("count", 1)
        logged[f"suppressed {fields['of']}" if event == "suppressed" else event] += 1
    due = elapsed / 60 * PER_MINUTE + 1
    for event, count in logged.items():
        # One more report is logged at exit.
        assert count <= (due + 1 if event.startswith("suppressed") else BURST + due), event
    return total


@pytest.mark.slow
def test_flood_of_invalid_payloads_is_rate_limited(
    run_nedbus: Start, endpoint: str, zenoh_session: Session
) -> None:
    """A flood of invalid payloads with changing keys makes a subscriber log only a few lines and a count."""
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
    total = count_lines(echo.err, time.monotonic() - start)
    assert total["invalid"] == 100  # limit of logged keys; further keys are only counted


@pytest.mark.slow
def test_log_of_flapping_vehicles_is_rate_limited(
    start: Start, endpoint: str, zenoh_session: Session, bus: nedbus.Bus
) -> None:
    """A hundred vehicles that appear, reboot and fall silent make a service log only a few lines of each event."""
    began = time.monotonic()
    soon = Timings(stale=0.5)
    service = start_with_timings(
        start, soon, "--log-format", "json", "serve", "-c", endpoint, "-s", "px4-zenoh:"
    )
    wait_for(lambda: '"listening"' in service.err, what="the source")
    fleet = [Px4(zenoh_session, namespace=f"wing{number}") for number in range(VEHICLES)]

    def sources() -> list[SourceStatus]:  # of the service, for each vehicle
        return [source for answer in bus.services() for source in answer.sources]

    for px4 in fleet:
        px4.put(2_000_000)
        px4.put(2_010_000)
        px4.reboot()
        px4.put(1_000_000)
        px4.raw(b"garbage")
    wait_for(
        lambda: max((each.reboots for each in sources()), default=0) == VEHICLES, what="the reboots"
    )
    wait_for(
        lambda: len({stale for each in sources() for stale in each.stale}) == VEHICLES,
        what="the silence",
    )
    service.signal(signal.SIGTERM)
    assert service.wait() == 0
    total = count_lines(service.err, time.monotonic() - began)
    assert total["published"] == total["rebooted"] == VEHICLES
    assert total["stale"] >= VEHICLES
    assert total["shutdown"] == 1
