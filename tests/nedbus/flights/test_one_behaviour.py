"""Flights behave alike in all formats, alone and among several files."""

from __future__ import annotations

import logging
import shutil
import struct
from collections import defaultdict
from itertools import zip_longest
from pathlib import Path

import pytest

import nedbus
from nedbus.errors import AddressError, ArgumentError, ConfigError, NedbusError, SourceError
from nedbus.flights.readers import FlightReader, open_reader
from nedbus_msgs import Address
from tests.flights.replays import open_replay
from tests.flights.ulogs import UlogWriter
from tests.peers.command_line import run_command

from .formats import BOOT, EPOCH, STEP, VLP, write_flight

SOURCES = {".ulg": "ulog", ".mcap": "mcap", ".tlog": "tlog"}
each_format = pytest.mark.parametrize("suffix", SOURCES)
each_several = pytest.mark.parametrize("is_list", [False, True])


@each_format
@each_several
def test_unknown_vehicle_raises(tmp_path: Path, suffix: str, *, is_list: bool) -> None:
    """A vehicle that no file has raises, and the error names the vehicles."""
    path = write_flight(tmp_path / f"a{suffix}")
    with pytest.raises(AddressError, match=r"vehicle 'typo' is not .*1"):
        nedbus.read([path] if is_list else path, [VLP], vehicle="typo")
    with (
        nedbus.open([path] if is_list else path, vehicle="typo") as flight,
        pytest.raises(AddressError, match="typo"),
    ):
        list(flight())


@each_format
@each_several
def test_unknown_topic_raises(tmp_path: Path, suffix: str, *, is_list: bool) -> None:
    """A topic that the file lacks raises, and the error of `read` lists the streams of the file."""
    path = write_flight(tmp_path / f"a{suffix}")
    files = [path] if is_list else path
    with pytest.raises(
        AddressError, match=r"topic 'home_position' is not in .*1/vehicle_local_position"
    ):
        nedbus.read(files, ["home_position"])
    with (
        pytest.raises(NedbusError, match=r"has no|has none of|no message of"),
        nedbus.open(files) as flight,
    ):
        list(flight("home_position"))


def test_empty_list_of_files_raises() -> None:
    """No file at all is a mistake of the caller."""
    for use in (lambda: nedbus.read([], [VLP]), lambda: nedbus.open([]), lambda: nedbus.align([])):
        with pytest.raises(ArgumentError, match="at least one"):
            use()


