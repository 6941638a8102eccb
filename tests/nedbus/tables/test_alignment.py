"""Time alignment of streams, and the UTC offset of a flight."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nedbus
from nedbus.errors import AddressError, ArgumentError, ConfigError
from nedbus.flights import RecordingWriter, find_utc
from nedbus_msgs import (
    MESSAGES,
    Address,
    Definition,
    Message,
    Provenance,
    define_msg,
    definition_of,
)
from nedbus_msgs.arrays import MessageArray, arrays_of
from tests.flights.messages import VLP, message
from tests.flights.replays import convert_replay
from tests.flights.ulogs import UlogWriter

BOOT = 1_700_000_000_000_000  # us; Unix time of the boot, in 2023


def array_of(topic: str, *fields: Mapping[str, object]) -> MessageArray:
    """Return an array of messages of a topic."""
    definition: Definition[Message] = definition_of(topic)
    return arrays_of(definition).of(
        [definition.model.model_validate(dict(each)) for each in fields]
    )


def yaw(angle: float) -> tuple[float, float, float, float]:
    """Return the quaternion of a rotation about z."""
    return math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)


def write(path: Path, streams: dict[str, MessageArray], vehicle: str = "1") -> Path:
    """Write a recording of these streams."""
    with RecordingWriter(path) as writer:
        for name, array in streams.items():
            topic, _, instance = name.partition("/")
            address = Address(vehicle, topic, int(instance) if instance else None)
            writer.write(
                array,
                definition_of(topic),
                repeat((address, Provenance())),
                logged=[1] * len(array),
                published=repeat(1),
            )
    return path


POSITIONS = array_of(
    VLP, *({"timestamp": 1_000_000 + 100_000 * number, "x": float(number)} for number in range(5))
)
HOME = array_of(
    "home_position", {"timestamp": 1_150_000, "alt": 7.0}, {"timestamp": 1_250_000, "alt": 9.0}
)


def test_derived_columns_are_offered_by_name() -> None:
    """`align` computes height, speed and angles if `fields` names them: NaN while invalid and before the first message.

    Angles follow from the interpolated quaternion, so they do not jump at a half turn.
    """
    flown = array_of(
        VLP,
        {"timestamp": 1_000_000, "z": -4.0, "z_valid": True},
        {"timestamp": 1_100_000, "z": -9.0},
    )
    first, second = math.radians(179.0), math.radians(-179.0)
    turned = array_of(
        "vehicle_attitude",
        {"timestamp": 1_050_000, "q": yaw(first)},
        {"timestamp": 1_150_000, "q": yaw(second)},
    )
    streams = {VLP: flown, "vehicle_attitude": turned}
    table = nedbus.align(streams, fields=["height", "vehicle_attitude.yaw_deg"], method="linear")
    assert table.dtype.names == ("timestamp", f"{VLP}.height", "vehicle_attitude.yaw_deg")
    assert table[f"{VLP}.height"] == pytest.approx([4.0, math.nan], nan_ok=True)
    assert math.isnan(table["vehicle_attitude.yaw_deg"][0])
    assert abs(table["vehicle_attitude.yaw_deg"][1]) == pytest.approx(180.0, abs=1e-3)
    assert f"{VLP}.height" not in (nedbus.align(streams).dtype.names or ())
    with pytest.raises(ArgumentError, match="height, speed, roll"):
        nedbus.align(streams, fields=["altitud"])


def test_method_last_never_uses_future_messages() -> None:
    """With method "last" a row has the last message at or before it, and its age; earlier rows have NaN."""
    table = nedbus.align({VLP: POSITIONS, "home_position": HOME})
    assert table["timestamp"].tolist() == POSITIONS["timestamp"].tolist()
    assert table[f"{VLP}.x"].tolist() == [0, 1, 2, 3, 4]
    assert np.array_equal(
        table["home_position.alt"], np.array([np.nan, np.nan, 7, 9, 9]), equal_nan=True
    )
    assert np.allclose(
        table["home_position.age"], [np.nan, np.nan, 0.05, 0.05, 0.15], equal_nan=True
    )
    assert table["home_position.timestamp"].tolist() == [0, 0, 1_150_000, 1_250_000, 1_250_000]
    assert table[f"{VLP}.age"].tolist() == [0] * 5
    exactly = nedbus.align({"home_position": HOME}, on=[1_150_000, 1_149_999])
    assert exactly["home_position.age"][0] == 0
    assert np.isnan(exactly["home_position.age"][1])


def test_method_nearest_may_use_future_messages() -> None:
    """With method "nearest" a later message has a negative age; of two equally near messages the earlier is used."""
    table = nedbus.align(
        {"home_position": HOME}, on=[0, 1_200_000, 1_200_001, 9_000_000], method="nearest"
    )
    assert table["home_position.alt"].tolist() == [7, 7, 9, 9]
    assert np.allclose(table["home_position.age"], [-1.15, 0.05, -0.049999, 7.75])


def test_method_linear_interpolates_only_floats() -> None:
    """With method "linear" floats are interpolated; integers, flags, NaN and infinities keep the last value."""
    messages = array_of(
        VLP,
        {
            "timestamp": 1_000_000,
            "x": 1.0,
            "ref_lon": 179.0,
            "vx": math.nan,
            "vxy_max": math.inf,
            "ref_timestamp": 2,
        },
        {
            "timestamp": 2_000_000,
            "x": 3.0,
            "ref_lon": -179.0,
            "vx": 1.0,
            "vxy_max": math.inf,
            "ref_timestamp": 4,
        },
    )
    table = nedbus.align(
        {VLP: messages}, on=[999_999, 1_000_000, 1_250_000, 1_750_000, 2_500_000], method="linear"
    )
    assert np.array_equal(table[f"{VLP}.x"], np.array([np.nan, 1, 1.5, 2.5, 3]), equal_nan=True)
    assert table[f"{VLP}.ref_timestamp"].tolist() == [0, 2, 2, 2, 4]
    assert table[f"{VLP}.ref_lon"][2:].tolist() == [179.5, -179.5, -179.0]
    assert np.array_equal(
        table[f"{VLP}.vx"][1:], np.array([np.nan, np.nan, np.nan, 1]), equal_nan=True
    )
    assert table[f"{VLP}.vxy_max"][1:].tolist() == [math.inf] * 4
    assert np.allclose(table[f"{VLP}.age"], [np.nan, 0, 0.25, 0.75, 0.5], equal_nan=True)


@pytest.mark.parametrize(
    ("field", "first", "second", "middle"),
    [
        ("heading", 3.0, -3.0, math.pi),
        ("heading", -0.5, 0.5, 0.0),
        ("cog_rad", 6.0, 0.4, 6.0 + (2 * math.pi - 5.6) / 2),
        ("cog_rad", 0.2, 6.2, 6.2 + (2 * math.pi - 6.0) / 2),
    ],
)
def test_angles_are_interpolated_along_the_shorter_arc(
    field: str, first: float, second: float, middle: float
) -> None:
    """An angle is interpolated along the shorter arc, and stays in the range of its field: from -pi, or from 0."""
    messages = array_of(
        "vehicle_gps_position", {"timestamp": 1, field: first}, {"timestamp": 3, field: second}
    )
    [value] = nedbus.align({"vehicle_gps_position": messages}, on=[2], method="linear")[
        f"vehicle_gps_position.{field}"
    ]
    assert math.remainder(value - middle, math.tau) == pytest.approx(0, abs=1e-6)
    low = -math.pi if min(first, second) < 0 else 0.0
    assert low - 1e-6 <= value <= low + math.tau + 1e-6


def test_quaternions_are_interpolated_by_slerp() -> None:
    """Interpolated quaternions rotate at a constant rate with norm 1, even if the sign flips; NaN remains NaN."""
    turns = [yaw(0.0), tuple(-each for each in yaw(2.0)), yaw(2.0), (math.nan,) * 4]
    messages = array_of(
        "vehicle_attitude", *({"timestamp": 4 * n, "q": q} for n, q in enumerate(turns))
    )
    table = nedbus.align({"vehicle_attitude": messages}, on=[0, 1, 2, 3, 4, 6, 10], method="linear")
    q = table["vehicle_attitude.q"]
    angles = 2 * np.arctan2(q[:5, 3], q[:5, 0])
    assert np.allclose(np.mod(angles, 2 * math.pi), [0, 0.5, 1, 1.5, 2])
    assert np.allclose(np.linalg.norm(q[:6], axis=1), 1)
    assert np.isnan(q[6]).all()


def test_floats_are_not_interpolated_across_a_reset() -> None:
    """Between two messages with different reset counters the last value is kept."""
    fields = ({"timestamp": 0, "x": 0.0}, {"timestamp": 4, "x": 50.0, "xy_reset_counter": 1})
    table = nedbus.align({VLP: array_of(VLP, *fields)}, on=[0, 2, 3, 4], method="linear")
    assert table[f"{VLP}.x"].tolist() == [0, 0, 0, 50]


def test_fields_select_the_columns() -> None:
    """`stream.field` selects one column, `field` one column per stream; time columns remain; unknown fields raise."""
    flight = {VLP: POSITIONS, "home_position": HOME}
    table = nedbus.align(flight, fields=["z", "home_position.age"], utc=True)
    assert table.dtype.names == (
        "timestamp",
        "utc",
        f"{VLP}.z",
        "home_position.age",
        "home_position.z",
    )
    assert np.array_equal(table[f"{VLP}.z"], nedbus.align(flight)[f"{VLP}.z"], equal_nan=True)
    with pytest.raises(
        ArgumentError, match=rf"fields \['zz'\] are in no stream: expected any of .*, {VLP}.age, "
    ):
        nedbus.align(flight, fields=["zz"])


def test_rows_at_a_fixed_rate_span_the_flight() -> None:
    """A rate returns evenly spaced rows from the first to the last message; invalid rates and too many rows raise."""
    table = nedbus.align({VLP: POSITIONS, "home_position": HOME}, on=20)
    assert table["timestamp"].tolist() == list(range(1_000_000, 1_400_001, 50_000))
    late = array_of("home_position", {"timestamp": 2**63})
    for rate in (20, 0, -1, math.nan, math.inf, "*", None, [-1], [[1]], ["a"], np.int64(0)):
        with pytest.raises(ArgumentError, match=r"^on "):
            nedbus.align({VLP: POSITIONS, "home_position": late}, on=rate)  # type: ignore[arg-type] # invalid on purpose


@pytest.mark.parametrize("form", ["ULG", "MCAP"])
def test_rows_begin_when_recording_began(tmp_path: Path, form: str) -> None:
    """A slow topic's last message, which PX4 logs with its old timestamp, adds no empty rows at the start.

    A topic that begins later removes no rows.
    """
    log = tmp_path / "a.ULG"
    times = range(300_000_000, 310_000_000, 20_000)
    writer, late = UlogWriter(), "vehicle_local_position_groundtruth"
    writer.define([VLP, late])
    struct.pack_into("<Q", writer.data, 8, times.start)  # the start of logging
    writer.put("F", b"home_position:uint64_t timestamp;float x;")
    writer.put("A", struct.pack("<BH", 0, 99) + b"home_position")
    writer.put("D", struct.pack("<HQf", 99, 250_000_000, 7.0))
    for time in times:
        writer.add(VLP, message(time))
        if time > 305_000_000:
            writer.add(late, message(time))
    writer.write(log)
    path = log if form == "ULG" else tmp_path / "a.MCAP"
    if form == "MCAP":
        convert_replay(f"ulog:{log}", path)
    table = nedbus.align(path, on=50)
    assert table["timestamp"].tolist() == list(times)
    assert table["home_position.age"][[0, -1]].tolist() == pytest.approx([50.0, 59.98])
    assert set(table["home_position.x"]) == {7.0}


@pytest.mark.parametrize(("start", "first"), [
    # up to a second of older messages: logging had begun before the header was written
    (300_900_000, 300_000_000),
    (301_100_000, 301_100_000),
    (400_000_000, 300_000_000),  # a damaged start, after the last message
])  # fmt: skip
def test_rows_begin_with_recent_messages(tmp_path: Path, start: int, first: int) -> None:
    """Rows begin with the first message, unless it is over a second older than the start of the recording."""
    writer = UlogWriter()
    writer.define([VLP])
    struct.pack_into("<Q", writer.data, 8, start)
    for time in range(300_000_000, 305_000_000, 100_000):
        writer.add(VLP, message(time))
    writer.write(tmp_path / "a.ulg")
    assert nedbus.align(tmp_path / "a.ulg", on=10)["timestamp"][0] == first


@pytest.mark.parametrize("damaged", [2**40, 1])
def test_single_damaged_timestamp_is_no_restart(damaged: int) -> None:
    """A timestamp that is far ahead or behind does not count as a restart of the vehicle."""
    positions = array_of(VLP, *({"timestamp": 1_000_000 + number} for number in range(100)))
    positions["timestamp"][50] = damaged
    table = nedbus.align({VLP: positions}, on=[1_000_000, 1_000_099])
    assert table[f"{VLP}.timestamp"].tolist() == [1_000_000, 1_000_099]


def test_streams_on_different_clocks_raise() -> None:
    """Aligning a stream in Unix time with one in time since boot raises; the error names both and the remedy."""
    unix = array_of(VLP, {"timestamp": BOOT}, {"timestamp": BOOT + 1_000_000})
    with pytest.raises(
        ArgumentError,
        match=rf"home_position begins at 1 s, {VLP} ends at 1700000001 s\): expected topics on one",
    ):
        nedbus.align({VLP: unix, "home_position": HOME}, on=50)


def test_empty_and_unordered_streams_are_aligned(tmp_path: Path) -> None:
    """Empty streams, equal and unordered timestamps are aligned; several boots and invalid arguments raise."""
    nothing = HOME[:0]
    table = nedbus.align({VLP: POSITIONS, "home_position": nothing})
    assert np.isnan(table["home_position.age"]).all()
    assert len(nedbus.align({VLP: POSITIONS, "home_position": nothing}, on="home_position")) == 0
    assert len(nedbus.align({"home_position": nothing}, on=10.0)) == 0
    twice = POSITIONS[[0, 0, 1, 3, 2, 4]]
    twice["x"] = range(6)
    table = nedbus.align({VLP: twice, "home_position": HOME}, method="linear")
    assert table[f"{VLP}.x"].tolist() == [0, 1, 2, 3, 4, 5]
    assert nedbus.align({VLP: twice}, on=[1_000_000, 1_300_000])[f"{VLP}.x"].tolist() == [1, 3]
    again = np.concatenate([POSITIONS, POSITIONS])
    with pytest.raises(
        ConfigError,
        match=f"^{VLP}: timestamps step back after a reboot, or because the vehicle.s clock was set; align",
    ):
        nedbus.align({VLP: again})
    with pytest.raises(
        ArgumentError, match="method 'spline' is not valid: expected one of last, nearest, linear"
    ):
        nedbus.align({VLP: POSITIONS}, method="spline")  # type: ignore[call-overload] # invalid on purpose
    with pytest.raises(
        AddressError,
        match=f"topic 'home_position' is not among these arrays: expected one of {VLP}",
    ):
        nedbus.align({VLP: POSITIONS}, topics=["home_position"])
    with pytest.raises(ArgumentError, match="expected pandas or polars"):
        nedbus.align({VLP: POSITIONS}, dataframe="foo")  # type: ignore[call-overload] # invalid on purpose


def test_list_of_topics_returns_streams_by_name(tmp_path: Path) -> None:
    """`read` returns a dict of one vehicle's streams; `align` adds the stream that defines the rows to a selection."""
    batteries = [
        array_of("battery_status", {"timestamp": 1_200_000, "voltage_v": volts})
        for volts in (16.0, 12.0)
    ]
    streams = {
        VLP: POSITIONS,
        "home_position": HOME,
        "battery_status/0": batteries[0],
        "battery_status/1": batteries[1],
    }
    path = write(tmp_path / "a.mcap", streams)
    read = nedbus.read(path, ["*"])
    assert read.keys() == streams.keys()
    assert all(read[name].tobytes() == array.tobytes() for name, array in streams.items())
    assert list(nedbus.read(path, ["home_position", "battery_status"])) == list(streams)[1:]
    assert nedbus.read(path, ["battery_status/1"])["battery_status/1"]["voltage_v"] == [12]
    assert nedbus.align(path).tobytes() == nedbus.align(nedbus.read(path, ["*"])).tobytes()
    table = nedbus.align(path, topics=["battery_status/1"])
    assert {name.partition(".")[0] for name in table.dtype.names or ()} == {
        "timestamp",
        VLP,
        "battery_status/1",
    }
    for wrong in ("home_positions", "battery_status/7", "battery_status/x", "vehicle_status"):
        with pytest.raises(AddressError):
            nedbus.read(path, [wrong])
    with RecordingWriter(tmp_path / "two.mcap") as writer:
        for vehicle, array in (("1", POSITIONS), ("2", HOME)):
            definition = MESSAGES["VehicleLocalPosition" if vehicle == "1" else "HomePosition"]
            address = Address(vehicle, next(iter(definition.topics)))
            writer.write(
                array,
                definition,
                repeat((address, Provenance())),
                logged=[1] * len(array),
                published=repeat(1),
            )
    with pytest.raises(
        AddressError, match=r"vehicle '\*' is not valid: expected one vehicle of .*: 1, 2"
    ):
        nedbus.read(tmp_path / "two.mcap", ["*"])
    with pytest.raises(AddressError, match=r"vehicle '\*' is not valid"):
        nedbus.utc_of(tmp_path / "two.mcap")


