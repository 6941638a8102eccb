"""`nedbus events` and `nedbus why` on files and live data, with services and scripts in other processes as peers.

The logs are small generated ULogs, and one real log of PX4 1.17.
"""

from __future__ import annotations

import csv
import io
import json
import re
import struct
import time
from pathlib import Path
from typing import Any

import pytest

import nedbus
from nedbus import Address, limits
from nedbus.flights import format_of, read_file_events
from nedbus.transport import Session
from nedbus.vehicle_events import KINDS
from tests.flights.messages import VALID, VLP, message
from tests.flights.ulogs import LOGS, UlogWriter, cached_events
from tests.peers.command_line import CommandResult, run_command
from tests.peers.ports import free_endpoint
from tests.peers.processes import Start
from tests.waits import repeating, wait_for, wait_for_matching

REAL = LOGS.parent / "px4" / "twelve_messages.ulg"
EXPECTED_EVENTS = [
    ("5.000", "WATCH", "dead reckoning"),
    ("8.000", "BAD", "xy not valid  <- dead reckoning (3.0 s before)"),
    ("8.000", "BAD", "vxy not valid  <- dead reckoning (3.0 s before)"),
    ("12.000", "", "xy valid again after 4.0 s"),
    ("12.000", "", "vxy valid again after 4.0 s"),
    ("12.000", "", "dead reckoning ended after 7.0 s"),
]
MISSING = "vehicle_gps_position, estimator_status_flags, vehicle_status, failsafe_flags"
VERDICT = f"""\
1: not usable: xy and vxy not valid from 8.000 to 12.000 s since boot (4.0 s). \
Evidence: 5.000 dead reckoning. Not in the data: {MISSING}.
"""
WHY = f"""\
{VERDICT}
1: xy and vxy not valid from 8.000 to 12.000 s since boot (4.0 s)
  evidence
    5.000  dead reckoning (3.0 s before)
  ended at 12.000 with
    12.000  dead reckoning ended after 7.0 s
  missing topics that may explain it: {MISSING}; \
PX4 1.14 and later log them by default (SDLOG_PROFILE, bit 0)
"""
AT = "14:05:12 (UTC), 123.4 (s since boot) or +12.3 (s since the start of the recording)"


def write_flight(path: Path, *, fault: bool = True) -> Path:
    """Write a log of 20 s at 10 Hz; with `fault`, 3 s of dead reckoning and then 4 s of invalid position."""
    writer = UlogWriter()
    writer.define([VLP])
    for tenth in range(10, 210):
        fields: dict[str, object] = dict(VALID)
        if fault and 50 <= tenth < 120:
            fields |= {"dead_reckoning": True, "xy_valid": tenth < 80, "v_xy_valid": tenth < 80}
        writer.add(VLP, message(tenth * 100_000, **fields))
    return writer.write(path)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Write a log with a fault."""
    return write_flight(tmp_path / "flight.ulg")


@pytest.fixture
def read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cache the parsed real log for all tests: only the output of the commands is tested."""
    target = "nedbus.flights.event_replay.read_file_events"
    monkeypatch.setattr(
        target, lambda path: (cached_events if path == REAL else read_file_events)(path)
    )


def lines_of(result: CommandResult) -> list[tuple[str, str, str]]:
    """Return time, severity and text of each line."""
    found = [
        re.fullmatch(r" *(\S+)  1 {8}(BAD|WATCH)? +(.*)", line) for line in result.out.splitlines()
    ]
    return [(match[1], match[2] or "", match[3]) for match in found if match]


def test_each_event_of_a_file_is_one_line_with_evidence(log: Path) -> None:
    """Each event is one line with its evidence, and stderr names the clock of the event times."""
    result = run_command("events", str(log))
    assert (result.exit_code, result.err) == (
        0,
        "times: seconds since boot, because no message contains UTC\n",
    )
    assert lines_of(result) == EXPECTED_EVENTS
    assert len(result.out.splitlines()) == len(EXPECTED_EVENTS)


@pytest.mark.parametrize(("severity", "count"), [("bad", 2), ("watch", 3), ("info", 6)])
def test_severity_selects_events(log: Path, severity: str, count: int) -> None:
    """--severity selects events of this severity or worse."""
    assert len(run_command("events", str(log), "--severity", severity).out.splitlines()) == count


