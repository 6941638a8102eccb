"""Flights as arrays and as pictures."""

from __future__ import annotations

import sys
import tracemalloc
from itertools import repeat
from pathlib import Path

import numpy as np
import pandas as pd
import polars as pl
import pytest

import nedbus
from nedbus.errors import AddressError, ConfigError, SourceError
from nedbus.recorder import convert
from nedbus.recording import Recording
from nedbus_msgs import FIELD_TYPES, Address, Origin, VehicleLocalPosition, upgrade
from nedbus_msgs.arrays import DTYPE, to_message, to_records
from tests.conftest import LOGS, Start, message
from tests.replays import open_replay

VLP = "vehicle_local_position"
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """Return a recording of a simulated flight."""
    path = tmp_path / "flight.mcap"
    convert(open_replay("sim:?duration=20"), path, source="sim", on_progress=lambda _: None)
    return path


def test_recording_is_an_array(flight: Path) -> None:
    """Every message, in order, with PX4's own types."""
    records = nedbus.read(flight)
    flown = open_replay("sim:?duration=20").records
    expected = [upgrade(record.fields) for record in flown if record.address.topic == VLP]
    assert records.dtype == DTYPE
    assert len(records) == len(expected) == 2000
    assert all(to_message(record) == each for record, each in zip(records[::100], expected[::100], strict=True))
    assert nedbus.read(flight, "estimator_local_position", instance=1)["timestamp"][0] == records["timestamp"][0]


@pytest.mark.logs
@pytest.mark.parametrize("log", sorted(LOGS.glob("*.ulg")), ids=lambda path: path.stem)
def test_real_log_is_an_array(log: Path) -> None:
    """Each stream of a real log has the messages that a replay of it has, to the bit."""
    expected: dict[Address, list[VehicleLocalPosition]] = {}
    for record in open_replay(f"ulog:{log}").records:
        expected.setdefault(record.address, []).append(upgrade(record.fields))
    assert nedbus.addresses_of(log) == sorted(expected)
    for address, messages in expected.items():
        records = nedbus.read(log, address.topic, instance=address.instance)
        assert records.tobytes() == to_records(messages).tobytes()


def test_frames_have_named_columns(flight: Path) -> None:
    """A data frame of either kind has all columns, with the same values and types."""
    records = nedbus.read(flight)
    panda = nedbus.read(flight, frame="pandas")
    bear = nedbus.read(flight, frame="polars")
    assert isinstance(panda, pd.DataFrame)
    assert isinstance(bear, pl.DataFrame)
    assert list(panda.columns) == bear.columns
    assert len(bear.columns) == len(FIELD_TYPES) + 2
    assert panda["x"].dtype == np.float32
    assert bear["timestamp"].dtype == pl.UInt64
    assert np.array_equal(panda["delta_xy[1]"], records["delta_xy"][:, 1], equal_nan=True)
    assert np.array_equal(bear["ref_lat"].to_numpy(), records["ref_lat"], equal_nan=True)


def test_broken_messages_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """What breaks a rule is no estimate; the log says how many there were."""
    path = tmp_path / "a.mcap"
    records = to_records([message(1), message(2), message(3)])
    records["xy_valid"][1] = True
    with Recording(path) as recording:
        recording.write(records, repeat((Address("1", VLP), Origin())), logged=[1, 2, 3], published=[1, 2, 3])
    assert nedbus.read(path)["timestamp"].tolist() == [1, 3]
    assert "1 of 3 messages break the rules" in caplog.text


def test_what_is_meant_must_be_clear(flight: Path, tmp_path: Path) -> None:
    """Several streams are not mixed, and what is not there is named with what is."""
    with pytest.raises(AddressError, match="name vehicle and instance too"):
        nedbus.read(flight, "estimator_local_position")
    with pytest.raises(AddressError, match=f"which has 1/estimator_local_position/0, .*1/{VLP}"):
        nedbus.read(flight, vehicle="2")
    with pytest.raises(SourceError, match="no such file"):
        nedbus.read(tmp_path / "none.ulg")


def test_large_recording_is_not_loaded_whole(tmp_path: Path) -> None:
    """Reading one stream of many takes the memory of that stream, not that of the file."""
    path = tmp_path / "large.mcap"
    rng = np.random.default_rng(0)
    noise = to_records([message(0)] * 1000)
    with Recording(path) as recording:
        for chunk in range(60):
            for name in ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "heading_var", "tilt_var"):
                noise[name] = rng.random(1000)
            noise["timestamp"] = np.arange(1000) + chunk * 1000
            times = list(range(1000))
            for vehicle in ("1", "2"):
                rows = noise if vehicle == "1" else noise[:10]
                recording.write(rows, repeat((Address(vehicle, VLP), Origin())), logged=times, published=times)
            recording.flush()
    assert path.stat().st_size > 2_000_000
    nedbus.read(path, vehicle="2")
    tracemalloc.start()
    records = nedbus.read(path, vehicle="2")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(records) == 600
    assert peak < 2_000_000, f"{peak} bytes for {path.stat().st_size}"


def test_missing_extra_says_what_to_install(flight: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without pandas, or without mcap, one line says what to do."""
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ConfigError, match=r"pandas: this is not installed: pip install pandas"):
        nedbus.read(flight, frame="pandas")
    monkeypatch.delitem(sys.modules, "nedbus.playback")
    monkeypatch.setitem(sys.modules, "mcap.reader", None)
    with pytest.raises(ConfigError, match=r"mcap: this is not installed: pip install 'nedbus\[mcap\]'"):
        nedbus.read(flight)


@pytest.mark.parametrize("arguments", [[], ["-t", "*"], ["-t", "estimator_local_position", "-i", "1"]])
def test_flight_is_drawn(run_nedbus: Start, flight: Path, arguments: list[str]) -> None:
    """One stream or several become a picture beside the flight."""
    plot = run_nedbus("plot", str(flight), *arguments)
    assert plot.wait(60) == 0, plot.err
    picture = flight.with_suffix(".png")
    assert plot.out.strip() == str(picture)
    assert picture.read_bytes().startswith(PNG)
    assert picture.stat().st_size > 20_000


def test_what_cannot_be_drawn_is_said(run_nedbus: Start, flight: Path) -> None:
    """A vehicle that is not there, and a place where no picture can be."""
    plot = run_nedbus("plot", str(flight), "-v", "9")
    assert plot.wait() == 2
    assert "expected one of 1/estimator_local_position/0" in plot.err
    plot = run_nedbus("plot", str(flight), "-o", "/nowhere/a.png")
    assert plot.wait(60) == 1
    assert "cannot be written" in plot.err