@pytest.mark.parametrize("wrong", [{"topics": [VLP, "nope"]}, {"on": "nope"}, {"topics": ["nope"]}])
def test_unknown_stream_is_one_error_with_the_streams_of_the_file(
    tmp_path: Path, wrong: Any
) -> None:
    """An unknown stream raises one error without a chained one; it lists all known streams of the file."""
    path = write(tmp_path / "a.mcap", {VLP: POSITIONS, "home_position": HOME})
    with pytest.raises(
        AddressError, match=r"topic '.*nope' is not in .*: expected one of .*"
    ) as raised:
        nedbus.align(path, **wrong)
    assert f"1/home_position, 1/{VLP}" in str(raised.value)
    assert raised.value.__cause__ is None
    assert raised.value.__suppress_context__ or raised.value.__context__ is None


def test_rows_may_be_those_of_a_message_that_only_the_file_defines(tmp_path: Path) -> None:
    """`on` accepts each stream of a file, without `topics` too."""
    definition = define_msg("Gripper", "uint64 timestamp\nfloat32 width\n")
    grips = arrays_of(definition).of(
        [definition.model.model_validate({"timestamp": 1_150_000, "width": 0.5})]
    )
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        for topic, kind, array in (
            (VLP, definition_of(VLP), POSITIONS),
            ("gripper", definition, grips),
        ):
            addresses = repeat((Address("1", topic), Provenance()))
            writer.write(array, kind, addresses, logged=[1] * len(array), published=repeat(1))
    table = nedbus.align(path, on="gripper")
    assert table["gripper.width"].tolist() == [0.5]
    assert table[f"{VLP}.x"].tolist() == [1.0]


