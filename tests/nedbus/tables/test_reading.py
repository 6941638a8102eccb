"""Logs and recordings as arrays, data frames and plots, and the scripts in the docs."""

from __future__ import annotations

import re
import shutil
import struct
import sys
import tracemalloc
from collections.abc import Iterator
from itertools import repeat
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

import nedbus
from nedbus import tables
from nedbus.errors import AddressError, ArgumentError, ConfigError, SourceError
from nedbus.flights import RecordingWriter
from nedbus.flights.readers.mcap import McapReader
from nedbus_msgs import DEFAULT, MESSAGES, Address, Provenance, VehicleLocalPosition
from nedbus_msgs.arrays import DTYPE, arrays_of, to_array, to_message
from nedbus_msgs.frames import MapProjection
from tests.flights.local_position import FIELD_TYPES, upgrade
from tests.flights.messages import VLP, message
from tests.flights.replays import convert_replay, open_replay
from tests.flights.ulogs import LOGS, UlogWriter, write_log
from tests.peers.command_line import run_command

from .test_alignment import array_of, write

# pandas, polars and matplotlib take a second to import, so only the tests that need them import them.

DOCS = Path(__file__).parents[3] / "docs"
# of the streams in a plot, in order
COLORS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#8c564b", "#e377c2")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "flight.mcap"
    convert_replay("sim:?duration=20", path)
    return path


@pytest.fixture
def flight(recorded: Path, tmp_path: Path) -> Path:
    """Return a recording of a simulated flight."""
    return Path(shutil.copy(recorded, tmp_path))


@pytest.mark.slow
def test_recording_is_read_as_an_array(flight: Path) -> None:
    """The array has every message in order, with PX4's field types."""
    array = nedbus.read(flight)
    messages = open_replay("sim:?duration=20").messages
    expected = [upgrade(each.fields) for each in messages if each.address.topic == VLP]
    assert array.dtype == DTYPE
    assert len(array) == len(expected) == 2000
    assert all(
        to_message(element) == each
        for element, each in zip(array[::100], expected[::100], strict=True)
    )
    assert (
        nedbus.read(flight, "estimator_local_position", instance=1)["timestamp"][0]
        == array["timestamp"][0]
    )
    assert nedbus.read(flight, vehicle=1).tobytes() == array.tobytes()


@pytest.mark.slow
def test_data_frames_have_all_columns(flight: Path) -> None:
    """Data frames of pandas and polars have all columns, with the values and types of the array."""
    pd, pl = pytest.importorskip("pandas"), pytest.importorskip("polars")
    array = nedbus.read(flight)
    in_pandas = nedbus.read(flight, dataframe="pandas")
    in_polars = nedbus.read(flight, dataframe="polars")
    assert isinstance(in_pandas, pd.DataFrame)
    assert isinstance(in_polars, pl.DataFrame)
    assert list(in_pandas.columns) == in_polars.columns
    assert len(in_polars.columns) == len(FIELD_TYPES) + 2
    assert in_pandas["x"].dtype == np.float32
    assert in_polars["timestamp"].dtype == pl.Int64
    assert np.array_equal(in_pandas["delta_xy[1]"], array["delta_xy"][:, 1], equal_nan=True)
    assert np.array_equal(in_polars["ref_lat"].to_numpy(), array["ref_lat"], equal_nan=True)


def test_selection_must_match_one_stream(flight: Path, tmp_path: Path) -> None:
    """A selection that matches no stream or several raises; the error lists the available streams."""
    with pytest.raises(
        AddressError,
        match=r"^instance None is not valid: .*several match; set instance to one of 1/",
    ):
        nedbus.read(flight, "estimator_local_position")
    has = f"expected one of 1/.*, 1/estimator_local_position/0, .*1/{VLP}"
    with pytest.raises(AddressError, match=f"^vehicle '2' is not in {flight}: {has}"):
        nedbus.read(flight, vehicle="2")
    with pytest.raises(AddressError, match=f"^instance 5 is not in {flight}: {has}"):
        nedbus.read(flight, "estimator_local_position", instance=5)
    with pytest.raises(SourceError, match="no such file"):
        nedbus.read(tmp_path / "none.ulg")


