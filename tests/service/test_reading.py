"""Logs and recordings as arrays, as data frames and as plots."""

from __future__ import annotations

import re
import sys
import tracemalloc
from itertools import repeat
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import polars as pl
import pytest
from matplotlib.image import imread

import nedbus
from nedbus.errors import AddressError, ConfigError, OutputError, SourceError
from nedbus.recording import RecordingWriter, draw
from nedbus_msgs import FIELD_TYPES, Address, Provenance, VehicleLocalPosition, upgrade
from nedbus_msgs.arrays import DTYPE, to_array, to_message
from tests.conftest import LOGS, Start, message
from tests.replays import convert_replay, open_replay

VLP = "vehicle_local_position"
COLORS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#8c564b", "#e377c2")  # of the streams of a plot, in order


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """Return a recording of a simulated flight."""
    path = tmp_path / "flight.mcap"
    convert_replay("sim:?duration=20", path)
    return path


def test_recording_is_an_array(flight: Path) -> None:
    """Every message, in order, with PX4's own types."""
    array = nedbus.read(flight)
    messages = open_replay("sim:?duration=20").messages
    expected = [upgrade(each.fields) for each in messages if each.address.topic == VLP]
    assert array.dtype == DTYPE
    assert len(array) == len(expected) == 2000
    assert all(to_message(element) == each for element, each in zip(array[::100], expected[::100], strict=True))
    assert nedbus.read(flight, "estimator_local_position", instance=1)["timestamp"][0] == array["timestamp"][0]


@pytest.mark.logs
@pytest.mark.parametrize("log", sorted(LOGS.glob("*.ulg")), ids=lambda path: path.stem)
def test_real_log_is_an_array(log: Path) -> None:
    """Each stream of a real log has the messages that a replay of it has, to the bit."""
    expected: dict[Address, list[VehicleLocalPosition]] = {}
    for each in open_replay(f"ulog:{log}").messages:
        expected.setdefault(each.address, []).append(upgrade(each.fields))
    assert nedbus.addresses_of(log) == sorted(expected)
    for address, messages in expected.items():
        array = nedbus.read(log, address.topic, instance=address.instance)
        assert array.tobytes() == to_array(messages).tobytes()


def test_frames_have_named_columns(flight: Path) -> None:
    """A data frame of either package has all columns, with the same values and types."""
    array = nedbus.read(flight)
    panda = nedbus.read(flight, frame="pandas")
    bear = nedbus.read(flight, frame="polars")
    assert isinstance(panda, pd.DataFrame)
    assert isinstance(bear, pl.DataFrame)
    assert list(panda.columns) == bear.columns
    assert len(bear.columns) == len(FIELD_TYPES) + 2
    assert panda["x"].dtype == np.float32
    assert bear["timestamp"].dtype == pl.UInt64
    assert np.array_equal(panda["delta_xy[1]"], array["delta_xy"][:, 1], equal_nan=True)
    assert np.array_equal(bear["ref_lat"].to_numpy(), array["ref_lat"], equal_nan=True)


def test_invalid_messages_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Messages that violate a rule are left out, and the log has their number."""
    path = tmp_path / "a.mcap"
    array = to_array([message(1), message(2), message(3)])
    array["xy_valid"][1] = True
    with RecordingWriter(path) as writer:
        writer.write(array, repeat((Address("1", VLP), Provenance())), logged=[1, 2, 3], published=[1, 2, 3])
    assert nedbus.read(path)["timestamp"].tolist() == [1, 3]
    assert "1 of 3 messages violate the rules" in caplog.text


def test_selection_must_match_one_stream(flight: Path, tmp_path: Path) -> None:
    """A selection that matches several streams or none is an error that names the available ones."""
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
    noise = to_array([message(0)] * 1000)
    with RecordingWriter(path) as writer:
        for chunk in range(60):
            for name in ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "heading_var", "tilt_var"):
                noise[name] = rng.random(1000)
            noise["timestamp"] = np.arange(1000) + chunk * 1000
            times = list(range(1000))
            for vehicle in ("1", "2"):
                rows = noise if vehicle == "1" else noise[:10]
                writer.write(rows, repeat((Address(vehicle, VLP), Provenance())), logged=times, published=times)
            writer.flush()
    assert path.stat().st_size > 2_000_000
    nedbus.read(path, vehicle="2")
    tracemalloc.start()
    array = nedbus.read(path, vehicle="2")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(array) == 600
    assert peak < 2_000_000, f"{peak} bytes for {path.stat().st_size}"


def test_missing_extra_says_what_to_install(flight: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without pandas, or without mcap, the error names the package to install."""
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ConfigError, match=r"pandas: not installed: pip install pandas"):
        nedbus.read(flight, frame="pandas")
    monkeypatch.delitem(sys.modules, "nedbus.recording.reader")
    monkeypatch.setitem(sys.modules, "mcap.reader", None)
    with pytest.raises(ConfigError, match=r"mcap: not installed: pip install 'nedbus\[mcap\]'"):
        nedbus.read(flight)