@pytest.mark.parametrize("wild", [10**11, 9 * 10**18])
@pytest.mark.parametrize("index", [0, 20, 40])
def test_single_wild_timestamp_does_not_extend_a_table(wild: int, index: int) -> None:
    """At a rate, the rows span the messages without a few wild timestamps."""
    positions = np.repeat(POSITIONS, 10)[:41]
    positions["timestamp"] = 1_000_000 + 100_000 * np.arange(41)
    positions["timestamp"][index] = wild
    assert 40 <= len(nedbus.align({VLP: positions}, on=10.0)) <= 41


@pytest.mark.slow
def test_data_frames_have_nulls_and_utc(tmp_path: Path) -> None:
    """Values before the first message are null, arrays have a column per element, and `utc` has a time zone."""
    pytest.importorskip("pandas")
    pl = pytest.importorskip("polars")
    gps = array_of(
        "sensor_gps",
        {"timestamp": 1_100_000, "time_utc_usec": BOOT + 1_100_000, "satellites_used": 9},
    )
    attitude = array_of("vehicle_attitude", {"timestamp": 1_100_000, "q": yaw(1.0)})
    path = write(
        tmp_path / "a.mcap", {VLP: POSITIONS, "sensor_gps/0": gps, "vehicle_attitude": attitude}
    )
    in_pandas = nedbus.align(path, dataframe="pandas", utc=True)
    in_polars = nedbus.align(path, dataframe="polars", utc=True)
    assert list(in_pandas.columns) == in_polars.columns
    assert in_polars["sensor_gps/0.satellites_used"].to_list() == [None, 9, 9, 9, 9]
    assert in_pandas["sensor_gps/0.satellites_used"].isna().tolist() == [True] + [False] * 4
    assert in_pandas["vehicle_attitude.q[3]"].iloc[1] == np.float32(math.sin(0.5))
    assert in_polars["utc"].dtype == pl.Datetime("us", "UTC")
    assert (
        in_pandas["utc"].iloc[1]
        == in_polars["utc"][1]
        == datetime.fromtimestamp(BOOT / 1e6 + 1.1, UTC)
    )
    assert nedbus.utc_of(path) == nedbus.UtcOffset("sensor_gps/0", BOOT, 1, 0)
    assert np.isnat(nedbus.align({VLP: POSITIONS}, utc=True)["utc"]).all()