def test_ambiguous_selection_names_the_missing_argument(tmp_path: Path) -> None:
    """The error for a selection names the argument that is missing or wrong: vehicle, topic or instance."""
    path = tmp_path / "a.mcap"
    addresses = [Address(str(vehicle), VLP) for vehicle in range(1, 24)]
    addresses += [Address("99", "estimator_local_position", instance) for instance in (0, 1)]
    with RecordingWriter(path) as writer:
        rows = to_array([message(1)] * len(addresses))
        writer.write(
            rows,
            DEFAULT,
            ((address, Provenance()) for address in addresses),
            logged=repeat(1),
            published=repeat(1),
        )
    with pytest.raises(
        AddressError, match=r"vehicle '\*' is not valid: .*set vehicle to one of 1/.* and 3 more$"
    ):
        nedbus.read(path)
    with pytest.raises(AddressError, match="set topic and vehicle and instance to one of"):
        nedbus.read(path, "*")
    truth = f"{VLP}_groundtruth"
    with pytest.raises(
        AddressError, match=f"topic '{truth}' is not in .*: expected one of 1/.* more$"
    ):
        nedbus.read(path, truth)
    with pytest.raises(AddressError, match=f"topic '{VLP}' is not in"):
        nedbus.read(path, vehicle="99")


@pytest.mark.slow
def test_reading_one_stream_does_not_load_the_file(tmp_path: Path) -> None:
    """Reading one stream needs memory for that stream, not for the whole file."""
    path = tmp_path / "large.mcap"
    rng = np.random.default_rng(0)
    noise = to_array([message(0)] * 1000)
    with RecordingWriter(path) as writer:
        for chunk in range(20):
            for name in (
                "x",
                "y",
                "z",
                "vx",
                "vy",
                "vz",
                "ax",
                "ay",
                "az",
                "heading_var",
                "tilt_var",
            ):
                noise[name] = rng.random(1000)
            noise["timestamp"] = np.arange(1000) + chunk * 1000
            times = list(range(1000))
            for vehicle in ("1", "2"):
                rows = noise if vehicle == "1" else noise[:10]
                writer.write(
                    rows,
                    DEFAULT,
                    repeat((Address(vehicle, VLP), Provenance())),
                    logged=times,
                    published=times,
                )
            writer.flush()
    assert path.stat().st_size > 1_300_000
    nedbus.read(path, vehicle="2")
    tracemalloc.start()
    array = nedbus.read(path, vehicle="2")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(array) == 200
    assert peak < 1_100_000, f"{peak} bytes for {path.stat().st_size}"