@pytest.mark.parametrize(
    ("arguments", "streams"), [([], 1), (["-t", "*"], 5), (["-t", "estimator_local_position", "-i", "1"], 1)]
)
def test_flight_is_plotted(run_nedbus: Start, flight: Path, arguments: list[str], streams: int) -> None:
    """Each selected stream is in the picture beside the flight: as a track, and as bars of its flags."""
    plot = run_nedbus("plot", str(flight), *arguments)
    assert plot.wait(60) == 0, plot.err
    picture = flight.with_suffix(".png")
    assert plot.out.strip() == str(picture)
    pixels = imread(picture)[..., :3]
    height, width, _ = pixels.shape
    assert (width, height) == (1440, 960)
    track, flags = pixels[: height // 2, : width * 2 // 5], pixels[height * 3 // 4 :]
    for color in COLORS[:streams]:
        assert count_pixels(flags, color) > 1000, color
        assert count_pixels(track, color) > 40, color
    assert count_pixels(track, COLORS[streams - 1]) > 250  # the last track covers the others
    for color in COLORS[max(2, streams) :]:  # the second one is also that of dead reckoning
        assert count_pixels(pixels, color) == 0, color


def count_pixels(pixels: np.ndarray, color: str) -> int:
    """Return how many pixels have this color, but for rounding."""
    wanted = np.frombuffer(bytes.fromhex(color[1:]), np.uint8) / 255
    return int(np.count_nonzero(np.abs(pixels - wanted).max(axis=-1) < 0.02))


def test_plot_shows_every_valid_message(tmp_path: Path) -> None:
    """The track goes through every valid position, east to the right and north up; flags and resets have their rows."""
    angles = np.linspace(0, 5, 60)
    array = to_array([message(1)] * 60)
    array["timestamp"] = 1_000_000 + 10_000 * np.arange(60)
    array["x"], array["y"], array["z"] = 30 * np.sin(angles), 10 * np.cos(angles), -5 - angles
    array["xy_valid"] = (np.arange(60) < 20) | (np.arange(60) >= 35)
    array["dead_reckoning"] = ~array["xy_valid"]
    array["z_reset_counter"][50:] = 1
    with mpl.rc_context({"path.simplify": False, "svg.fonttype": "none"}):
        draw([(Address("7", VLP), array)], tmp_path / "a.svg", title="a flight")
    svg = (tmp_path / "a.svg").read_text()
    texts = set(re.findall(r"<text[^>]*>([^<]*)</text>", svg))
    flags = {"xy_valid", "z_valid", "v_xy_valid", "v_z_valid", "heading_good_for_control", "dead_reckoning"}
    assert {"a flight", f"7/{VLP}", "track", "east [m]", "north [m]", "z resets", "heading resets", *flags} <= texts
    assert not {"xy resets", "vz resets"} & texts
    paths = re.findall(r'<path [^>]*?d="([^"]*)"[^>]*?style="([^"]*)"', svg)
    [track] = [path for path, style in paths if "stroke-width: 1.2" in style and path.count("L") > 10]
    points = np.array(re.findall(r"[ML] (\S+) (\S+)", track), float)
    valid = array[array["xy_valid"]]
    assert len(points) == len(valid) == 45
    assert track.count("M") == 2  # interrupted while xy is invalid
    east, north = np.polyfit(valid["y"], points[:, 0], 1), np.polyfit(valid["x"], points[:, 1], 1)
    assert east[0] == pytest.approx(-north[0], rel=1e-4)
    assert east[0] > 0
    assert np.allclose(np.polyval(east, valid["y"]), points[:, 0], atol=0.01)
    assert np.allclose(np.polyval(north, valid["x"]), points[:, 1], atol=0.01)
    bars = [np.array(re.findall(r"[ML] (\S+)", path), float) for path, style in paths if f"fill: {COLORS[0]}" in style]
    first, second = (float(np.ptp(bar)) for bar in bars)  # of xy_valid, for 0.2 s and from 0.35 s to 0.59 s
    assert second == pytest.approx(first * 0.24 / 0.2, rel=1e-4)


def test_plot_that_cannot_be_written_is_an_error(run_nedbus: Start, flight: Path, tmp_path: Path) -> None:
    """A vehicle that is not in the file is exit code 2, a folder that does not exist is exit code 1."""
    plot = run_nedbus("plot", str(flight), "-v", "9")
    assert plot.wait() == 2
    assert "expected one of 1/estimator_local_position/0" in plot.err
    plot = run_nedbus("plot", str(flight), "-o", "/nowhere/a.png")
    assert plot.wait(60) == 1
    assert "cannot be written" in plot.err
    with pytest.raises(OutputError):
        draw([(Address("1", VLP), nedbus.read(flight))], tmp_path / "no" / "a.png", title="")