@pytest.mark.slow
def test_fields_that_a_message_lacks_are_null_in_a_table(tmp_path: Path) -> None:
    """In a table of streams, a field is null in the rows whose message lacks it, as in the data frame of a stream."""
    pytest.importorskip("polars")
    address, path = Address("1", VLP), tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        for number in range(4):
            missing = frozenset({"xy_valid", "x"} if number in (1, 2) else ())
            writer.write_messages(
                [(message(1_000_000 + number), address, Provenance("sim", missing), number)]
            )
    table = nedbus.align(path, dataframe="polars")
    assert table[f"{VLP}.xy_valid"].to_list() == [False, None, None, False]
    assert table[f"{VLP}.x"].is_null().to_list() == [False, True, True, False]
    assert nedbus.align(path, on=[999_999, 1_000_000], dataframe="polars")[
        f"{VLP}.xy_valid"
    ].to_list() == [None, False]


def test_utc_comes_from_gnss_then_companion_clock() -> None:
    """UTC comes from GNSS, else from a companion's Unix clock; zeros and inconsistent offsets are ignored."""
    times = range(1_000_000, 11_000_000, 1_000_000)
    gnss = array_of(
        "sensor_gps",
        *(
            {
                "timestamp": t,
                "timestamp_time_relative": -200,
                "time_utc_usec": BOOT + t - 200 + t % 7,
            }
            for t in times
        ),
    )
    silent = array_of("sensor_gps", *({"timestamp": t} for t in times))
    companion = array_of(
        "timesync_status", *({"timestamp": t, "estimated_offset": -BOOT - 5} for t in times)
    )
    monotonic = array_of(
        "timesync_status", *({"timestamp": t, "estimated_offset": -12_345} for t in times)
    )
    found = nedbus.utc_of({"sensor_gps/0": gnss, "timesync_status": companion})
    assert found is not None
    assert (found.source, found.count) == ("sensor_gps/0", 10)
    assert 0 <= found.offset_us - BOOT <= found.spread_us <= 6
    assert found.at(5) == datetime.fromtimestamp(0, UTC) + timedelta(
        microseconds=found.offset_us + 5
    )
    assert nedbus.utc_of(
        {"sensor_gps/0": silent, "timesync_status": companion}
    ) == nedbus.UtcOffset("timesync_status", BOOT + 5, 10, 0)
    assert nedbus.utc_of({"sensor_gps/0": silent, "timesync_status": monotonic}) is None
    rebooted = gnss.copy()
    rebooted["time_utc_usec"][5:] += 3_600_000_000
    assert nedbus.utc_of({"sensor_gps/0": rebooted}) is None
    assert nedbus.utc_of({}) is None
    without = [name for name in gnss.dtype.names or () if name != "timestamp_time_relative"]
    assert nedbus.utc_of({"sensor_gnss_relative": gnss[without]}) is not None