def test_missing_package_error_contains_the_pip_command(
    flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without pandas or mcap the error includes the pip command; an unknown data frame library raises."""
    with pytest.raises(
        ArgumentError, match="dataframe 'foo' is not valid: expected pandas or polars"
    ):
        nedbus.read(flight, dataframe="foo")  # type: ignore[call-overload] # invalid on purpose
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ConfigError, match=r"pandas: not installed; run pip install pandas"):
        nedbus.read(flight, dataframe="pandas")
    for name in ("mcap", "mcap_chunks"):
        monkeypatch.delitem(sys.modules, f"nedbus.flights.readers.{name}")
    monkeypatch.setitem(sys.modules, "mcap.records", None)
    with pytest.raises(ConfigError, match=r"^mcap: not installed; .*pip install .*\[mcap\]'$"):
        nedbus.read(flight)


@pytest.mark.parametrize(
    ("arguments", "streams"),
    [
        (["-t", "estimator_local_position", "-i", "1"], 1),
        pytest.param(["-t", "*"], 5, marks=pytest.mark.slow),
        pytest.param([], 1, marks=pytest.mark.slow),
    ],
)
def test_flight_is_plotted(flight: Path, arguments: list[str], streams: int) -> None:
    """`nedbus plot` writes an image next to the flight, with a track and flags for each selected stream."""
    plot = run_command("plot", str(flight), *arguments)
    assert plot.exit_code == 0, plot.err
    picture = flight.with_suffix(".png")
    assert plot.out.strip() == str(picture)
    pixels = pytest.importorskip("matplotlib.image").imread(picture)[..., :3]
    height, width, _ = pixels.shape
    assert width == 1440
    # Each stream has seven rows, for six flags and heading resets; each kind of event adds one row.
    assert height > 960 if streams == 1 else height >= 120 * (6.0 + 0.16 * 7 * streams)
    # With the legend below the track: the vehicle's track hides that of the equal EKF 0.
    track, flags = pixels[:840, : width * 2 // 5], pixels[720:]
    for color in COLORS[:streams]:
        assert count_pixels(flags, color) > 1000, color
        assert count_pixels(track, color) > 40, color
    assert count_pixels(track, COLORS[streams - 1]) > 250  # the last track covers the others
    for color in COLORS[max(2, streams) :]:  # the second color also marks dead reckoning
        assert count_pixels(pixels, color) == 0, color


def count_pixels(pixels: np.ndarray, color: str) -> int:
    """Return the number of pixels with this color, up to rounding."""
    wanted = np.frombuffer(bytes.fromhex(color[1:]), np.uint8) / 255
    return int(np.count_nonzero(np.abs(pixels - wanted).max(axis=-1) < 0.02))


def texts_of(
    streams: list[tuple[Address, np.ndarray]], path: Path, *, title: str = ""
) -> list[str]:
    """Plot to an SVG file, and return its texts."""
    with pytest.importorskip("matplotlib").rc_context(
        {"path.simplify": False, "svg.fonttype": "none"}
    ):
        tables.draw(streams, path, title=title)
    return re.findall(r"<text[^>]*>([^<]*)</text>", path.read_text())


@pytest.mark.slow
def test_track_has_every_valid_position(tmp_path: Path) -> None:
    """The track has every valid position, east to the right, north up; flags and resets have rows."""
    angles = np.linspace(0, 5, 60)
    array = to_array([message(1)] * 60)
    array["timestamp"] = 1_000_000 + 10_000 * np.arange(60)
    array["x"], array["y"], array["z"] = 30 * np.sin(angles), 10 * np.cos(angles), -5 - angles
    array["xy_valid"] = (np.arange(60) < 20) | (np.arange(60) >= 35)
    array["dead_reckoning"] = ~array["xy_valid"]
    array["z_reset_counter"][50:] = 1
    texts = set(texts_of([(Address("7", VLP), array)], tmp_path / "a.svg", title="a flight"))
    svg = (tmp_path / "a.svg").read_text()
    flags = {
        "xy_valid",
        "z_valid",
        "v_xy_valid",
        "v_z_valid",
        "heading_good_for_control",
        "dead_reckoning",
    }
    assert {
        "a flight",
        f"7/{VLP}",
        "east [m]",
        "north [m]",
        "z resets",
        "heading resets",
        *flags,
    } <= texts
    assert not {"xy resets", "vz resets"} & texts
    paths = re.findall(r'<path [^>]*?d="([^"]*)"[^>]*?style="([^"]*)"', svg)
    [track] = [
        path for path, style in paths if "stroke-width: 1.2" in style and path.count("L") > 10
    ]
    points = np.array(re.findall(r"[ML] (\S+) (\S+)", track), float)
    valid = array[array["xy_valid"]]
    assert len(points) == len(valid) == 45
    assert track.count("M") == 2  # interrupted while xy is invalid
    east, north = np.polyfit(valid["y"], points[:, 0], 1), np.polyfit(valid["x"], points[:, 1], 1)
    # Matplotlib accepts an aspect within 0.5 %
    assert east[0] == pytest.approx(-north[0], rel=5e-3)
    assert east[0] > 0
    assert np.allclose(np.polyval(east, valid["y"]), points[:, 0], atol=0.01)
    assert np.allclose(np.polyval(north, valid["x"]), points[:, 1], atol=0.01)
    bars = [
        np.array(re.findall(r"[ML] (\S+)", path), float)
        for path, style in paths
        if f"fill: {COLORS[0]}" in style
    ]
    # bars of xy_valid: for 0.2 s, and from 0.35 s to 0.59 s
    first, second = (float(np.ptp(bar)) for bar in bars)
    assert second == pytest.approx(first * 0.24 / 0.2, rel=1e-4)


@pytest.mark.slow
def test_plot_names_missing_flags(tmp_path: Path) -> None:
    """Flags and resets that a log lacks have no row; a note in the plot lists them."""
    path = tmp_path / "a.ulg"
    writer = UlogWriter(layout="1.13")
    writer.define([VLP], without=["heading_reset_counter"])
    for number in range(20):
        writer.add(VLP, message(number + 1))
    texts = texts_of([(Address("1", VLP), nedbus.read(writer.write(path)))], tmp_path / "a.svg")
    assert "xy_valid" in texts
    assert "dead_reckoning" not in texts
    assert "heading resets" not in texts
    assert f"not in 1/{VLP}: dead_reckoning, heading_reset_counter" in texts


@pytest.mark.slow
def test_plot_of_invalid_messages_has_explanatory_titles(tmp_path: Path) -> None:
    """Invalid messages are plotted with explanatory titles; a file name is not interpreted as math text."""
    array = to_array([message(each + 1) for each in range(20)])
    name = "flight $1$ of $x, \u0631\u062d\u0644\u0629, \u98db\u884c and broken \udcff.ulg"
    texts = texts_of([(Address("1", VLP), array)], tmp_path / "a.svg", title=name)
    assert {"height; thin: z invalid, dashed: z or vz reset", "speed; thin: v_xy invalid"} <= set(
        texts
    )
    assert name.replace("\udcff", "?") in texts


def test_missing_fields_are_listed(tmp_path: Path) -> None:
    """Fields that a log lacks are named by `missing_of`, and null in data frames."""
    writer = UlogWriter(layout="1.13")
    writer.define([VLP])
    for number in range(5):
        writer.add(VLP, message(number + 1, x=1.0))
    path = writer.write(tmp_path / "a.ulg")
    array = nedbus.read(path)
    assert array.dtype == DTYPE
    missing = nedbus.missing_of(array)
    assert {"dead_reckoning", "heading_var", "dist_bottom_reset_counter"} <= missing
    assert not {"x", "xy_valid", "hagl_max_z", "hagl_max_xy"} & missing
    for part in (
        array[1:3],
        array[array["x"] > 0],
        array.copy(),
        np.sort(array, order="timestamp"),
        array[0],
    ):
        assert nedbus.missing_of(part) == missing
    in_pandas = nedbus.read(path, dataframe="pandas")
    in_polars = nedbus.read(path, dataframe="polars")
    assert in_pandas.attrs["missing"] == sorted(missing)
    for name in ("dead_reckoning", "heading_var", "dist_bottom_reset_counter"):
        assert in_pandas[name].isna().all()
        assert in_polars[name].is_null().all()
    assert str(in_pandas["dead_reckoning"].dtype) == "boolean"
    assert str(in_polars["dead_reckoning"].dtype) == "Boolean"
    assert in_pandas["xy_valid"].dtype == np.bool_
    assert not in_polars["x"].has_nulls()


def test_fields_missing_in_some_messages_are_null_there(tmp_path: Path) -> None:
    """If one of a vehicle's two sources lacks a field, the field is null only in the messages of that source."""
    path = tmp_path / "a.mcap"
    array = to_array([message(1, eph=1.0), message(2, eph=2.0)])
    without = Provenance("mavlink", frozenset({"dead_reckoning", "delta_xy", "eph"}))
    with RecordingWriter(path) as writer:
        for row, provenance in zip(
            (array[:1], array[1:]), (Provenance("sim"), without), strict=True
        ):
            writer.write(row, DEFAULT, [(Address("1", VLP), provenance)], logged=[1], published=[1])
    assert nedbus.missing_of(nedbus.read(path)) == without.missing
    assert nedbus.read(path, dataframe="pandas")["dead_reckoning"].isna().tolist() == [False, True]
    in_polars = nedbus.read(path, dataframe="polars")
    assert in_polars["delta_xy[1]"].is_null().to_list() == [False, True]
    assert in_polars["eph"].to_list() == [1.0, None]


@pytest.mark.slow
def test_names_in_the_docs_exist_and_scripts_run(
    flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Names in docs/data.md and docs/recordings.md exist in `nedbus`; the scripts in docs/recordings.md run."""
    data, recordings = ((DOCS / name).read_text() for name in ("data.md", "recordings.md"))
    names = set(
        re.findall(r"\bnedbus\.([A-Za-z]\w*)", re.sub(r"nedbus\.toml", "", data + recordings))
    )
    names |= set(re.findall(r"`(\w+_to_\w+)`", data))
    assert len(names) > 15
    assert names <= {*dir(nedbus), *nedbus.frames.__all__}
    others = ("vehicle_attitude", "home_position", "battery_status/0", "sensor_gps/0")
    streams = {name: array_of(name.partition("/")[0], {"timestamp": 1}) for name in others}
    streams |= nedbus.read(flight, ["*"])
    flight.unlink()
    write(flight, streams)
    log = UlogWriter(layout="1.13")
    log.define(["estimator_local_position", VLP])
    log.add(VLP, message(1, x=2.5))
    log.add("estimator_local_position", message(1), instance=1)
    log.write(flight.with_suffix(".ulg"))
    monkeypatch.chdir(flight.parent)
    pd = pytest.importorskip("pandas")
    scope: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", recordings, re.DOTALL):
        exec(block, scope)  # noqa: S102 - our own docs
    assert isinstance(scope["estimates"], pd.DataFrame)
    assert pd.read_csv(flight.with_name("flight.csv"))["x"].tolist() == [2.5]
    assert 0.0 < float(str(scope["rms"])) < 30.0


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_time_differences_in_data_frames_may_be_negative(
    tmp_path: Path, library: Literal["pandas", "polars"]
) -> None:
    """uint64 fields are int64 in data frames, also of `align`: differences do not wrap; arrays keep PX4's type."""
    pytest.importorskip(library)
    log = UlogWriter(layout="1.13")
    log.define([VLP])
    for stamp in (1_000_000, 1_250_000):
        log.add(VLP, message(stamp, timestamp_sample=stamp - 700, ref_timestamp=2**64 - 1))
    log.write(path := tmp_path / "a.ulg")
    table: Any = nedbus.read(path, dataframe=library)
    assert (table["timestamp_sample"] - table["timestamp"]).to_list() == [-700, -700]
    assert table["timestamp"].diff().to_list()[1] == 250_000
    assert table["ref_timestamp"].to_list() == [2**63 - 1] * 2
    aligned: Any = nedbus.align(path, fields=["timestamp_sample"], dataframe=library)
    assert (aligned[f"{VLP}.timestamp_sample"] - aligned["timestamp"]).to_list() == [-700, -700]
    assert nedbus.read(path)["timestamp"].dtype == np.uint64


@pytest.mark.slow
@pytest.mark.logs
def test_addresses_of_lists_messages_that_only_the_file_defines() -> None:
    """`addresses_of` lists the streams that `read(path, ["*"])` returns."""
    path = LOGS / "sitl_1.15_events.ulg"
    if not path.exists():
        pytest.skip(f"real logs not found: {LOGS}")
    addresses = nedbus.addresses_of(path)
    assert {each.topic for each in addresses} - {*nedbus.TOPICS}
    assert {each.stream for each in addresses} == nedbus.read(path, ["*"]).keys()


def test_messages_of_another_type_are_skipped(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Positions on the topic of attitudes are not read as attitudes; the reason is logged."""
    path, addresses = tmp_path / "a.mcap", [Address("1", "vehicle_attitude"), Address("1", VLP)]
    with RecordingWriter(path) as writer:
        streams = [(address, Provenance("sim")) for address in addresses]
        writer.write(
            to_array([message(1), message(2)]), DEFAULT, streams, logged=(1, 2), published=(1, 2)
        )
    assert nedbus.addresses_of(path) == addresses[1:]
    nedbus.read(path)
    assert (
        "its messages are VehicleLocalPosition, but vehicle_attitude has VehicleAttitude"
        in caplog.text
    )


def test_message_id_of_a_log_can_be_reused(tmp_path: Path) -> None:
    """After an unsubscription, a log may give the message id to another topic."""
    writer, other = UlogWriter(), "vehicle_local_position_groundtruth"
    writer.define([VLP, other])
    writer.add(VLP, message(1))
    writer.put("R", struct.pack("<H", 0))
    writer.put("A", struct.pack("<BH", 0, 0) + other.encode())
    writer.add(VLP, message(2))  # with message id 0
    streams = nedbus.read(writer.write(tmp_path / "a.ulg"), [VLP, other])
    assert {name: own["timestamp"].tolist() for name, own in streams.items()} == {
        VLP: [1],
        other: [2],
    }


@pytest.mark.slow
def test_reading_several_topics_reads_the_file_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file is read in one pass for any number of topics."""
    path = tmp_path / "flight.mcap"
    convert_replay("sim:?duration=20", path)
    passes: list[object] = []
    read = McapReader.records

    def read_and_count(*arguments: Any) -> Iterator[Any]:
        passes.append(arguments)
        return read(*arguments)

    monkeypatch.setattr(McapReader, "records", read_and_count)
    assert len(nedbus.read(path, ["*"], dataframe="pandas")) > 10
    assert len(passes) == 1


@pytest.mark.parametrize("sampled", [True, False])
def test_ground_truth_recipe_measures_the_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, sampled: bool
) -> None:
    """The script in docs/recordings.md finds an error of 5 m for topics with different delay, rate and origin."""
    origin = MapProjection(47.0, 8.0)
    latitude, longitude = origin.reproject(100.0, -50.0)
    streams: dict[str, list[VehicleLocalPosition]] = {VLP: [], f"{VLP}_groundtruth": []}
    common = {
        "xy_valid": True,
        "z_valid": True,
        "xy_global": True,
        "z_global": True,
        "ref_alt": 400.0,
        "z": 0.0,
    }
    for time in range(1_000_000, 9_000_000, 10_000):
        north, east = time / 1e5, -time / 2e5
        if time % 20_000 == 0 and time < 8_000_000:
            stamps = {"timestamp": time + 3000 * sampled, "timestamp_sample": time * sampled}
            there = {
                "x": north - 100.0,
                "y": east + 50.0,
                "ref_lat": latitude,
                "ref_lon": longitude,
            }
            streams[f"{VLP}_groundtruth"].append(
                VehicleLocalPosition.model_validate(common | stamps | there)
            )
        stamps = {"timestamp": time + 40_000, "timestamp_sample": time}
        here = {"x": north + 3.0, "y": east - 4.0, "ref_lat": 47.0, "ref_lon": 8.0}
        streams[VLP].append(VehicleLocalPosition.model_validate(common | stamps | here))
    with RecordingWriter(tmp_path / "flight.mcap") as writer:
        for topic, messages in streams.items():
            addresses = repeat((Address("1", topic), Provenance()))
            writer.write(
                to_array(messages), DEFAULT, addresses, logged=repeat(1), published=repeat(1)
            )
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "recordings.md").read_text(), re.DOTALL)
    [recipe] = [block for block in blocks if "rms" in block]
    scope: dict[str, object] = {"nedbus": nedbus}
    exec(recipe, scope)  # noqa: S102 - our own docs
    assert scope["rms"] == pytest.approx(5.0, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "exit_code", "reason"),
    [
        (
            "flight.mcap -v 9",
            2,
            "vehicle '9' is not in flight.mcap: expected one of 1/estimator_local_position/0, 1/est",
        ),
        (
            "flight.mcap -o a.foo",
            2,
            "a.foo: not an image format; the name must end with .png or .svg or .pdf",
        ),
        (
            "flight.mcap -o /dev/full",
            2,
            "/dev/full: not an image format; the name must end with .png or .svg or .pdf",
        ),
        ("flight.mcap -o /nowhere/a.png", 1, "cannot be written"),
        ("invalid.mcap", 1, "the selected streams have no valid message"),
    ],
)
def test_plot_that_cannot_be_drawn_exits_with_an_error(
    flight: Path, arguments: str, exit_code: int, reason: str
) -> None:
    """An unknown stream or suffix exits with 2, a missing folder or a stream without valid messages with 1."""
    array = to_array([message(1), message(2)])
    array["xy_valid"] = True
    with RecordingWriter(flight.with_name("invalid.mcap")) as writer:
        writer.write(
            array,
            DEFAULT,
            repeat((Address("1", VLP), Provenance())),
            logged=[1, 2],
            published=[1, 2],
        )
    plot = run_command("plot", *arguments.split())
    assert plot.exit_code == exit_code
    assert reason in plot.err
    assert "Traceback" not in plot.err


