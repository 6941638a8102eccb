"""Replay of flight logs: all topics and instances, old layouts, every kind of damage."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from pyulog import ULog

import nedbus
from nedbus.errors import SourceError
from nedbus.sources import ReplayRun
from nedbus_msgs import DEFAULT, VehicleLocalPosition, upgrade_with
from tests.flights.local_position import LAYOUTS, upgrade
from tests.flights.messages import VALID, VLP, message
from tests.flights.replays import convert_replay, open_replay
from tests.flights.ulogs import LOGS, UlogWriter, write_log, write_raw_log
from tests.peers.command_line import run_command

# Counted with pyulog: messages of all local position topics, layout, addresses.
REAL = {
    "cuav_1.16_gps_interference.ulg": (872, "1.16", 3),
    "cubeorange_1.12_small.ulg": (636, "1.12 or older", 1),
    "fmuv6c_1.17_selector_whipsaw.ulg": (4968, "1.16", 1),
    "nxp_v0_ekf_failure.ulg": (797, "V0", 1),
    "sitl_1.13_three_topics.ulg": (1871, "1.13", 5),
    "sitl_1.15_events.ulg": (313, "1.15", 1),
}
NOTHING = "this log has no message of built-in topics"


def open_log(path: Path, options: str = "") -> ReplayRun:
    return open_replay(f"ulog:{path}{options}")


def read_all(run: ReplayRun) -> list[tuple[str, VehicleLocalPosition]]:
    return [(str(each.address), upgrade(each.fields)) for each in run.messages]


@pytest.mark.logs
@pytest.mark.parametrize("name", REAL)
def test_real_log_is_read_completely_and_exactly(name: str) -> None:
    """Each message of a real log is valid, and each field equals what pyulog reads, bit by bit."""
    path = LOGS / name
    if not path.exists():
        pytest.skip(f"real log not found: {path}")
    total, layout, streams = REAL[name]
    run = open_log(path, "?topics=VehicleLocalPosition")
    assert f"layout {layout}," in run.summary
    messages = list(run.messages)
    assert (len(run.addresses), run.warnings, run.done(0)) == (streams, (), run.total)
    assert [each.at for each in messages] == sorted(each.at for each in messages)
    assert len(messages) == total
    fields = 0
    for data in ULog(str(path), list(DEFAULT.topics)).data_list:
        address = data.name, data.multi_id
        read = [
            upgrade(each.fields)
            for each in messages
            if (each.address.topic, each.address.instance or 0) == address
        ]
        for column, values in data.data.items():
            base, _, index = column.partition("[")
            for field in ("hagl_max_z", "hagl_max_xy") if base == "hagl_max" else (base,):
                held = [getattr(each, field) for each in read]
                ours = [value[int(index[0])] for value in held] if index else held
                assert np.array(ours, dtype=values.dtype).tobytes() == values.tobytes(), column
                fields += len(ours)
    assert fields >= 42 * total


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_read(tmp_path: Path, layout: str) -> None:
    """A log of any layout is read; fields that it lacks are left out."""
    writer = UlogWriter(layout=layout)
    writer.define([VLP])
    writer.add(VLP, message(5, x=1.5, delta_xy=(1.0, 2.0), hagl_max_z=9.0, xy_reset_counter=3))
    run = open_log(writer.write(tmp_path / "a.ulg"))
    [(_, read)] = read_all(run)
    assert (read.timestamp, read.x, read.delta_xy, read.xy_reset_counter) == (5, 1.5, (1.0, 2.0), 3)
    assert (read.hagl_max_z, math.isnan(read.hagl_max_xy)) == (9.0, layout == "1.16")
    assert f"layout {layout}," in run.summary
    assert run.warnings == ()


def test_all_topics_and_instances_are_read_in_order(tmp_path: Path) -> None:
    """All four topics and every estimator instance are read in logged order."""
    writer = UlogWriter(system_id=7)
    writer.define(DEFAULT.topics)
    expected = []
    for step in range(20):
        for number, topic in enumerate(DEFAULT.topics.values()):
            for instance in range(3 if topic.instances else 1):
                time = 1000 * step + 100 * number + instance
                writer.add(topic.name, message(time), instance=instance)
                expected.append(time)
    run = open_log(writer.write(tmp_path / "a.ulg"))
    read = read_all(run)
    assert [got.timestamp for _, got in read] == expected
    assert sorted({address for address, _ in read}) == [
        "7/estimator_local_position/0",
        "7/estimator_local_position/1",
        "7/estimator_local_position/2",
        "7/external_ins_local_position",
        "7/vehicle_local_position",
        "7/vehicle_local_position_groundtruth",
    ]


def test_vehicle_comes_from_option_log_or_default(tmp_path: Path) -> None:
    """`vehicle=` overrides MAV_SYS_ID, which overrides the service's default."""
    for system_id, options, expected in ((7, "?vehicle=x", "x"), (7, "", "7"), (None, "", "1")):
        writer = UlogWriter(system_id=system_id)
        writer.define([VLP])
        writer.add(VLP, message())
        [address] = open_log(writer.write(tmp_path / "a.ulg"), options).addresses
        assert address.vehicle == expected