@pytest.mark.parametrize(("origin", "count"), [("nedbus", 6), ("px4", 0), ("*", 6)])
def test_origin_selects_events(log: Path, origin: str, count: int) -> None:
    """--origin selects PX4's own texts, which this log lacks, or the events that nedbus derives."""
    assert len(run_command("events", str(log), "--origin", origin).out.splitlines()) == count


def test_json_and_csv_events_have_every_field(log: Path) -> None:
    """Both formats include every field: JSON without NaN, CSV with one cell each for evidence and numbers."""

    def refuse(constant: str) -> None:
        pytest.fail(f"{constant} is not valid JSON")

    events = [
        json.loads(line, parse_constant=refuse)
        for line in run_command("events", str(log), "--json").out.splitlines()
    ]
    assert [(each["boot"], each["text"]) for each in events] == [
        (float(at), text.partition("  <- ")[0]) for at, _, text in EXPECTED_EVENTS
    ]
    assert events[1] == {
        "time": None, "clock": "boot", "vehicle": "1", "kind": "xy_invalid", "change": "begin", "severity": "bad",
        "text": "xy not valid", "boot": 8.0, "topic": VLP, "numbers": {}, "names": ["xy_valid"], "lasted": None,
        "author": None,
        "evidence": [
            {"kind": "dead_reckoning", "change": "begin", "text": "dead reckoning", "topic": VLP, "before": 3.0}
        ],
    }  # fmt: skip
    rows = list(csv.DictReader(io.StringIO(run_command("events", str(log), "--csv").out)))
    assert [(row["boot"], row["kind"]) for row in rows] == [
        (str(each["boot"]), each["kind"]) for each in events
    ]
    assert rows[1]["evidence"] == "dead_reckoning 3.0 s"


def test_converted_log_has_the_same_events(log: Path, tmp_path: Path) -> None:
    """A log converted to MCAP yields the same events."""
    assert run_command("convert", str(log), "flight.mcap").exit_code == 0
    assert lines_of(run_command("events", "flight.mcap")) == EXPECTED_EVENTS
    advice = run_command("why", "flight.mcap", "--all").out
    assert "'nedbus record' without --topic" in advice
    assert "'nedbus convert --topics \"*\"' with the log" in advice


@pytest.mark.logs
@pytest.mark.skipif(not REAL.exists(), reason=f"no real logs: {REAL} does not exist")
@pytest.mark.long
@pytest.mark.usefixtures("read_once")
def test_real_flight_has_expected_events() -> None:
    """A log of PX4 1.17 and its MCAP conversion yield the same events, with causes."""
    assert run_command("convert", str(REAL), "flight.mcap", "--topics", "*").exit_code == 0

    def events_of(file: str) -> list[tuple[str, str, str]]:
        events = [
            json.loads(line) for line in run_command("events", file, "--json").out.splitlines()
        ]
        return sorted((each["time"], each["text"], each["topic"]) for each in events)

    events = events_of(str(REAL))
    assert len([topic for _, _, topic in events if topic != "log_message"]) == 63
    assert events_of("flight.mcap") == events
    assert (
        "23:09:04.9  1        BAD    xy not valid  <- GPS fix lost: 3D to none, satellites 10 to 0 (5.1 s before)"
        in (run_command("events", str(REAL)).out)
    )
    story = run_command("why", str(REAL), "--all").out
    fault = "xy and vxy not valid from 23:09:04.9 to 23:09:20.8 UTC (15.9 s)"
    begin = (
        f"1: not usable: {fault}. Evidence: 23:08:59.8 GPS fix lost: 3D to none, satellites 10 to 0"
    )
    assert story.startswith(begin)
    assert f"\n\n1: {fault}\n  evidence\n    23:08:59.8  GPS fix" in story
    assert "missing topics" not in story


