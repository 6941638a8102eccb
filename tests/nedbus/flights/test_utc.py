"""Clocks of timestamps in a log and a recording, and the vehicle of input topics."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import pytest

import nedbus
from nedbus.flights import RecordingWriter, read_file_events
from nedbus.timeline import UtcEstimate
from nedbus_msgs import DEFAULT_TOPIC, Address, Provenance, is_unix_time
from tests.flights.messages import VLP, message
from tests.flights.replays import convert_replay, open_replay

DATA: Final = Path(__file__).parents[2] / "data"
UNIX: Final = DATA / "uxrce_unix_time.mcap"
BOOT: Final = DATA / "boot_time_utc_us.ulg"
BOOT_UTC: Final = 1_700_000_000_000_000  # us
INPUTS: Final = DATA / "fmu_in_topics.mcap"


@pytest.mark.parametrize(
    ("path", "utc", "source"),
    [
        (UNIX, "2025-10-09 08:53:19.997000", "timestamp"),
        (BOOT, "2025-09-08 13:31:04", "boot_time_utc_us"),
    ],
)
def test_utc_of_a_recording_is_the_same_everywhere(path: Path, utc: str, source: str) -> None:
    """`utc_of`, `align` and events give the same UTC, from Unix timestamps or from the boot time in a log."""
    found = nedbus.utc_of(path)
    assert found is not None
    first = nedbus.read(path)["timestamp"][0]
    assert (found.source, str(found.at(first))) == (source, f"{utc}+00:00")
    assert nedbus.align(path, utc=True)["utc"][0] == np.datetime64(utc.replace(" ", "T"))
    event: Any = SimpleNamespace(vehicle="1", boot=first / 1e6)
    assert read_file_events(path).times.utc(event) == pytest.approx(found.unix_us(int(first)) / 1e6)


def test_conversion_keeps_the_boot_time(tmp_path: Path) -> None:
    """A recording converted from a log keeps the UTC of the log's metadata."""
    convert_replay(f"ulog:{BOOT}", tmp_path / "a.mcap")
    assert nedbus.utc_of(tmp_path / "a.mcap") == nedbus.utc_of(BOOT)


@pytest.mark.parametrize("boots", [(BOOT_UTC, BOOT_UTC), (BOOT_UTC, BOOT_UTC + 1), (BOOT_UTC, 0)])
def test_files_of_a_bag_share_one_boot(tmp_path: Path, boots: tuple[int, int]) -> None:
    """The UTC of a bag comes from the boot time in its files, unless two files name different boots."""
    for number, boot in enumerate(boots):
        with RecordingWriter(tmp_path / f"a_{number}.mcap", boot_utc=boot) as writer:
            writer.write_messages([(message(number + 1), Address("1", VLP), Provenance(), 1)])
    is_known = 0 in boots or boots[0] == boots[1]
    expected = nedbus.UtcOffset("boot_time_utc_us", BOOT_UTC, 1, 0) if is_known else None
    assert nedbus.utc_of(tmp_path) == expected


def test_mixed_clocks_are_distinguished_per_timestamp() -> None:
    """In a stream with both clocks, Unix timestamps are converted to UTC, and times since boot to NaT."""
    messages = nedbus.read(UNIX)
    # before the time is synchronized
    messages["timestamp"][:100] = np.arange(100) * 20_000 + 1_000_000
    table = nedbus.align({DEFAULT_TOPIC: messages}, utc=True)
    assert np.isnat(table["utc"][:100]).all()
    assert is_unix_time(table["utc"][100:].astype(np.int64)).all()


def test_input_topics_belong_to_their_vehicle() -> None:
    """/fmu/in/... in an offboard bag belongs to the vehicle of /fmu/out/..., and has the source mcap-input."""
    inputs = {"offboard_control_mode", "trajectory_setpoint", "vehicle_visual_odometry"}
    assert {name: len(each) for name, each in nedbus.read(INPUTS, ["*"]).items()} == dict.fromkeys(
        inputs | {DEFAULT_TOPIC}, 50
    )
    messages = list(open_replay(f"mcap:{INPUTS}?vehicle=7&topics=*").messages)
    assert {each.address.vehicle for each in messages} == {"7"}
    assert {each.address.topic for each in messages if each.source == "mcap-input"} == inputs
    assert nedbus.utc_of(INPUTS) is None
    assert len(nedbus.align(INPUTS)) == 50


def test_damaged_timestamp_leaves_the_utc_known(tmp_path: Path) -> None:
    """A timestamp beyond 63 bits is an outlier like others, in a file as in its arrays."""
    path, address = tmp_path / "a.mcap", Address("1", "sensor_gps", 0)
    times = [1_000_000 * index for index in range(1, 20)]
    with RecordingWriter(path) as writer:
        for time in (*times, 2**63 + 5):
            utc = BOOT_UTC + min(time, 20_000_000)
            sent = nedbus.SensorGps.model_validate({"timestamp": time, "time_utc_usec": utc})
            writer.write_messages([(sent, address, Provenance(), 1000 * utc)])
    found = nedbus.utc_of(path)
    assert found is not None
    assert (found.offset_us, found.count) == (BOOT_UTC, 19)
    assert nedbus.utc_of(nedbus.read(path, ["*"])) == found


def test_most_timestamps_of_all_streams_decide_their_clock() -> None:
    """Without a stream with UTC, timestamps are Unix times if most of those of all streams are, not of the first."""
    estimate = UtcEstimate()
    estimate.add("first", {"timestamp": np.arange(3) + 1_000_000})
    estimate.add("second", {"timestamp": np.arange(1000) * 1_000_000 + 1_700_000_000_000_000})
    assert estimate.result() == nedbus.UtcOffset("timestamp", 0, 1000, 0)


def gnss_sample(vehicle: str, offset: int, *, missing: frozenset[str] = frozenset()) -> Any:
    """Return a message of a receiver; `offset`: its UTC minus its timestamp [us]."""
    fields = {"timestamp": 1_000_000, "time_utc_usec": offset + 1_000_000}
    sent = nedbus.SensorGps.model_validate(fields)
    provenance = Provenance("mavlink", missing)
    return nedbus.Sample(sent, Address(vehicle, "sensor_gps", 0), 0, provenance=provenance)


def test_utc_of_samples_is_that_of_the_vehicle_and_of_provided_fields() -> None:
    """Samples of other vehicles do not count, and a field that the source does not provide is no UTC."""
    samples = [gnss_sample("1", BOOT_UTC), gnss_sample("2", BOOT_UTC + 5_000_000)]
    found = nedbus.utc_of(samples, vehicle="2")
    assert found is not None
    assert found.offset_us == BOOT_UTC + 5_000_000
    assert nedbus.utc_of([gnss_sample("1", BOOT_UTC, missing=frozenset({"time_utc_usec"}))]) is None


def test_open_flight_has_the_utc_of_a_short_file(tmp_path: Path) -> None:
    """The UTC of an open flight, which its first pass notes on the way, is that of `utc_of`."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        for number in range(10):
            sample = gnss_sample("1", BOOT_UTC)
            writer.write_messages([(sample.message, sample.address, Provenance(), number)])
    with nedbus.open(path) as flight:
        assert flight.utc == nedbus.utc_of(path)
        assert flight.utc is not None