@pytest.mark.slow
def test_no_message_is_lost_between_chunks(tmp_path: Path) -> None:
    run = open_log(write_log(tmp_path / "a.ulg", range(0, 2_500_000, 1000)))
    assert [read.x for _, read in read_all(run)] == list(range(2500))


@pytest.mark.parametrize(
    ("timestamps", "places"),
    [
        ([10, 20, 15, 30, 40], [10, 20, 20, 30, 40]),  # one is late
        # one is in the future, which must not delay the others
        ([10, 20, 10**15, 30, 40], [10, 20, 20, 30, 40]),
        ([10, 20, 30, 40, 10**15], [10, 20, 30, 40, 40]),  # the last one is in the future
        # one in the future, one without a time
        ([10, 20, 10**15, 30, 0, 40, 50], [10, 20, 20, 30, 30, 40, 50]),
    ],
)
def test_unordered_timestamps_keep_logged_order(
    tmp_path: Path, timestamps: list[int], places: list[int]
) -> None:
    """Out-of-order timestamps and impossible gaps lose no message and never stall the replay; there is a warning."""
    run = open_log(write_log(tmp_path / "a.ulg", timestamps))
    messages = list(run.messages)
    assert [each.fields["timestamp"] for each in messages] == timestamps
    assert [round(each.at * 1e6) + 10 for each in messages] == places
    assert len(run.warnings) == 1


def test_pause_is_no_disorder(tmp_path: Path) -> None:
    """A pause of more than a minute is kept without a warning, also before the last message."""
    for stamps in ([10, 20, 61_000_030, 61_000_040], [10, 20, 90_000_000]):
        run = open_log(write_log(tmp_path / f"{len(stamps)}.ulg", stamps))
        assert [round(each.at * 1e6) + 10 for each in run.messages] == stamps
        assert run.warnings == ()


@pytest.mark.parametrize("age", [50_000_000, 108_000_000])
def test_old_first_message_does_not_delay_replay(tmp_path: Path, age: int) -> None:
    """A first message from long before, such as home_position, causes neither a delay nor a warning."""
    writer = UlogWriter()
    writer.define([VLP])
    struct.pack_into("<Q", writer.data, 8, 300_000_000)  # the start of logging
    writer.put("F", b"parameter_update:uint64_t timestamp;")
    writer.put("A", struct.pack("<BH", 0, 99) + b"parameter_update")
    writer.put("D", struct.pack("<HQ", 99, 300_000_000 - age))
    for time in range(300_000_000, 310_000_000, 20_000):
        writer.add(VLP, message(time))
    run = open_log(writer.write(tmp_path / "a.ulg"), "?topics=*")
    assert [each.at for each in run.messages] == pytest.approx(
        [0.0, *(number / 50 for number in range(500))]
    )
    assert run.warnings == ()