def test_why_prints_verdict_and_faults(log: Path) -> None:
    """`why` prints the verdict; --all adds each fault with the events before it, and topics missing from the log."""
    result = run_command("why", str(log))
    assert (result.exit_code, result.out, result.err) == (
        0,
        VERDICT,
        "--all shows 1 fault in detail\n",
    )
    result = run_command("why", str(log), "--all")
    assert (result.exit_code, result.out, result.err) == (0, WHY, "")
    report = json.loads(run_command("why", str(log), "--json").out)
    verdict, (story,) = report["verdict"], report["faults"]
    assert (verdict["text"], verdict["usable"]) == (VERDICT[3:-1], False)
    assert [verdict[name]["boot"] for name in ("begin", "end")] == [8.0, 12.0]
    assert [each["kind"] for each in verdict["cause"]] == ["dead_reckoning"]
    assert (story["what"], story["lasted"]) == ("xy and vxy not valid", pytest.approx(4.0))
    assert [each["kind"] for each in story["before"]] == ["dead_reckoning"]
    assert story["lacking"][0] == "vehicle_gps_position"


def test_why_prints_a_long_reason_in_full(tmp_path: Path) -> None:
    """A long reason is in the verdict as a whole, and leaves room for less else."""
    writer = UlogWriter()
    writer.define([VLP])
    for timestamp in range(100_000, 2_100_000, 100_000):
        writer.add(VLP, message(timestamp), xy_valid=True, dist_bottom_valid=True)
    [verdict] = run_command("why", str(writer.write(tmp_path / "a.ulg"))).out.splitlines()
    assert verdict.startswith(f"1: {VLP} rejected: x: must be finite while xy_valid is true")
    assert (
        "; dist_bottom: must be finite while dist_bottom_valid is true (is nan) from +0.000 to +1.900 s"
        in verdict
    )


def test_why_at_accepts_seconds_without_utc(log: Path) -> None:
    """Without UTC in the log, --at accepts seconds since boot or since the start of the recording."""
    for moment in ("10", "+9"):
        assert run_command("why", str(log), "--at", moment, "--all").out == WHY
    result = run_command("why", str(log), "--at", "6.5").out
    assert result.startswith(
        "1: position valid throughout, but dead reckoning from 5.000 to 12.000 s since boot (7.0 s)."
    )
    result = run_command("why", str(log), "--at", "19").out
    assert result.startswith(
        "1: no fault at that time; nearest: xy and vxy not valid from 8.000 to 12.000 s"
    )


@pytest.mark.long
@pytest.mark.logs
@pytest.mark.skipif(not REAL.exists(), reason=f"no real logs: {REAL} does not exist")
@pytest.mark.usefixtures("read_once")
def test_why_at_accepts_utc_and_seconds() -> None:
    """`why --at` prints the same for a UTC time and for the same time in seconds since boot or since the start."""
    by_utc = run_command("why", str(REAL), "--at", "23:09:00").out
    assert (
        "GPS fix lost: 3D to none, satellites 10 to 0 from 23:08:59.8 to 23:09:19.6 UTC (19.8 s)."
        in by_utc
    )
    for moment in ("27.557", "+27.325"):
        assert run_command("why", str(REAL), "--at", moment).out == by_utc


def test_flight_without_faults_reports_its_duration(tmp_path: Path) -> None:
    """Without faults both commands report the duration of the flight."""
    log = str(write_flight(tmp_path / "good.ulg", fault=False))
    result = run_command("events", log)
    assert (result.exit_code, result.out) == (0, "")
    assert result.err == f"{log}: no events in 20 s\n"
    assert (
        run_command("events", log, "--severity", "bad").err
        == f"{log}: no events of severity bad in 20 s\n"
    )
    result = run_command("why", log)
    assert (result.exit_code, result.out, result.err) == (0, f"1: no faults in 20 s; {USUAL}\n", "")


def test_estimate_that_was_never_valid_is_reported(tmp_path: Path) -> None:
    """An estimate that is invalid throughout causes no event, so stderr and the verdict report it."""
    writer = UlogWriter()
    writer.define([VLP])
    for tenth in range(1, 50):
        writer.add(VLP, message(tenth * 100_000, **VALID | {"xy_valid": False}))
    log = str(writer.write(tmp_path / "never.ulg"))
    assert run_command("events", log).err == "1: xy not valid, throughout the file\n"
    begin = "1: not usable: xy not valid from the first message until the end (4.8 s)."
    assert run_command("why", log).out.startswith(begin)