def gnss_with(offsets: Sequence[int], times: Sequence[int] = ()) -> MessageArray:
    """Return messages of a receiver each second, with these errors of UTC [us]."""
    stamps = times or [1_000_000 * number for number in range(1, len(offsets) + 1)]
    pairs = zip(stamps, offsets, strict=True)
    return array_of(
        "sensor_gps", *({"timestamp": t, "time_utc_usec": BOOT + t + off} for t, off in pairs)
    )


_OFF = 2_000_000


@pytest.mark.parametrize(
    ("offsets", "corrected"),
    [
        ([_OFF] + [0] * 9, 0),  # over 90 % agree
        ([_OFF] * 2 + [0] * 8, -_OFF),
        ([-18_000_000] * 30 + [_OFF] * 10 + [0] * 30, -_OFF),
        ([_OFF] * 20 + [0] * 20 + [10**13] + [0] * 19, -_OFF),  # one wild value
        ([0] * 8 + [_OFF] * 3 + [0], None),
        ([-(10**11)] + [_OFF] * 20 + [0] * 20, -_OFF),  # a wild first value
        ([0, 5_000_000, 10_000_000], None),
        ([_OFF, 0] * 10, None),  # two receivers in one stream
        ([300_000 * number for number in range(40)], None),  # a drift
        ([30_000_000] * 20 + [0] * 20, None),  # another boot
        (sorted([-18_000_000, -12_000_000, -6_000_000, 0] * 20), None),  # three corrections
        ([0] * 10 + [_OFF] * 2, None),  # two messages do not confirm a correction
    ],
)
def test_utc_after_a_correction_holds(offsets: Sequence[int], corrected: int | None) -> None:
    """A receiver that corrects its UTC by up to 20 s has the later one; drifting or mixed times have none."""
    found = find_utc({"sensor_gps/0": gnss_with(offsets)})
    if corrected is None:
        assert isinstance(found, str)
        assert found.startswith("the UTC of sensor_gps/0 varies by ")
    else:
        assert isinstance(found, nedbus.UtcOffset)
        assert (found.source, found.offset_us, found.corrected_us) == (
            "sensor_gps/0",
            BOOT,
            corrected,
        )


