"""Several files at once: logs of a swarm aligned in UTC, each vehicle with a unique name."""

from __future__ import annotations

import json
import math
import re
import struct
from pathlib import Path

import numpy as np
import pytest

import nedbus
from nedbus.errors import SourceError
from nedbus.flights import read_file_events
from nedbus.tables import array_of, read_plotted
from nedbus.web.playback import Recording
from nedbus_msgs import Selection
from tests.flights.messages import VALID, VLP, message
from tests.flights.ulogs import LOGS, UlogWriter
from tests.peers.command_line import run_command
from tests.waits import wait_for

EPOCH = 1_760_000_000_000_000  # us; 2025-10-09 08:53:20 UTC
OTHER = "estimator_local_position"
CASES = Path(__file__).parents[4] / "shared/cases"


def write_flight(
    path: Path, *, boot: float, start: float, seconds: float = 10, utc: bool = True, bad: float = 99
) -> Path:
    """Write a log of vehicle 1; `boot`, `start`: seconds after EPOCH; `bad`: seconds after which xy is invalid."""
    writer = UlogWriter()
    if utc:
        key = b"uint64_t boot_time_utc_us"
        writer.put("I", bytes([len(key)]) + key + struct.pack("<Q", EPOCH + round(boot * 1e6)))
    writer.define([VLP, OTHER])
    for tenth in range(round(seconds * 10)):
        fields = VALID | {
            "x": float(tenth),
            "xy_valid": tenth < bad * 10,
            "v_xy_valid": tenth < bad * 10,
        }
        for topic in (VLP, OTHER):
            writer.add(topic, message(round((start - boot) * 1e6) + tenth * 100_000, **fields))
    return writer.write(path)


@pytest.fixture
def swarm(tmp_path: Path) -> list[str]:
    """Write three concurrent logs with different boots; the second has a fault, and the third ends earlier."""
    return [
        str(write_flight(tmp_path / "a 1.ulg", boot=0, start=60)),
        str(write_flight(tmp_path / "b.ulg", boot=30, start=60, bad=5)),
        str(write_flight(tmp_path / "c.ulg", boot=45, start=58, seconds=4)),
    ]


def test_events_of_several_files_share_utc(swarm: list[str]) -> None:
    """Events have UTC and unique vehicle names; a vehicle whose file ends first does not count as silent."""
    shown = run_command("events", "--json", *swarm)
    assert shown.exit_code == 0, shown.err
    for path, name in zip(swarm, ("a_1", "b", "c"), strict=True):
        assert (
            f"{path}: vehicle 1 is named {name} here, because several files have a vehicle 1"
            in shown.err.splitlines()
        )
    found = [json.loads(line) for line in shown.out.splitlines()]
    assert {(each["vehicle"], each["time"]) for each in found} == {
        ("b", "2025-10-09T08:54:25.000+00:00")
    }
    assert run_command("events", "-v", "a_1", *swarm).out == ""
    why = run_command("why", "-v", "b", "--at", "08:54:26", *swarm)
    assert "b: not usable: xy and vxy not valid from 08:54:25.0" in why.out, why.err


def test_verdict_refers_to_the_file_of_its_vehicle(tmp_path: Path) -> None:
    """Of two flights an hour apart, each lasts as long as its own file, and so does a fault until its end."""
    first = write_flight(tmp_path / "a.ulg", boot=0, start=60, bad=7)
    second = write_flight(tmp_path / "b.ulg", boot=0, start=3600, seconds=4)
    files = [first, second]
    with nedbus.open(files) as flight:
        for history in (nedbus.events(files), nedbus.events(flight)):
            verdicts = history.verdicts()
            assert "until the end (2.9 s)" in verdicts["a"].text
            assert verdicts["b"].text.startswith("no faults in 4 s; ")


@pytest.mark.logs
@pytest.mark.skipif(not LOGS.exists(), reason=f"no real logs: {LOGS} does not exist")
def test_verdict_among_several_files_is_that_of_the_file_alone() -> None:
    """Four real flights of one vehicle have the same verdicts together as each alone."""
    names = [
        "gps_off_in_flight",
        "link_cut_20s_in_flight",
        "baro_failure",
        "foreign_stop_in_flight",
    ]
    files = {name: LOGS.parent / "px4" / f"{name}.ulg" for name in names}
    together = nedbus.why([*files.values()])
    for name, path in files.items():
        assert together[name].text == nedbus.why(path)["4"].text