@pytest.mark.long
def test_events_of_a_file_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Above the limit only the most recent events are shown, and stderr states the total."""
    monkeypatch.setattr(limits, "FILE_EVENTS", 2000)
    writer = UlogWriter()
    writer.define([VLP])
    for second in range(2200):
        writer.add(
            VLP, message((second + 1) * 1_000_000, **VALID | {"xy_reset_counter": second % 256})
        )
    log = str(writer.write(tmp_path / "long.ulg"))
    result = run_command("events", log)
    assert len(result.out.splitlines()) == 2000
    assert f"{log}: showing the last 2000 of 2199 events\n" in result.err


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (("events", "LOG", "--vehicle", "7"), 2, "nedbus: --vehicle: no vehicle 7 in LOG: choose one of 1\n"),
        (("why", "LOG", "--vehicle", "7"), 2, "nedbus: --vehicle: no vehicle 7 in LOG: choose one of 1\n"),
        (("why", "LOG", "--at", "noon"), 2, "nedbus: --at: 'noon': not a time: EXPECTED\n"),
        (("why", "LOG", "--at", "nan"), 2, "nedbus: --at: 'nan': not a time: EXPECTED\n"),
        (("why", "LOG", "--at", "25:00"), 2, "nedbus: --at: '25:00': not a time: EXPECTED\n"),
        (("why", "LOG", "--at", "12:00"), 2, "nedbus: --at: '12:00': no message of this vehicle has UTC: EXPECTED\n"),
        (("events", "LOG", "--severity", "dire"), 2, "nedbus: --severity: 'dire': expected bad or watch or info\n"),
        (("events", "LOG", "--origin", "gcs"), 2, "nedbus: --origin: 'gcs': expected px4 or nedbus or *\n"),
        (("events", "LOG", "--within", "60"), 2, "nedbus: --within: needs live vehicles, not a file\n"),
        (("events", "LOG", "--duration", "60"), 2, "nedbus: --duration: needs live vehicles, not a file\n"),
        (("events", "LOG", "--json", "--csv"), 2, "nedbus: --csv: cannot be combined with --json: remove"),
        (("events", "note.txt"), 2, "nedbus: note.txt: not a flight file; its name must end with .ulg or"),
        (("why", "gone.ulg"), 1, "nedbus: CWD/gone.ulg: no such file or directory\n"),
        (("why", "a/b", "--vehicle", "a b"), 2, "nedbus: "),
        (("why", "not.ulg"), 1, "nedbus: not.ulg: not a readable ULog file (it does not begin with ULog's magic"),
    ],
)  # fmt: skip
def test_error_is_one_line(
    log: Path, tmp_path: Path, arguments: tuple[str, ...], code: int, text: str
) -> None:
    """An error is one line with a remedy; the exit code is 2 for wrong usage and 1 for a failure."""
    (tmp_path / "note.txt").write_text("no log")
    (tmp_path / "not.ulg").write_text("no log")
    result = run_command(*(str(log) if each == "LOG" else each for each in arguments))
    text = (
        text.replace("LOG", str(log))
        .replace("EXPECTED", f"expected {AT}")
        .replace("CWD", str(Path.cwd()))
    )
    assert result.err.startswith(text)
    assert (result.exit_code, result.out) == (code, "")
    assert len(result.err.splitlines()) == 1


@pytest.mark.slow
def test_why_without_router_or_service_fails(endpoint: str) -> None:
    """Without a router, or without a service with a history, `why` names what is missing."""
    closed = free_endpoint()
    result = run_command("why", "-c", closed)
    assert result.exit_code == 1
    assert len(result.err.splitlines()) == 1
    result = run_command("why", "-c", endpoint)
    assert (result.exit_code, result.err) == (
        1, f"nedbus: no nedbus service at {endpoint} has data on any vehicle: start a source with 'nedbus serve'\n"
    )  # fmt: skip


def start_service(run_nedbus: Start, bus: nedbus.Bus, endpoint: str, *sources: str) -> None:
    """Start a service in another process, and wait until all replays have ended."""
    options = [part for source in sources for part in ("-s", source)]
    run_nedbus("serve", "-c", endpoint, *options)
    wait_for(
        lambda: sum(len(each.vehicles) for each in bus.accounts()) == len(sources),
        what="the vehicles",
    )

    def has_ended() -> bool:
        states = [source.state for service in bus.services() for source in service.sources]
        return states == ["done"] * len(sources)

    wait_for(has_ended, what="the end of the flights")


@pytest.mark.slow
def test_why_live_uses_service_history(
    run_nedbus: Start, bus: nedbus.Bus, endpoint: str, log: Path, tmp_path: Path
) -> None:
    """`why` uses the history of services, for all vehicles or for one. A vehicle published by a script has none."""
    good = write_flight(tmp_path / "good.ulg", fault=False)
    start_service(
        run_nedbus, bus, endpoint, f"ulog:{log}?speed=20", f"ulog:{good}?vehicle=2&speed=20"
    )
    result = run_command("why", "-c", endpoint)
    assert (result.exit_code, result.err) == (0, "--all shows 1 fault in detail\n")
    assert result.out.startswith("1: was not usable: xy and vxy not valid from ")
    sound = rf"2: no faults since \d\d:\d\d:\d\d\.\d UTC \([^)]+\); {USUAL}\n"
    assert re.search(f"\n{sound}$", result.out)
    bus.publisher(VLP, vehicle="mocap1").publish(message(1))
    result = run_command("why", "-c", endpoint, "-v", "mocap1")
    reason = "vehicle mocap1 is published, but no nedbus service keeps its event history"
    hint = "follow it with 'nedbus events --vehicle mocap1'"
    assert (result.exit_code, result.err) == (1, f"nedbus: {reason}: {hint}\n")
    assert re.fullmatch(sound, run_command("why", "-c", endpoint, "-v", "2").out)
    result = run_command("why", "-c", endpoint, "-v", "1", "--all")
    clock = r"\d\d:\d\d:\d\d\.\d"
    fault = rf"xy and vxy not valid from {clock} to {clock} UTC \(\d+ ms\)"
    begin = rf"1: was not usable: {fault}\. Evidence: {clock} dead reckoning\. Not in .*"
    assert re.match(rf"{begin}\n\n1: {fault}\n  evidence\n", result.out)
    assert "to publish them, add them to PX4's dds_topics.yaml" in result.out
    # end of the fault
    since_boot = run_command("why", "-c", endpoint, "-v", "1", "--all", "--at", "12")
    assert since_boot.out.startswith("1: not usable: xy and vxy not valid")
    assert set(result.out.partition("\n\n")[2].splitlines()) <= set(since_boot.out.splitlines())
    refused = run_command("why", "-c", endpoint, "-v", "1", "--at", "+3")
    assert (refused.exit_code, "--at: '+3': live data has no start" in refused.err) == (2, True)
    at = re.search(r"\d\d:\d\d:\d\d\.\d", result.out)
    assert at
    assert run_command("why", "-c", endpoint, "-v", "1", "--at", at[0]).out.startswith("1: ")
    result = run_command("why", "-c", endpoint, "-v", "7")
    assert (result.exit_code, result.err) == (
        2,
        "nedbus: --vehicle: no vehicle 7 in the history of the services: choose one of 1, 2\n",
    )


@pytest.mark.slow
def test_why_live_reports_initial_faults(
    run_nedbus: Start, bus: nedbus.Bus, endpoint: str, tmp_path: Path
) -> None:
    """A vehicle whose position has been invalid since the service started is reported as not usable."""
    writer = UlogWriter()
    writer.define([VLP])
    for tenth in range(1, 50):
        writer.add(VLP, message(tenth * 100_000, **VALID | {"xy_valid": False}))
    log = writer.write(tmp_path / "never.ulg")
    start_service(run_nedbus, bus, endpoint, f"ulog:{log}?speed=20")
    begin = "1: not usable: xy not valid from the first message until now ("
    assert run_command("why", "-c", endpoint).out.startswith(begin)


@pytest.mark.slow
def test_events_within_shows_the_history(
    run_nedbus: Start, bus: nedbus.Bus, endpoint: str, log: Path
) -> None:
    """--within first shows past events from the history of a service."""
    start_service(run_nedbus, bus, endpoint, f"ulog:{log}?speed=20")
    follower = run_nedbus("events", "-c", endpoint, "--within", "600", "--json", "-v", "1")
    wait_for(lambda: len(follower.out.splitlines()) == len(EXPECTED_EVENTS), what="the history")
    events: list[dict[str, Any]] = [json.loads(line) for line in follower.out.splitlines()]
    assert [each["text"].partition(" after")[0] for each in events] == [
        text.partition("  <- ")[0].partition(" after")[0] for _, _, text in EXPECTED_EVENTS
    ]
    assert {each["clock"] for each in events} == {"host"}
    assert [each["kind"] for each in events[1]["evidence"]] == ["dead_reckoning"]


@pytest.mark.slow
def test_history_contains_px4_texts(
    run_nedbus: Start, bus: nedbus.Bus, endpoint: str, tmp_path: Path
) -> None:
    """A service keeps PX4's own texts, and `events --within` and `why` show them as they do for a file."""
    writer = UlogWriter()
    writer.define([VLP])
    for tenth in range(10, 60):
        if tenth == 40:
            for words in (b"[ekf2] reset", b"[failsafe] Failsafe activated"):
                writer.put("L", b"4" + struct.pack("<Q", tenth * 100_000) + words)
        writer.add(VLP, message(tenth * 100_000, **VALID | {"xy_valid": tenth < 41}))
    log = writer.write(tmp_path / "texts.ulg")
    start_service(run_nedbus, bus, endpoint, f"ulog:{log}?speed=20")
    follower = run_nedbus("events", "-c", endpoint, "--within", "600", "--origin", "px4")
    wait_for(lambda: len(follower.out.splitlines()) == 2, what="the texts")
    for result in (follower.out, run_command("events", str(log), "--origin", "px4").out):
        first, second = result.splitlines()
        assert first.endswith('1        WATCH  PX4: "[ekf2] reset"')
        assert second.endswith('PX4: "[failsafe] Failsafe activated"')
    for result in (run_command("why", "-c", endpoint).out, run_command("why", str(log)).out):
        # without the names of PX4's modules; a busy service may receive the second text later
        assert re.search(r'PX4: "reset"(, |; \S+ )PX4: "Failsafe activated"', result)