@each_format
def test_file_is_parsed_once(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """`read` parses a file once, alone or in a list."""
    path, passes = write_flight(tmp_path / f"a{suffix}"), list[str]()
    with open_reader(path) as reader:
        kind = type(reader)
    original = kind.runs

    def counted(self: FlightReader) -> object:
        passes.append(self.kind)
        return original(self)

    monkeypatch.setattr(kind, "runs", counted)
    nedbus.read(path)
    nedbus.read([path], [VLP])
    assert len(passes) == 2


@each_format
def test_runs_contain_the_records_of_each_address_in_order(tmp_path: Path, suffix: str) -> None:
    """Records and runs are two views of one file: both have the same messages and times per address."""
    path = write_flight(tmp_path / f"a{suffix}", vehicles=(1,) if suffix == ".ulg" else (1, 2))
    single, together = (
        defaultdict[Address, list[object]](list),
        defaultdict[Address, list[object]](list),
    )
    with open_reader(path) as reader:
        for record in reader.records():
            single[record.stream.address].append((record.payload, record.time))
    with open_reader(path) as reader:
        for run in reader.runs():
            together[run.stream.address] += zip_longest(run.payloads, run.times)
    assert single == together


@pytest.mark.parametrize("suffix", [".mcap", ".tlog"])
def test_one_name_for_several_vehicles_raises(tmp_path: Path, suffix: str) -> None:
    """`?vehicle=` never interleaves two vehicles as one stream."""
    path = write_flight(tmp_path / f"a{suffix}", vehicles=(1, 2))
    with pytest.raises(ConfigError, match=r"has several vehicles \(1, 2\); remove this option"):
        list(open_replay(f"{suffix[1:]}:{path}?vehicle=7&speed=max").messages)


@each_format
@each_several
def test_read_and_open_yield_the_same_messages(
    tmp_path: Path, suffix: str, *, is_list: bool
) -> None:
    """`open` yields each message of `read`, in order, as models, rows and batches."""
    path = write_flight(tmp_path / f"a{suffix}")
    array = nedbus.read(path)
    with nedbus.open([path] if is_list else path) as flight:
        models, rows = list(flight()), list(flight(rows=True))
        batches = list(flight().batches())
        assert [str(each) for each in flight.addresses] == [f"1/{VLP}"]
        assert flight.duration == pytest.approx(49 * STEP / 1e6)
        assert flight.utc is not None
        assert abs(flight.utc.at(BOOT).timestamp() - (EPOCH + BOOT) / 1e6) < 0.001
        assert not flight.damaged, flight.warnings
    assert (
        [each.message.x for each in models]
        == [each.message.x for each in rows]
        == array["x"].tolist()
    )
    (batch,) = batches
    assert batch.messages.tobytes() == array.tobytes()
    assert {each.source for each in models} == {batch.provenances[0].source} == {SOURCES[suffix]}
    assert models[0].received == 1000 * (EPOCH + BOOT) == int(batch.received[0])
    assert models[0].missing == nedbus.missing_of(array) == batch.provenances[0].missing


@each_format
def test_period_selects_by_seconds_and_by_utc(tmp_path: Path, suffix: str) -> None:
    """`start` and `end` are seconds since the first message, or UTC."""
    path = write_flight(tmp_path / f"a{suffix}")
    with nedbus.open(path) as flight:
        assert flight.utc is not None
        begin = flight.utc.at(BOOT + 10 * STEP)
        by_seconds = [each.message.x for each in flight(start=1.0, end=2.0)]
        by_utc = [each.message.x for each in flight(start=begin, end=2.0)]
    assert by_seconds == by_utc == [1000.0 + index for index in range(10, 21)]


@pytest.mark.slow
def test_files_of_all_formats_are_merged_by_utc(tmp_path: Path) -> None:
    """A log, a recording and a .tlog become one flight in the order of UTC, with a name for each file's vehicle."""
    paths = [
        write_flight(tmp_path / f"{name}{suffix}", start=EPOCH + late)
        for name, suffix, late in (("a", ".ulg", 0), ("b", ".mcap", 30_000), ("c", ".tlog", 60_000))
    ]
    with nedbus.open(paths) as flight:
        samples = list(flight())
    assert [each.vehicle for each in samples[:6]] == ["a", "b", "c"] * 2
    arrays = nedbus.read(paths, [VLP])
    assert arrays.keys() == {f"{name}/{VLP}" for name in "abc"}
    assert len(nedbus.align(paths, topics=[VLP])) == 50
    for command in (
        ["events", *paths],
        ["why", *paths],
        ["plot", *paths, "-o", tmp_path / "all.png"],
    ):
        result = run_command(*map(str, command))
        assert result.exit_code == 0, result.err
    assert run_command("convert", *map(str, paths), str(tmp_path / "all.mcap")).exit_code == 0
    assert {str(each) for each in nedbus.addresses_of(tmp_path / "all.mcap")} == {
        f"{name}/{VLP}" for name in "abc"
    }


@each_format
def test_empty_file_raises(tmp_path: Path, suffix: str) -> None:
    """An empty file raises with the reason."""
    path = tmp_path / f"a{suffix}"
    path.touch()
    for use in (nedbus.read, nedbus.open):
        with pytest.raises(SourceError, match="an empty file"):
            use(path)


@each_format
def test_content_decides_over_the_suffix(tmp_path: Path, suffix: str) -> None:
    """A log or recording with a wrong suffix is read; other content raises one error."""
    for form in (".ulg", ".mcap"):
        shutil.copy(write_flight(tmp_path / f"right{form}"), tmp_path / f"wrong{suffix}")
        assert len(nedbus.read(tmp_path / f"wrong{suffix}")) == 50
    (tmp_path / f"text{suffix}").write_text("no flight " * 100)
    with pytest.raises(SourceError, match=r"not a readable|no autopilot messages"):
        nedbus.read(tmp_path / f"text{suffix}")


def test_folder_that_is_no_bag_raises(tmp_path: Path) -> None:
    """A folder without recordings, whatever its name, raises."""
    for name in ("a.ulg", "a.tlog", "bag"):
        (tmp_path / name).mkdir()
        with pytest.raises(
            SourceError, match=r"no \.mcap file in this folder|only a bag of MCAP files"
        ):
            nedbus.read(tmp_path / name)


@each_format
def test_truncated_file_is_read_to_its_end(tmp_path: Path, suffix: str) -> None:
    """What is readable of a cut file is kept, and the cut is reported."""
    path = write_flight(tmp_path / f"a{suffix}", count=500)
    path.write_bytes(path.read_bytes()[: -len(path.read_bytes()) // 3])
    with nedbus.open(path) as flight:
        samples = flight()
        found = [each.message.x for each in samples]
        assert found == [1000.0 + index for index in range(len(found))]
        assert flight.warnings


@pytest.mark.long
@each_format
def test_file_that_shrinks_while_it_is_read_is_reported(tmp_path: Path, suffix: str) -> None:
    """Messages before the new end are kept, and the loss is reported; no exception of the platform escapes."""
    path = write_flight(tmp_path / f"a{suffix}", count=12_000)
    with nedbus.open(path) as flight:
        samples = flight()
        first = next(samples)
        with path.open("r+b") as file:
            file.truncate(path.stat().st_size * 9 // 10)
        rest = list(samples)
        assert first.message.x == 1000.0
        assert 5000 < len(rest) < 11_999
        assert samples.damaged
        assert samples.warnings


@each_format
def test_pause_counts_on_the_axis(tmp_path: Path, suffix: str) -> None:
    """Times since the first message include a pause of minutes; only the pace of a replay leaves it out."""
    path = write_flight(tmp_path / f"a{suffix}", count=20, pause_before=10)
    run = open_replay(f"{SOURCES[suffix]}:{path}?speed=max")
    times = [each.at for each in run.messages]
    assert times[:10] == pytest.approx([index * STEP / 1e6 for index in range(10)])
    assert times[-1] > 60 + 19 * STEP / 1e6
    assert not run.warnings
    with nedbus.open(path) as flight:
        assert flight.duration == pytest.approx(times[-1])
        late = list(flight(start=times[10], end=times[12]))
    assert [each.message.x for each in late] == [1010.0, 1011.0, 1012.0]


def test_layout_of_another_release_is_read_on_request(caplog: pytest.LogCaptureFixture) -> None:
    """A recording made with the px4_msgs of another release names the cause, and is read with `layout=`."""
    cases = Path(__file__).parents[4] / "shared" / "cases" / "turn5"
    for name, layout, remedy in (
        (
            "53_wrong_px4_msgs_115_as_116.mcap",
            "1.15",
            "204 bytes, expected 220.*rebuild px4_msgs at release/1.15",
        ),
        ("53c_wrong_V0_as_116.mcap", "V0", "216 bytes, expected 220.*a development version"),
    ):
        if not (cases / name).exists():
            pytest.skip("the shared cases are not here")
        with pytest.raises(SourceError, match=remedy):
            nedbus.read(cases / name)
        array = nedbus.read(cases / name, layout=layout)
        assert array["x"].tolist() == [0.25 * index for index in range(50)]
        with nedbus.open(cases / name, layout=layout) as flight:
            assert [each.message.x for each in flight()] == array["x"].tolist()
        run = open_replay(f"mcap:{cases / name}?speed=max&layout={layout}")
        assert [each.fields["x"] for each in run.messages] == array["x"].tolist()
    with caplog.at_level(logging.WARNING), pytest.raises(ArgumentError, match="layout"):
        nedbus.read(cases / "46_subscribed_again.ulg", layout="1.15")


def test_unknown_layout_raises(tmp_path: Path) -> None:
    """A layout that no release has raises, instead of being ignored."""
    path = write_flight(tmp_path / "a.mcap")
    for use in (nedbus.read, nedbus.align, nedbus.open):
        with pytest.raises(
            ArgumentError, match=r"layout '9\.9' is not valid: expected one of 1\.13, .*V0"
        ):
            use(path, layout="9.9")


def test_flight_with_user_defined_topics_only_has_no_utc(tmp_path: Path) -> None:
    """A log without built-in topics is a flight like others, whose UTC is unknown."""
    writer = UlogWriter()
    writer.put("F", b"wheel_speed:uint64_t timestamp;float speed;")
    writer.put("A", struct.pack("<BH", 0, 0) + b"wheel_speed")
    for index in range(3):
        writer.put("D", struct.pack("<HQf", 0, 1_000_000 + index, index))
    with nedbus.open(writer.write(tmp_path / "a.ulg")) as flight:
        assert flight.utc is None
        assert [str(each) for each in flight.addresses] == ["1/wheel_speed"]
        assert len(list(flight("*", rows=True))) == 3