def test_commands_in_the_docs_run(
    swarm: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The swarm commands in docs/recordings.md exit with 0."""
    monkeypatch.chdir(tmp_path)
    for path, name in zip(swarm, "ab", strict=False):
        Path(path).rename(f"swarm_{name}.ulg")
    page = (Path(__file__).parents[3] / "docs/recordings.md").read_text()
    for line in re.findall(r"^nedbus (\w+ swarm_a.*)$", page, re.MULTILINE):
        ended = run_command(*line.split())
        assert ended.exit_code == 0, ended.err


def test_files_of_one_name_have_distinct_vehicles(tmp_path: Path) -> None:
    """Vehicles of several files are named after their files, with a number if the names of the files are equal."""
    paths = [tmp_path / folder / "a.ulg" for folder in "xyz"]
    for number, path in enumerate(paths):
        path.parent.mkdir()
        write_flight(path, boot=0, start=60 + number, seconds=1)
    streams = nedbus.read(paths, [VLP])
    seconds = {
        name: round(1e-6 * int(own["timestamp"][0] - EPOCH)) for name, own in streams.items()
    }
    assert seconds == {f"a/{VLP}": 60, f"a_2/{VLP}": 61, f"a_3/{VLP}": 62}


@pytest.mark.slow
def test_plot_of_one_vehicle_among_several_files(swarm: list[str], tmp_path: Path) -> None:
    """A vehicle that several files have is plotted by the name that the warnings and `read` give it."""
    flight, addresses = read_plotted(
        [Path(path) for path in swarm], Selection(VLP, vehicle="b"), [VLP]
    )
    assert [str(address) for address in addresses] == [f"b/{VLP}"]
    (messages, _) = array_of(flight, addresses[0], unix_times=True)
    assert messages["timestamp"][0] == EPOCH + 60_000_000
    shown = run_command("plot", *swarm, "-v", "b", "-o", str(tmp_path / "b.png"))
    assert shown.exit_code == 0, shown.err


def test_flights_years_apart_are_read_together(tmp_path: Path) -> None:
    """Two flights of a vehicle, years apart, are read together under different names."""
    first = write_flight(tmp_path / "a.ulg", boot=0, start=60, bad=2)
    second = write_flight(tmp_path / "b.ulg", boot=0, start=3e8, bad=3)
    event_log = read_file_events(first, second)
    assert [event.vehicle for event in event_log.event_log.events_since(0)[0]] == [
        "a",
        "a",
        "b",
        "b",
    ]
    assert math.isclose(event_log.end, 3e8 - 60 + 9.9, abs_tol=0.01)


def test_file_without_utc_among_several_raises(tmp_path: Path, swarm: list[str]) -> None:
    """A file without UTC is named in the error; alone it can be read."""
    path = write_flight(tmp_path / "d.ulg", boot=0, start=60, utc=False)
    ended = run_command("events", *swarm, str(path))
    assert ended.exit_code == 1
    assert f"nedbus: {path}: no message contains UTC" in ended.err
    with pytest.raises(SourceError, match=r"d\.ulg: no message contains UTC"):
        nedbus.read([*swarm, path], [VLP])
    assert run_command("events", str(path)).exit_code == 0


def test_several_files_are_read_and_aligned_in_utc(swarm: list[str]) -> None:
    """Streams have the vehicle in their name and Unix timestamps; rows are aligned across vehicles."""
    streams = nedbus.read(swarm, [VLP])
    assert [*streams] == [f"{name}/{VLP}" for name in ("a_1", "b", "c")]
    assert [each["timestamp"][0] - EPOCH for each in streams.values()] == [
        60_000_000,
        60_000_000,
        58_000_000,
    ]
    table = nedbus.align(swarm, topics=[VLP], utc=True, method="nearest")
    assert str(table["utc"][0]) == "2025-10-09T08:54:20.000000"
    assert table[f"a_1/{VLP}.x"].tolist() == table[f"b/{VLP}.x"].tolist() == list(range(100))
    assert table[f"c/{VLP}.x"][:20].tolist() == list(range(20, 40))
    one = nedbus.align(swarm, on=f"c/{VLP}", topics=[OTHER])
    assert len(one) == 40
    assert f"b/{OTHER}/0.x" in (one.dtype.names or ())
    np.testing.assert_array_equal(
        nedbus.align(swarm, on=10.0, topics=[f"b/{VLP}"])["timestamp"][:1], [EPOCH + 60_000_000]
    )
    assert [*nedbus.read(swarm, ["*"], vehicle="b")] == [f"b/{OTHER}/0", f"b/{VLP}"]


def test_page_shows_several_files(swarm: list[str]) -> None:
    """A playback of several files has all of their vehicles, aligned in UTC."""
    recording = Recording(*map(Path, swarm))
    wait_for(lambda: recording.is_read, what="the files")
    assert recording.name == "a 1.ulg, b.ulg, c.ulg"
    assert recording.timeline.clock_offset is not None
    assert math.isclose(recording.timeline.clock_offset, EPOCH / 1e6 + 58, abs_tol=0.01)
    assert {entry.address.vehicle for entry in recording.entries} == {"a_1", "b", "c"}
    assert math.isclose(recording.length, 11.9, abs_tol=0.01)


@pytest.mark.skipif(not CASES.is_dir(), reason="no ../shared/cases")
def test_swarm_from_user_report_is_aligned() -> None:
    """Three vehicles with different boots, two with the same system id, all fly from 08:54:20 to 08:54:30 UTC."""
    paths = [CASES / f"swarm_{name}.ulg" for name in "abc"]
    streams = nedbus.read(paths, [VLP])
    assert [*streams] == [f"{name}/{VLP}" for name in ("swarm_a", "swarm_b", "3")]
    assert {int(each["timestamp"][0]) for each in streams.values()} == {EPOCH + 60_000_000}
    assert 9.9 < read_file_events(*paths).end < 10.1


def test_old_first_message_does_not_shift_a_file(tmp_path: Path) -> None:
    """A message from long before the log, as PX4 logs one of each topic, does not decide on the start in UTC."""
    late = UlogWriter()
    key = b"uint64_t boot_time_utc_us"
    late.put("I", bytes([len(key)]) + key + struct.pack("<Q", EPOCH))
    late.define([VLP, OTHER])
    late.add(OTHER, message(30_000_000, **VALID))
    for tenth in range(100):
        late.add(VLP, message(60_000_000 + tenth * 100_000, **VALID))
    paths = [late.write(tmp_path / "a.ulg"), write_flight(tmp_path / "b.ulg", boot=0, start=60)]
    with nedbus.open(paths) as flights:
        assert flights.duration == pytest.approx(9.9)
        positions = [sample.vehicle for sample in flights(VLP)]
    assert positions[:6].count("a") == positions[:6].count("b") == 3