def test_integers_of_every_layout_fit_into_the_array() -> None:
    """Columns are copied without a check of their range, because no layout has a wider integer than the newest one."""
    for definition in MESSAGES.values():
        array = arrays_of(definition).absent(0)
        for layout in definition.layouts.values():
            for name, old in definition.plan(tuple(layout.types)).names.items():
                target = array.dtype[name].base
                if target.kind in "iu":
                    logged = np.dtype(layout.types[old].base)
                    assert np.can_cast(logged, target), (definition.name, layout.name, name)


def test_messages_of_two_subscriptions_are_in_the_order_of_the_file(tmp_path: Path) -> None:
    """A log may subscribe to a topic again, and write the messages of both in turn."""
    writer = UlogWriter()
    writer.define([VLP])
    writer.add(VLP, message(1_000_000))
    writer.put("A", struct.pack("<BH", 0, 1) + VLP.encode())
    for stamp, number in ((2_000_000, 1), (3_000_000, 1), (4_000_000, 0), (5_000_000, 1)):
        writer._ids[VLP, 0] = number
        writer.add(VLP, message(stamp))
    read = nedbus.read(writer.write(tmp_path / "a.ulg"))
    assert (read["timestamp"] // 1_000_000).tolist() == [1, 2, 3, 4, 5]


def test_topic_that_only_the_file_defines_means_its_first_instance(tmp_path: Path) -> None:
    """Its first instance has no number, so the topic alone selects it; a number selects another one."""
    writer = UlogWriter()
    writer.put("F", b"own_topic:uint64_t timestamp;int32_t value;")
    for instance in (0, 1):
        writer.put("A", struct.pack("<BH", instance, instance) + b"own_topic")
        writer.put("D", struct.pack("<HQi", instance, 1_000_000, 10 + instance))
    path = writer.write(tmp_path / "a.ulg")
    assert nedbus.read(path, "own_topic")["value"].tolist() == [10]
    assert nedbus.read(path, "own_topic", instance=1)["value"].tolist() == [11]


@pytest.mark.parametrize("topic", [VehicleLocalPosition, [VehicleLocalPosition]])
def test_message_class_as_topic_raises(tmp_path: Path, topic: Any) -> None:
    """`read` and `align` take names of topics; a message class raises ArgumentError."""
    path = write_log(tmp_path / "a.ulg", [1_000_000])
    with pytest.raises(ArgumentError, match="expected names of topics"):
        nedbus.read(path, topic)
    with pytest.raises(ArgumentError, match="expected names of topics"):
        nedbus.align(path, topics=topic)