def test_utc_of_two_boots_is_unknown() -> None:
    """Timestamps that start anew are another boot, whose offset does not correct that of the first."""
    times = [*range(1_000_000, 11_000_000, 1_000_000)] * 2
    assert isinstance(
        find_utc({"sensor_gps/0": gnss_with([0] * 10 + [15_000_000] * 10, times)}), str
    )


@pytest.mark.parametrize(
    ("shift", "is_used"), [(0, True), (9_000_000, True), (5_000_000_000, False)]
)
def test_utc_of_a_source_on_another_clock_is_not_used(shift: int, is_used: bool) -> None:
    """A receiver whose timestamps do not overlap those of the other messages cannot date them."""
    gnss, positions = gnss_with([0] * 10), np.repeat(POSITIONS, 2)
    positions["timestamp"] = np.linspace(1e6, 10e6, len(positions)) + shift
    positions["timestamp"][3] = 2**62  # one wild value
    found = find_utc({"sensor_gps/0": gnss, VLP: positions})
    assert isinstance(found, nedbus.UtcOffset) == is_used
    if isinstance(found, str):
        assert (
            found
            == "the timestamps of sensor_gps/0, which has UTC, are not on the clock of the other messages"
        )


def test_utc_is_derived_from_live_samples(bus: nedbus.Bus) -> None:
    """The last samples of a live vehicle are enough to derive its UTC; without a GNSS time the result is None."""
    for vehicle, utc in (("7", 1_700_000_000_000_000), ("8", 0)):
        gps = bus.publisher("sensor_gps", vehicle=vehicle, instance=1)
        gps.publish({"timestamp": 5_000_000, "time_utc_usec": utc})
        bus.publisher("vehicle_attitude", vehicle=vehicle).publish({"timestamp": 6_000_000})
    found = nedbus.utc_of(bus.latest("*", vehicle="7"))
    assert found is not None
    assert (found.source, str(found.at(6_000_000))) == ("sensor_gps/1", "2023-11-14 22:13:21+00:00")
    assert nedbus.utc_of(bus.latest("*", vehicle="8")) is None