@pytest.mark.long
def test_events_live_are_printed_as_they_happen(
    run_nedbus: Start, bus: nedbus.Bus, zenoh_session: Session, endpoint: str
) -> None:
    """Events of a script's vehicle are printed as they happen; stderr names conditions that are active at the start."""
    fields: dict[str, object] = VALID | {"z_valid": False}
    with bus.publisher(VLP, vehicle="7") as publisher:

        def publish() -> None:
            publisher.publish(message(time.monotonic_ns() // 1000, **fields))

        publish()
        follower = run_nedbus("events", "-c", endpoint)
        wait_for_matching(zenoh_session, "nedbus/7/vehicle_local_position")
        with repeating(publish):
            wait_for(
                lambda: "7: z not valid, from the start\n" in follower.err,
                what="the initial condition",
            )
            assert follower.out == ""
            fields["xy_valid"] = False
            wait_for(lambda: "xy not valid" in follower.out, what="the event")
            fields["xy_valid"] = True
            wait_for(lambda: "xy valid again after" in follower.out, what="its end")
        wait_for(lambda: "silent: no vehicle_local_position for" in follower.out, what="silence")
    wait_for(
        lambda: "gone: no publisher of vehicle_local_position" in follower.out,
        what="the end of the publisher",
    )
    assert follower.err.count("z not valid, from the start") == 1
    lines = [line.split(None, 2)[1:] for line in follower.out.splitlines()]
    assert [line[0] for line in lines] == ["7"] * len(lines)
    assert lines[0][1].startswith("BAD    xy not valid")


@pytest.mark.slow
def test_events_live_filter_by_vehicle_and_severity(
    run_nedbus: Start, bus: nedbus.Bus, zenoh_session: Session, endpoint: str
) -> None:
    """--vehicle hides other vehicles, and --severity hides less severe events."""
    fields: dict[str, object] = dict(VALID)
    with bus.publisher(VLP, vehicle="7") as seven, bus.publisher(VLP, vehicle="8") as eight:

        def publish() -> None:
            for publisher in (seven, eight):
                publisher.publish(message(time.monotonic_ns() // 1000, **fields))

        follower = run_nedbus("events", "-c", endpoint, "--vehicle", "8", "--severity", "bad")
        wait_for_matching(zenoh_session, "nedbus/8/vehicle_local_position")
        with repeating(publish):
            subscription = bus.subscribe(VLP, vehicle="8")
            subscription.receive(30)
            wait_for(
                lambda: (
                    Address("8", VLP) in {each for all_ in bus.vehicles().values() for each in all_}
                ),
                what="8",
            )
            for _ in range(2):
                fields["xy_valid"] = False
                wait_for(lambda: follower.out.count("xy not valid") > 0, what="the event")
                fields["xy_valid"] = True
            subscription.close()
        assert "valid again" not in follower.out
        assert {line.split()[1] for line in follower.out.splitlines()} == {"8"}


USUAL = "throughout: xy has no global reference, z has no global reference"
PAGE = Path(__file__).parents[4] / "docs" / "events.md"
BASH = re.findall(r"```bash\n(.*?)```", PAGE.read_text(), re.DOTALL)[0]
DOCUMENTED = re.findall(r"^nedbus ([^#\n]+?) *(?:#.*)?$", BASH, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize("command", DOCUMENTED)
def test_documented_command_works(
    command: str, run_nedbus: Start, bus: nedbus.Bus, endpoint: str, log: Path
) -> None:
    """Each command of docs/events.md works, on a file or on a live vehicle."""
    assert log.name == "flight.ulg"
    arguments = [str(log) if part == log.name else part for part in command.split()]
    if "flight.ulg" in command:
        result = run_command(*arguments)
        assert result.exit_code == 0
        assert "xy" in result.out or "--at" in command
        return
    run_nedbus("serve", "-c", endpoint, "-s", "sim:?vehicle=7")
    wait_for(lambda: [each for each in bus.accounts() if "7" in each.vehicles], what="the vehicle")
    if "health" in command:
        result = run_command(*arguments, "-c", endpoint)
        assert (result.exit_code, result.err) == (
            1, "".join(f"nedbus: vehicle {name} is missing: it has no publisher; published: 7\n" for name in (1, 2))
        )  # fmt: skip
    else:
        result = run_command(
            *arguments, "-c", endpoint, *(("--duration", "1") if "events" in command else ())
        )
        assert (result.exit_code, result.err) == (
            0,
            "times: UTC, from the clocks of the hosts\n" * ("events" in command),
        )


def test_every_event_kind_is_documented() -> None:
    """The table of docs/events.md lists exactly the existing kinds of events."""
    rows = re.findall(r"^\| (`.*?) \| .*(?:bad|watch|info)", PAGE.read_text(), re.MULTILINE)
    kinds = [kind for row in rows for kind in re.findall(r"`(\w+)`", row)]
    assert sorted(kinds) == sorted(KINDS)


@pytest.mark.slow
def test_file_suffix_is_case_insensitive(log: Path, tmp_path: Path) -> None:
    """Every command accepts uppercase suffixes: FLIGHT.ULG, as on a FAT-formatted SD card, and FLIGHT.MCAP."""
    flight, converted = tmp_path / "FLIGHT.ULG", tmp_path / "FLIGHT.MCAP"
    flight.write_bytes(log.read_bytes())
    for arguments in (
        ["convert", flight, converted],
        ["plot", flight, "-o", tmp_path / "A.PNG"],
        ["plot", converted],
    ):
        result = run_command(*map(str, arguments))
        assert result.exit_code == 0, result.err
    for path in (flight, converted):
        assert run_command("events", str(path)).out == run_command("events", str(log)).out
        assert run_command("why", str(path)).exit_code == 0
        assert nedbus.addresses_of(path) == nedbus.addresses_of(log)
        assert format_of(path) in ("ulog", "mcap")