def test_bool_whose_byte_is_not_0_is_true(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """PX4 logs bools that it did not initialize: any byte but 0 is true; their number is logged once per topic."""
    topics = {
        "rtl_status": ("uint64_t timestamp;bool[3] flags;bool ok;", "Q4B"),
        # is converted
        "battery_status": ("uint64_t timestamp;bool connected;int32_t cell_count;", "QBi"),
    }
    rows = [("rtl_status", (time, 194, 0, 1, time % 3)) for time in range(3000)]
    path = write_raw_log(tmp_path / "a.ulg", topics, [*rows, ("battery_status", (3000, 94, 6))])
    run = open_log(path, "?topics=*")
    *messages, battery = run.messages
    assert battery.fields == {"timestamp": 3000, "connected": True, "cell_count": 6}
    assert [
        tuple(upgrade_with(each.definition or DEFAULT, each.fields).__dict__.values())
        for each in messages
    ] == [(time, (True, False, True), time % 3 > 0) for time in range(3000)]
    assert [each.encode().payload[-5:] for each in messages[:2]] == [
        b"\x93\xc3\xc2\xc3\xc2",
        b"\x93\xc3\xc2\xc3\xc3",
    ]
    warnings = [
        f"bools of {topic} whose byte is neither 0 nor 1 are read as true ({count})"
        for topic, count in (("rtl_status", 4000), ("battery_status", 1))
    ]
    assert run.warnings[:2] == (*warnings,)
    read = nedbus.read(path, ["rtl_status", "battery_status"])
    assert read["rtl_status"]["flags"].tobytes() == bytes([1, 0, 1]) * 3000
    assert read["rtl_status"]["ok"].tobytes() == bytes([0, 1, 1]) * 1000
    assert read["battery_status/0"]["connected"].tobytes() == b"\1"
    assert [text for text in warnings if text in caplog.text] == warnings


@pytest.mark.logs
@pytest.mark.parametrize(
    ("name", "count"), [("cuav_1.16_gps_interference.ulg", 31), ("nxp_v0_ekf_failure.ulg", 39)]
)
def test_topic_of_real_flight_with_uninitialized_bools_is_read(name: str, count: int) -> None:
    path = LOGS / name
    if not path.exists():
        pytest.skip(f"real log not found: {path}")
    run = open_log(path, "?topics=rtl_status")
    assert (
        len([each.encode() for each in run.messages])
        == len(nedbus.read(path, "rtl_status"))
        == count
    )
    assert run.warnings == (
        f"bools of rtl_status whose byte is neither 0 nor 1 are read as true ({count})",
    )


def test_topic_that_is_subscribed_again_is_one_stream(tmp_path: Path) -> None:
    """All messages of a topic are read without a warning, however often the logger subscribes to it."""
    writer = UlogWriter()
    writer.define([VLP])
    for number in range(500):
        if number:
            writer.put("A", struct.pack("<BH", 0, 0) + VLP.encode())
        writer.add(VLP, message(1 + number))
        writer.put("R", struct.pack("<H", 0))
    run = open_log(writer.write(tmp_path / "a.ulg"))
    assert [read.timestamp for _, read in read_all(run)] == [*range(1, 501)]
    assert run.warnings == ()


def test_second_instance_of_single_instance_topic_is_skipped(tmp_path: Path) -> None:
    """A topic without instances has one stream per vehicle: a second instance is skipped, with a warning."""
    writer = UlogWriter()
    writer.define([VLP])
    writer.add(VLP, message(1, x=1.0))
    writer.add(VLP, message(2, x=2.0), instance=1)
    run = open_log(writer.write(tmp_path / "a.ulg"))
    assert [read.x for _, read in read_all(run)] == [1.0]
    assert "skipped a duplicate vehicle_local_position [1]" in run.warnings[0]


@pytest.mark.parametrize(
    ("write", "reason"),
    [
        (lambda _: None, "no such file"),
        (lambda path: path.write_bytes(b""), "an empty file"),
        (lambda path: path.write_bytes(b"hello"), "not a readable ULog file"),
        (lambda path: path.write_bytes(b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + bytes(8)), NOTHING),
        (
            lambda path: write_log(path, [1], topic="something_else"),
            f"{NOTHING}, but of something_else; choose .* all with '\\*'",
        ),
    ],
)
def test_unreadable_log_raises(
    tmp_path: Path, write: Callable[[Path], object], reason: str
) -> None:
    """The error names the file and the problem, even for a log of other topics."""
    path = tmp_path / "a.ulg"
    write(path)
    with pytest.raises(SourceError, match=reason) as info:
        open_log(path)
    assert str(path) in str(info.value)


def test_unknown_ulog_version_is_read_with_warning(tmp_path: Path) -> None:
    """Messages of a newer format version are read as far as they are known."""
    path = write_log(tmp_path / "a.ulg", range(0, 100_000, 1000))
    data = bytearray(path.read_bytes())
    data[7] = 9
    path.write_bytes(data)
    run = open_log(path)
    assert "unknown version 9" in run.warnings[0]
    assert len(read_all(run)) == 100


def test_damaged_format_is_detected(tmp_path: Path) -> None:
    """An invalid field type, or the lack of a field that every release has, is damage; no field is read as another."""
    path = write_log(tmp_path / "a.ulg", range(0, 100_000, 1000), topic="estimator_local_position")
    good = path.read_bytes()
    for before, after in (
        (b"float[2] delta_xy;", b"float[0] delta_xy;"),
        (b"float z;", b"float \0;"),
    ):
        assert good.count(before) == 1
        path.write_bytes(good.replace(before, after))
        try:
            run = open_log(path)
        except SourceError as exc:
            assert "damaged" in str(exc)
        else:
            assert run.damage
            assert all("z" not in each.fields for each in run.messages)


OLD_BATTERY = "uint64_t timestamp;int32_t cell_count;double temperature;float[3] voltage_cell_v;uint8_t connected;"
OLD_STATUS = "uint64_t timestamp;uint32_t system_id;uint32_t component_id;uint8_t nav_state;"


def write_old_log(path: Path, counts: Sequence[int], *, temperature: float = 20.5) -> Path:
    """Write a log like PX4 1.9's, without its release: fields have other types than today's."""
    topics = {"battery_status": (OLD_BATTERY, "Qid3fB"), "vehicle_status": (OLD_STATUS, "QIIB")}
    rows = [
        ("battery_status", (10 + n, count, temperature, 4.1, 4.2, 4.0, 1))
        for n, count in enumerate(counts)
    ]
    return write_raw_log(
        path,
        topics,
        [*rows, ("vehicle_status", (100, 1, 1, 2)), ("vehicle_status", (200, 1, 1, 5))],
    )


def test_field_of_another_type_is_converted(tmp_path: Path) -> None:
    """A value is converted where it fits, in a replay, in arrays and in a recording; such a log is not damaged."""
    path = write_old_log(tmp_path / "a.ulg", [6, 6])
    run = open_log(path, "?topics=*")
    first, *_, last = run.messages
    assert (first.fields["cell_count"], first.fields["temperature"], first.fields["connected"]) == (
        6,
        20.5,
        True,
    )
    assert (last.fields["system_id"], last.fields["nav_state"]) == (1, 5)
    assert (run.warnings, run.damage) == ((), None)
    convert_replay(f"ulog:{path}?topics=*", tmp_path / "a.mcap")
    for file in (path, tmp_path / "a.mcap"):
        streams = nedbus.read(file, ["*"])
        battery = streams["battery_status/0"]
        assert battery["cell_count"].tolist() == [6, 6]
        assert battery["voltage_cell_v"][0, :3].tolist() == pytest.approx([4.1, 4.2, 4.0])
        assert np.isnan(battery["voltage_cell_v"][0, 3:]).all()
        assert streams["vehicle_status"]["system_id"].tolist() == [1, 1]
        assert "cell_count" not in nedbus.missing_of(battery)


@pytest.mark.slow
def test_value_that_does_not_fit_is_left_out(tmp_path: Path) -> None:
    """A field whose value does not fit is left out of its message, and logged once; the rest is read."""
    path = write_old_log(tmp_path / "a.ulg", [6, -1, 256, 7], temperature=0.1)
    run = open_log(path, "?topics=*")
    batteries = [each.fields for each in run.messages if each.address.topic == "battery_status"]
    assert [fields.get("cell_count") for fields in batteries] == [6, None, None, 7]
    assert run.damage is None
    assert sorted(run.warnings) == [
        "battery_status.cell_count is left out where its value does not fit uint8, such as -1",
        "battery_status.temperature is left out where its value does not fit float32, such as 0.1",
    ]
    table = nedbus.read(path, "battery_status", dataframe="pandas")
    assert table["cell_count"].isna().tolist() == [False, True, True, False]
    assert nedbus.read(path, "battery_status")["cell_count"].tolist() == [6, 0, 0, 7]


def test_old_log_without_release_is_not_reported_as_damaged(tmp_path: Path) -> None:
    """A log without a release is converted with exit code 0, and its mode change is reported as an event."""
    path = write_old_log(tmp_path / "a.ulg", [6])
    converted = run_command("convert", str(path), str(tmp_path / "a.mcap"))
    assert (converted.exit_code, converted.err.count("damaged")) == (0, 0)
    assert "mode changed from Position to Return" in run_command("events", str(path)).out


def test_dropout_is_an_event(tmp_path: Path) -> None:
    """A dropout of 5 s becomes an event with its duration; a gap without a dropout record is reported as silence."""
    for is_recorded in (True, False):
        writer = UlogWriter()
        writer.define([VLP])
        for time in [
            *range(10_000_000, 16_000_000, 100_000),
            *range(21_000_000, 25_000_000, 100_000),
        ]:
            if is_recorded and time == 21_000_000:
                writer.put("O", struct.pack("<H", 5000))
            writer.add(VLP, message(time, **VALID))
        lines = run_command("events", str(writer.write(tmp_path / "a.ulg"))).out
        assert ("logging dropout of 5.0 s" in lines, "silent" in lines) == (
            is_recorded,
            not is_recorded,
        )


def test_event_before_the_first_timestamp_has_a_time_since_boot(tmp_path: Path) -> None:
    """Even if the first messages have no timestamp, the times at which rejections begin and end are since boot."""
    writer = UlogWriter()
    writer.define([VLP])
    for time in (0, 0, *range(100_000_000, 108_000_000, 100_000)):
        writer.add(VLP, message(time, **VALID), z=-5.0 if time else math.nan)
    lines = run_command("events", str(writer.write(tmp_path / "a.ulg"))).out.splitlines()
    assert [line.split()[0] for line in lines] == ["100.000", "100.000"]