@pytest.mark.parametrize(("late", "is_restart"), [(1, False), (2, False), (6, True), (20, True)])
def test_more_than_one_percent_of_earlier_timestamps_are_a_restart(
    late: int, *, is_restart: bool
) -> None:
    """Up to 1 % of the messages may be out of order; more of them are those of another boot, which raises."""
    stamps = [10_000_000 + 10_000 * number for number in range(200 - late)] + [
        10_000 * number for number in range(late)
    ]
    arrays = {VLP: array_of(VLP, *({"timestamp": stamp} for stamp in stamps))}
    if is_restart:
        with pytest.raises(ConfigError, match="timestamps step back"):
            nedbus.align(arrays)
    else:
        assert len(nedbus.align(arrays)) == 200


@pytest.mark.parametrize(("wild", "rows"), [(45_000_000, 441), (500_000_000, 100)])
def test_wild_timestamp_does_not_extend_a_table(wild: int, rows: int) -> None:
    """A rate fills the time of the messages; one timestamp far beyond the others is left out."""
    stamps = [1_000_000 + 100_000 * number for number in range(100)]
    arrays = {VLP: array_of(VLP, *({"timestamp": stamp} for stamp in (*stamps, wild)))}
    assert len(nedbus.align(arrays, on=10.0)) == rows
