"""All topics of real logs: arrays, replays and recordings equal the data that pyulog reads."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pytest
from pyulog import ULog

import nedbus
from nedbus_msgs import BY_TOPIC, MESSAGES, TOPICS, upgrade_with
from nedbus_msgs.arrays import MessageArray, arrays_of
from tests.flights.replays import convert_replay, open_recording, open_replay
from tests.flights.ulogs import LOGS
from tests.peers.command_line import run_command
from tests.peers.processes import Start
from tests.waits import DEADLINE

STREAMS: Final = {  # addresses, messages
    "gps_loss": (7, 26775),
    "twelve_messages": (27, 46863),
    "cuav_1.16_gps_interference": (95, 42253),
    "cubeorange_1.12_small": (70, 14604),
    "fmuv6c_1.17_selector_whipsaw": (7, 16301),
    "nxp_v0_ekf_failure": (86, 48847),
    "sitl_1.13_three_topics": (96, 21229),
    "sitl_1.15_events": (69, 29480),
}
CONVERTED: Final = {  # fields of older layouts, converted as PX4's source code does
    "lat": ("latitude_deg", 1e7),
    "lon": ("longitude_deg", 1e7),
    "alt": ("altitude_msl_m", 1e3),
    "alt_ellipsoid": ("altitude_ellipsoid_m", 1e3),
}
DROPPED: Final = {  # fields of older layouts that PX4 removed; the model does not have them
    "battery_status": {"run_time_to_empty", "average_current_a"},
    "vehicle_land_detected": {"alt_max"},
    "vehicle_status": {"rc_input_mode"},
    "vehicle_gps_position": {"selected"},
}
FLIGHTS: Final = [next(LOGS.parent.glob(f"*/{name}.ulg"), LOGS / f"{name}.ulg") for name in STREAMS]
UTC: Final = {  # source of UTC, and the time of the boot
    "gps_loss": ("boot_time_utc_us", "2026-11-21T20:31:26"),
    "fmuv6c_1.17_selector_whipsaw": ("boot_time_utc_us", "2026-04-08T16:21:05"),
    "twelve_messages": ("timesync_status", "2026-11-22T23:08:32"),
    "cuav_1.16_gps_interference": ("timesync_status", "2026-01-13T05:53:53"),
    "cubeorange_1.12_small": ("vehicle_gps_position", "2021-04-21T06:30:38"),
    "nxp_v0_ekf_failure": ("sensor_gps/0", "2025-02-10T13:55:42"),
    "sitl_1.13_three_topics": ("sensor_gps/0", "2022-04-29T08:45:26"),
    "sitl_1.15_events": ("timestamp", "1970-01-01T00:00:00"),  # Unix time already
}

pytestmark = [
    pytest.mark.logs,
    pytest.mark.usefixtures("long_lookup_timeout"),
    pytest.mark.skipif(not LOGS.exists(), reason=f"no real logs: {LOGS} does not exist"),
]
each_flight = pytest.mark.parametrize("flight", FLIGHTS, ids=lambda path: path.stem)


def raw_streams(flight: Path) -> dict[str, Mapping[str, npt.NDArray[Any]]]:
    """Return the streams of a log as pyulog reads them, with nedbus stream names as keys."""
    log = ULog(str(flight))
    found: dict[str, Mapping[str, npt.NDArray[Any]]] = {}
    for data in log.data_list:
        has_instances = TOPICS[data.name].instances if data.name in TOPICS else data.multi_id > 0
        found[f"{data.name}/{data.multi_id}" if has_instances else data.name] = data.data
    return found


def compare(stream: str, raw: Mapping[str, npt.NDArray[Any]], array: MessageArray) -> int:
    """Assert that messages have the values of a log in all fields; return the number of compared values."""
    topic, compared = stream.partition("/")[0], 0
    for column, values in raw.items():
        *outer, last = re.sub(r"\[(\d+)\](?=.*\.)", r"_\1", column).split(".")
        name, _, index = last.partition("[")
        name = "_".join([*outer, name])
        if last.startswith("_padding"):
            continue
        expected, fields = values, [name]
        if topic in BY_TOPIC:
            if name in CONVERTED and MESSAGES["SensorGps"] is BY_TOPIC[topic]:
                field, scale = CONVERTED[name]
                expected, fields = values / scale, [field]
            elif name not in BY_TOPIC[topic].types:
                fields = list(BY_TOPIC[topic].plan((name,)).provided)
                assert fields or name in DROPPED[topic], (stream, column)
        for field in fields:
            ours = array[field]
            if ours.dtype.kind == "S":  # pyulog returns a string as an array of characters
                ours = np.ascontiguousarray(ours).view(np.uint8).reshape(len(array), -1)
            ours = ours[:, int(index[:-1])] if index else ours
            if ours.dtype.kind == "b":  # PX4 leaves some uninitialized, with any byte
                expected = expected.astype(bool)
            assert ours.tobytes() == expected.astype(ours.dtype).tobytes(), (stream, column)
            assert np.array_equal(ours, expected, equal_nan=expected.dtype.kind == "f"), (
                stream,
                column,
            )
            compared += len(ours)
    return compared


TEXTS = "log_message"


@pytest.mark.slow
@each_flight
def test_arrays_of_a_log_equal_pyulog(flight: Path) -> None:
    """`nedbus.read` returns all topics of a log bit for bit."""
    raw, arrays = raw_streams(flight), nedbus.read(flight, ["*"])
    arrays.pop(TEXTS)  # nedbus derives this topic from texts and events; pyulog does not have it
    assert arrays.keys() == raw.keys()
    compared = 0
    for stream, array in arrays.items():
        assert len(array) == len(raw[stream]["timestamp"]), stream
        compared += compare(stream, raw[stream], array)
    assert compared > 100_000


@pytest.mark.long
@each_flight
def test_replay_of_a_log_equals_its_arrays(flight: Path) -> None:
    """A replay delivers all messages in the arrays."""
    run = open_replay(f"ulog:{flight}?topics=*")
    arrays = nedbus.read(flight, ["*"])
    messages: dict[str, list[Any]] = {}
    total = 0
    for each in run.messages:
        total += 1
        message = upgrade_with(each.definition or BY_TOPIC[each.address.topic], each.fields)
        messages.setdefault(each.address.stream, []).append(message)
    assert (len(run.addresses) - 1, total - len(arrays[TEXTS])) == STREAMS[flight.stem]
    assert run.damage is None
    assert messages.keys() == {stream for stream, array in arrays.items() if len(array)}
    for stream, found in messages.items():
        assert arrays_of(found[0].DEFINITION).of(found).tobytes() == arrays[stream].tobytes(), (
            stream
        )


@pytest.mark.long
@each_flight
def test_replayed_log_reaches_another_process(
    flight: Path, run_nedbus: Start, endpoint: str, bus: nedbus.Bus
) -> None:
    """A reader receives all topics of a log through daemon and router, complete and equal to the arrays."""
    arrays = {stream: array for stream, array in nedbus.read(flight, ["*"]).items() if len(array)}
    messages: dict[str, list[Any]] = {}
    with bus.subscribe("*", mode="every") as subscription:
        source = f"ulog:{flight}?topics=*&speed=max&wait=1"
        service = run_nedbus("serve", "--connect", endpoint, "--until-done", "--source", source)
        for _ in range(STREAMS[flight.stem][1] + len(arrays[TEXTS])):
            sample = subscription.receive(DEADLINE)
            messages.setdefault(sample.address.stream, []).append(sample.message)
        assert service.wait() == 0, service.err
        assert (subscription.counts.lost, subscription.counts.invalid) == (0, 0)
    assert messages.keys() == arrays.keys()
    for stream, found in messages.items():
        assert arrays_of(found[0].DEFINITION).of(found).tobytes() == arrays[stream].tobytes(), (
            stream
        )
    assert "0 rejected" in service.err


@pytest.mark.long
@each_flight
def test_converted_log_equals_the_original(flight: Path, tmp_path: Path) -> None:
    """A converted recording has every message of every topic in the log, and lists the same fields as missing."""
    path = tmp_path / "flight.mcap"
    convert_replay(f"ulog:{flight}?topics=*", path)
    before, after = nedbus.read(flight, ["*"]), nedbus.read(path, ["*"])
    assert after.keys() == {stream for stream, array in before.items() if len(array)}
    for stream, array in after.items():
        assert array.tobytes() == before[stream].tobytes(), stream
        assert nedbus.missing_of(array) == nedbus.missing_of(before[stream]), stream
    assert nedbus.utc_of(path) == nedbus.utc_of(flight)
    with open_recording(path) as reader:
        for recorded in reader.counts:
            provided = recorded.definition.all_fields - recorded.lacking
            assert recorded.layout is recorded.definition.recorded_layout(provided)


@each_flight
def test_utc_is_derived_from_a_log(flight: Path) -> None:
    """UTC comes from GNSS, a companion computer's clock, the log's information messages or Unix timestamps."""
    found = nedbus.utc_of(flight)
    source_and_time = found and (found.source, f"{found.at(0):%Y-%m-%dT%H:%M:%S}")
    assert source_and_time == UTC.get(flight.stem)
    assert found is None or found.spread_us < 1_000_000


@pytest.mark.slow
@each_flight
def test_aligned_table_has_all_topics(flight: Path) -> None:
    """Each row of an aligned table has the latest values of all topics at the time of a position."""
    raw = raw_streams(flight)
    table = nedbus.align(flight, topics=["*"], utc=True)
    assert len(table) == len(raw["vehicle_local_position"]["timestamp"])
    columns = table.dtype.names or ()
    assert {name.removesuffix(".age") for name in columns if name.endswith(".age")} == {*raw, TEXTS}
    compared = 0
    for stream, values in raw.items():
        order = np.argsort(values["timestamp"], kind="stable")
        rows = np.searchsorted(values["timestamp"][order], table["timestamp"], side="right") - 1
        rows, has_one = order[rows], rows >= 0
        if stream == "vehicle_local_position":
            # each of its messages is a row
            rows, has_one = np.arange(len(table)), np.ones(len(table), bool)
        assert np.array_equal(np.isnan(table[f"{stream}.age"]), ~has_one), stream
        for column, logged in values.items():
            if f"{stream}.{column}" in columns:
                ours = table[f"{stream}.{column}"]
                assert np.array_equal(
                    ours[has_one], logged[rows].astype(ours.dtype)[has_one], equal_nan=True
                ), column
                compared += 1
    assert compared > len(raw)


@pytest.mark.slow
def test_plot_of_topic_without_track_fails(tmp_path: Path) -> None:
    """`nedbus plot` of a topic other than a position is a usage error that names the topic."""
    plot = run_command(
        "plot", str(FLIGHTS[0]), "-t", "vehicle_attitude", "-o", str(tmp_path / "a.png")
    )
    assert plot.exit_code == 2
    assert "vehicle_attitude has no track" in plot.err


@pytest.mark.long
def test_plot_of_all_topics_draws_positions(tmp_path: Path) -> None:
    """With `-t "*"`, `nedbus plot` draws the topics that have a track."""
    drawn = run_command(
        "plot",
        str(LOGS.parent / "px4" / "twelve_messages.ulg"),
        "-t",
        "*",
        "-o",
        f"{tmp_path}/a.png",
    )
    assert drawn.exit_code == 0, drawn.err
