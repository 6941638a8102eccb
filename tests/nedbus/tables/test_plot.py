"""Plots of flights: axis limits, resets, marked events, and clocks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nedbus
from nedbus.vehicle_events import KINDS, Event, Times
from nedbus_msgs import Address
from nedbus_msgs.arrays import MessageArray, to_array
from tests.flights.messages import VLP, message
from tests.flights.replays import convert_replay
from tests.flights.ulogs import LOGS, cached_events
from tests.peers.command_line import run_command

REAL = sorted(LOGS.parent.glob("*/*.ulg"))
LARGE = [
    pytest.param(path, marks=pytest.mark.slow) for path in REAL if path.stat().st_size > 2_600_000
]
SMALL = [path for path in REAL if path.stat().st_size <= 2_600_000]


def flight_of(count: int = 100, *, vehicle: str = "7") -> tuple[Address, MessageArray]:
    """Return a valid flight at 10 Hz from 1 s after boot: north at 1 m/s, climbing at 0.5 m/s."""
    array = to_array([message(1)] * count)
    array["timestamp"] = 1_000_000 + 100_000 * np.arange(count)
    array["x"], array["y"], array["z"] = 0.1 * np.arange(count), 0.0, -0.05 * np.arange(count)
    array["vx"], array["vy"] = 1.0, 0.0
    for flag in ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"):
        array[flag] = True
    return Address(vehicle, VLP), array


def drawn(
    streams: Sequence[tuple[Address, MessageArray]],
    events: Sequence[Event] = (),
    times: Times | None = None,
) -> dict[str, Any]:
    """Return the axes of a plot, by name."""
    # imported late: Matplotlib takes a second
    plot = pytest.importorskip("nedbus.tables.plot", exc_type=ImportError)
    figure = plot.draw_figure(streams, title="a flight", events=events, times=times or Times())
    figure.draw_without_rendering()
    return {str(axes.get_label()): axes for axes in figure.axes}


def event_of(kind: str, change: Any, severity: Any, boot: float, **fields: Any) -> Event:
    """Return an event of the flight that `flight_of` returns."""
    return Event(
        "7",
        kind,
        change,
        severity,
        fields.pop("text", kind.replace("_", " ")),
        boot - 1.0,
        boot,
        **fields,
    )


def events_of(path: Path) -> list[Event]:
    """Return the events of a log, including the start of its initial conditions."""
    event_log = cached_events(path).event_log
    known = (
        each for vehicle in event_log.vehicles.values() for each in vehicle.conditions.values()
    )
    held = [each.begin for each in known if each.initial]
    return [*held, *event_log.events_since(0)[0]]


def marks_of(axes: Any, marker: str) -> list[tuple[float, float]]:
    """Return the positions of marks of one shape."""
    lines = (line for line in axes.lines if line.get_marker() == marker)
    return [(float(x), float(y)) for line in lines for x, y in zip(*line.get_data(), strict=True)]


def rows_of(axes: Any) -> list[str]:
    """Return the labels of the rows."""
    return [label.get_text() for label in axes.get_yticklabels()]


def bars_of(axes: Any) -> dict[str, list[tuple[float, float]]]:
    """Return begin and end of the bars of each row."""
    found: dict[str, list[tuple[float, float]]] = {row: [] for row in rows_of(axes)}
    for bar in axes.collections:
        for path in bar.get_paths():
            (left, low), (right, high) = path.vertices.min(axis=0), path.vertices.max(axis=0)
            found[rows_of(axes)[round((low + high) / 2)]].append(
                (round(float(left), 6), round(float(right), 6))
            )
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    "others", [[], [flight_of(vehicle="8")]], ids=["one vehicle", "two vehicles"]
)
def test_invalid_estimate_is_drawn_thin_without_affecting_axis_limits(
    others: list[tuple[Address, MessageArray]],
) -> None:
    """Invalid positions, altitudes and speeds are drawn thin and do not affect the axis limits."""
    address, array = flight_of()
    array["xy_valid"][50:80] = array["z_valid"][50:80] = array["v_xy_valid"][50:80] = False
    for name, value in (("x", 500.0), ("y", -900.0), ("z", -700.0), ("vx", 80.0)):
        array[name][50:80] = value
    parts = drawn([(address, array), *others])
    low, high = parts["track"].get_ylim()
    assert -13 < low < 0
    assert 9.9 < high < 23
    assert parts["track"].get_xlim()[0] > -20
    assert parts["altitude"].get_ylim() == pytest.approx((-0.05 * 4.95, 1.05 * 4.95), rel=1e-3)
    assert parts["speed"].get_ylim()[1] < 2
    for name, field, sign in (("track", "x", 1), ("altitude", "z", -1), ("speed", "vx", 1)):
        [thin, *_] = [
            line
            for line in parts[name].lines
            if line.get_linewidth() == 0.5 and line.get_linestyle() == "-"
        ]
        assert np.array_equal(thin.get_ydata(), sign * array[field]), name
        thick = next(line for line in parts[name].lines if line.get_linewidth() > 0.8)
        assert np.array_equal(np.isfinite(np.asarray(thick.get_ydata())), array["xy_valid"]), name


@pytest.mark.slow
def test_never_valid_estimate_sets_axis_limits() -> None:
    """If no message is valid, the invalid messages determine the axis limits."""
    address, array = flight_of()
    array["xy_valid"] = array["z_valid"] = array["v_xy_valid"] = False
    array["x"] *= 100
    parts = drawn([(address, array)])
    assert parts["track"].get_ylim()[1] > 990
    assert parts["altitude"].get_ylim()[1] > 4.95
    assert parts["speed"].get_ylim()[0] < 1.0 < parts["speed"].get_ylim()[1]


def lacking_flags(array: MessageArray) -> MessageArray:
    """Return messages whose flags and reset counters some or all of them lack, as `read` returns them."""
    names = [
        name for name in array.dtype.names or () if array.dtype[name].kind == "b" or "reset" in name
    ]
    return array.view(np.dtype(array.dtype.descr, metadata={"missing": names}))


@pytest.mark.slow
@pytest.mark.parametrize("events", [[], [event_of("few_satellites", "begin", "watch", 5.0)]])
def test_flight_without_flags_is_drawn(events: list[Event]) -> None:
    """LOCAL_POSITION_NED without ESTIMATOR_STATUS has no flags: the plot has no rows for them."""
    address, array = flight_of()
    messages = lacking_flags(array)
    for name in messages.dtype.metadata["missing"]:  # type: ignore[index] # it has metadata
        messages[name] = 0
    axes = drawn([(address, messages)], events)
    assert axes.keys() == {"track", "altitude", "speed"} | ({"events"} if events else set())


@pytest.mark.slow
def test_flags_that_some_messages_lack_are_drawn() -> None:
    """A MAVLink recording that begins before the first ESTIMATOR_STATUS still shows its flags."""
    plot = pytest.importorskip("nedbus.tables.plot", exc_type=ImportError)
    address, array = flight_of()
    array["xy_valid"][:10] = False
    figure = plot.draw_figure([(address, lacking_flags(array))], title="a flight")
    axes = {str(each.get_label()): each for each in figure.axes}
    assert "xy_valid" in rows_of(axes["flags"])
    assert f"not in all messages of {address}, and drawn as off there: xy_valid" in notes_of(figure)


@pytest.mark.slow
def test_restart_of_a_stream_is_noted() -> None:
    """Boots are drawn over one another, each with its own line and flags; a note states it."""
    plot = pytest.importorskip("nedbus.tables.plot", exc_type=ImportError)
    address, array = flight_of()
    assert "restarts" not in notes_of(plot.draw_figure([(address, array)], title="a flight"))
    twice = np.concatenate([array, array])
    twice["z_reset_counter"][:100] = 3
    figure = plot.draw_figure([(address, twice)], title="a flight")
    assert f"{address} restarts, as after a reboot" in notes_of(figure)
    axes = {str(each.get_label()): each for each in figure.axes}
    [height] = [line for line in axes["altitude"].lines if line.get_label() == str(address)]
    seconds = height.get_xdata()
    assert (len(seconds), np.flatnonzero(np.isnan(seconds)).tolist()) == (201, [100])
    assert [len(each.get_paths()) for each in axes["flags"].collections][:4] == [2, 2, 2, 2]
    assert not any("z resets" in row for row in rows_of(axes["flags"]))


def notes_of(figure: Any) -> str:
    """Return the notes below a plot, without line breaks."""
    return str(figure.get_supxlabel()).replace("\n", " ")


@pytest.mark.slow
def test_altitude_plot_marks_only_z_and_vz_resets() -> None:
    """The altitude plot has lines for resets of z and vz; the rows below show all resets."""
    address, array = flight_of()
    for number, counter in enumerate(("xy", "z", "vxy", "vz", "heading"), 1):
        array[f"{counter}_reset_counter"][10 * number :] = 1
    parts = drawn([(address, array)])
    dashed = [
        float(np.asarray(line.get_xdata())[0])
        for line in parts["altitude"].lines
        if line.get_linestyle() == "--"
    ]
    assert dashed == [2.0, 4.0]
    resets = dict(
        zip([row for row in rows_of(parts["flags"]) if "resets" in row], range(1, 6), strict=True)
    )
    assert list(resets) == [f"{name} resets" for name in ("xy", "z", "vxy", "vz", "heading")]
    assert [x for x, _ in marks_of(parts["flags"], "|")] == [1.0, 2.0, 3.0, 4.0, 5.0]


@pytest.mark.long
def test_events_are_marked_by_severity() -> None:
    """A condition is drawn as a bar from start to end; the shape of a marker shows its severity."""
    lost = event_of("gps_fix_lost", "begin", "watch", 4.0, text="GPS fix lost: 3D to none")
    events = [
        event_of("mode", "once", "info", 2.0, names=("Hold", "Mission")),
        event_of("dist_bottom_invalid", "begin", "info", 3.0),
        lost,
        event_of("xy_invalid", "begin", "bad", 6.0, text="xy not valid", names=("xy_valid",)),
        event_of("failsafe", "begin", "bad", 6.5, names=("failsafe",)),
        event_of("gps_fix_lost", "end", "info", 8.0),
        event_of("reset", "once", "watch", 8.5, text="reset of xy by 3.0 m"),
        event_of("xy_invalid", "end", "info", 9.0, names=("xy_valid",)),
        event_of("battery", "begin", "bad", 90_000.0),  # from a damaged timestamp
    ]
    parts = drawn([flight_of()], events)
    assert bars_of(parts["events"]) == {
        "xy invalid": [(5.0, 8.0)],
        "failsafe": [(5.5, 9.9)],  # to the last message
        "gps fix lost": [(3.0, 7.0)],
        "reset": [(7.5, 7.5)],
        "mode": [(1.0, 1.0)],
    }
    assert marks_of(parts["events"], "x") == [(5.0, 0), (5.5, 1)]
    assert marks_of(parts["events"], "D") == [(3.0, 2), (7.5, 3)]
    assert marks_of(parts["events"], "|") == [(1.0, 4)]
    texts = {text.get_text() for text in parts["events"].texts}
    assert texts >= {"xy not valid", "GPS fix lost: 3D to none", "Mission"}
    assert np.allclose(marks_of(parts["track"], "x"), [(0.0, 5.0), (0.0, 5.5)])
    assert np.allclose(marks_of(parts["track"], "D"), [(0.0, 3.0), (0.0, 7.5)])
    for name in ("altitude", "speed"):
        assert [x for x, _ in marks_of(parts[name], "x")] == [5.0, 5.5]
        assert [x for x, _ in marks_of(parts[name], "D")] == [3.0, 7.5]
    assert len({parts[name].get_xlim() for name in ("altitude", "speed", "flags", "events")}) == 1
    labels = [text.get_text() for text in parts["track"].get_legend().get_texts()]
    assert labels == [f"7/{VLP}", "watch event", "bad event"]
    figure = parts["track"].get_figure()
    figure.draw_without_rendering()
    legend = parts["track"].get_legend().get_window_extent()
    assert not legend.overlaps(parts["track"].get_window_extent()), "it would cover the track"
    assert not legend.overlaps(parts["track"].xaxis.label.get_window_extent())
    others = drawn([flight_of(vehicle="8")], events)
    assert "events" not in others, "events of a vehicle that is not plotted"
    assert not marks_of(others["track"], "x")


@pytest.mark.slow
def test_event_far_from_all_positions_is_not_on_the_track() -> None:
    """An event in a pause of the positions has no place on the track, only on the time axes."""
    address, array = flight_of()
    array["timestamp"][50:] += 20_000_000
    lost = event_of("gps_fix_lost", "once", "bad", 15.0)
    parts = drawn([(address, array)], [lost, event_of("failsafe", "once", "bad", 6.5)])
    assert [x for x, _ in marks_of(parts["altitude"], "x")] == [5.5, 14.0]
    [(east, north)] = marks_of(parts["track"], "x")
    assert (east, north) == pytest.approx((0.0, 4.9))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("offsets", "ticks", "label"),
    [
        ({}, ["2", "4", "6", "8", "10"], "time [s since boot]"),
        (
            {"7": 1.7e9 + 1.3},
            ["22:13:24", "22:13:26", "22:13:28", "22:13:30", "22:13:32"],
            "time [UTC]",
        ),
        ({"8": 1.7e9}, ["2", "4", "6", "8", "10"], "time [s since boot]"),
    ],
)
def test_time_axis_names_its_clock(offsets: dict[str, float], ticks: list[str], label: str) -> None:
    """Ticks are round times on the clock of `why` and `events`: UTC or seconds since boot."""
    event = event_of("failsafe", "begin", "bad", 4.0, names=("failsafe",))
    parts = drawn([flight_of()], [event], Times(offsets=offsets))
    assert parts["speed"].get_xlabel() == parts["events"].get_xlabel() == label
    for name in ("altitude", "speed", "flags", "events"):
        low, high = parts[name].get_xlim()
        assert all(low <= place <= high for place in parts[name].get_xticks())
        assert [text.get_text() for text in parts[name].get_xticklabels()] == ticks
    [(place, _)] = marks_of(parts["events"], "x")
    times = Times(offsets=offsets)
    shown = dict(zip(parts["events"].get_xticks(), ticks, strict=True))
    nearest = min(shown, key=lambda each: abs(each - place))
    assert times.find(shown[nearest], event) - event.time == pytest.approx(nearest - place)


@pytest.mark.slow
def test_time_axis_of_vehicles_with_different_boots_is_since_boot() -> None:
    """Vehicles whose UTC offsets differ are plotted over seconds since boot."""
    parts = drawn(
        [flight_of(), flight_of(vehicle="8")], times=Times(offsets={"7": 1.7e9, "8": 1.7e9 + 30})
    )
    assert parts["speed"].get_xlabel() == "time [s since boot]"


@pytest.mark.slow
def test_bar_ends_with_the_last_of_several_flags() -> None:
    """Two flags that begin together have one mark, and one bar until the last of them ends."""
    events = [
        event_of("failsafe_flag", "begin", "watch", 3.0, names=("a", "b")),
        event_of("failsafe_flag", "end", "info", 5.0, names=("a",)),
        event_of("failsafe_flag", "end", "info", 7.0, names=("b",)),
    ]
    assert bars_of(drawn([flight_of()], events)["events"]) == {"failsafe flag": [(2.0, 6.0)]}


@pytest.mark.slow
def test_events_of_each_vehicle_have_their_own_rows() -> None:
    """With two vehicles each row names its vehicle, and shows times on that vehicle's clock."""
    events = [
        event_of("failsafe", "begin", "bad", 4.0, names=("failsafe",)),
        Event("8", "failsafe", "begin", "bad", "failsafe", 99.0, 6.0, names=("failsafe",)),
    ]
    parts = drawn([flight_of(), flight_of(vehicle="8")], events)
    assert bars_of(parts["events"]) == {"failsafe 7": [(3.0, 9.9)], "failsafe 8": [(5.0, 9.9)]}
    assert np.allclose(marks_of(parts["track"], "x"), [(0.0, 3.0), (0.0, 5.0)])


@pytest.mark.slow
def test_fields_are_drawn_by_name() -> None:
    """Fields and derived quantities have one panel each, on one time axis with the events; invalid values are gaps."""
    plot = pytest.importorskip("nedbus.tables.plot", exc_type=ImportError)
    address, array = flight_of()
    array["z_valid"][:10] = False
    events = [event_of("failsafe", "begin", "bad", 4.0, names=("failsafe",))]
    figure = plot.draw_field_figure(
        [(address, array)], ["z", "height", "speed"], title="a", events=events
    )
    parts = {str(axes.get_label()): axes for axes in figure.axes}
    assert list(parts) == ["z", "height", "speed", "events"]
    z, height, speed = (parts[name].lines[0].get_ydata() for name in ("z", "height", "speed"))
    assert np.isnan(z[:10]).all()
    assert np.array_equal(z[10:], array["z"][10:])
    assert np.array_equal(height, -z, equal_nan=True)
    assert np.allclose(speed, 1.0)
    assert "above the origin of the local frame [m]" in parts["height"].get_title("right")
    with pytest.raises(
        nedbus.ConfigError, match=r"no selected stream has a number 'delta_xy'; they have .*speed"
    ):
        plot.draw_field_figure([(address, array)], ["delta_xy"], title="a")


@pytest.mark.slow
def test_elements_of_arrays_are_drawn_by_name() -> None:
    """`delta_xy[1]` is the second element; one beyond the end is an error that names the last one."""
    plot = pytest.importorskip("nedbus.tables.plot", exc_type=ImportError)
    address, array = flight_of()
    array["delta_xy"][:, 1] = np.arange(len(array))
    figure = plot.draw_field_figure([(address, array)], ["delta_xy[1]"], title="a")
    (line,) = figure.axes[0].lines
    assert np.array_equal(line.get_ydata(), array["delta_xy"][:, 1])
    for name in "delta_xy[2]", "delta_xy[0] to delta_xy[1]", "x[0]", "none[0]":
        with pytest.raises(nedbus.ConfigError, match=r"delta_xy\[0\] to delta_xy\[1\]"):
            plot.draw_field_figure([(address, array)], [name], title="a")


@pytest.mark.long
@pytest.mark.logs
@pytest.mark.skipif(not REAL, reason="no real logs")
def test_plot_command_draws_angles(tmp_path: Path) -> None:
    """`nedbus plot --field` draws the angles of attitudes; without it, their topic has no track."""
    pytest.importorskip("matplotlib")
    log, picture = LOGS.parent / "px4" / "ev_right.ulg", tmp_path / "a.png"
    command = "plot", str(log), "-t", "vehicle_attitude", "-o", str(picture)
    plotted = run_command(*command, "--field", "roll_deg,yaw,q[3]")
    assert plotted.exit_code == 0, plotted.err
    assert picture.stat().st_size > 10_000
    assert "name fields with --field" in run_command(*command).err
    assert "unknown field 'rol_deg'" in run_command(*command, "--field", "rol_deg").err


@pytest.mark.long
def test_plot_command_marks_events(tmp_path: Path) -> None:
    """`nedbus plot` marks the events of a simulated loss of GPS."""
    flight = tmp_path / "flight.mcap"
    convert_replay(
        "sim:?duration=80&topics=VehicleLocalPosition,SensorGps,VehicleStatus,EstimatorStatusFlags",
        flight,
    )
    with pytest.importorskip("matplotlib").rc_context({"svg.fonttype": "none"}):
        plot = run_command("plot", str(flight), "-o", str(tmp_path / "a.svg"))
    assert plot.exit_code == 0, plot.err
    texts = set(re.findall(r"<text[^>]*>([^<]*)</text>", (tmp_path / "a.svg").read_text()))
    assert {
        "xy invalid",
        "gps fix lost",
        "mode",
        "Mission",
        "only 0 satellites",
        "bad event",
    } <= texts


@pytest.mark.long
@pytest.mark.logs
@pytest.mark.skipif(not REAL, reason="no real logs")
@pytest.mark.parametrize("path", [*SMALL, *LARGE], ids=lambda path: path.stem)
def test_labels_of_real_flights_do_not_overlap(path: Path) -> None:
    """In each row of events, labels and marks neither overlap nor extend beyond the axes."""
    [vehicle] = cached_events(path).event_log.vehicles
    streams = [(Address(vehicle, VLP), nedbus.read(path))]
    events = events_of(path)
    parts = drawn(streams, events)
    axes = parts["events"]
    frame = axes.get_window_extent()
    rows: dict[int, list[tuple[float, float]]] = {}
    for line in axes.lines:
        [x], [y] = line.get_data()
        place = axes.transData.transform((x, y))[0]
        rows.setdefault(int(y), []).append((place, place))
    for text in axes.texts:
        extent = text.get_window_extent()
        if extent.width:
            assert frame.x0 <= extent.x0 < extent.x1 <= frame.x1, text.get_text()
            rows[int(text.xy[1])].append((extent.x0, extent.x1))
    for intervals in rows.values():
        for (_, end), (begin, _) in pairwise(sorted(intervals)):
            assert end <= begin
    titles = [parts[name].title.get_window_extent() for name in ("track", "altitude")]
    assert titles[0].x1 < titles[1].x0
    bad = {
        KINDS[event.kind].row or event.kind.replace("_", " ")
        for event in events
        if event.severity != "info"
    }
    assert bad <= set(rows_of(axes))


@pytest.mark.logs
@pytest.mark.slow
@pytest.mark.skipif(not REAL, reason="no real logs")
def test_real_gps_loss_is_marked() -> None:
    """In a log of PX4's simulator, the bars of the GPS loss match the flags, from 32.3 s to 48.1 s."""
    path = LOGS.parent / "px4" / "twelve_messages.ulg"
    array = nedbus.read(path)
    parts = drawn([(Address("1", VLP), array)], events_of(path))
    bars = bars_of(parts["events"])
    assert bars["xy invalid"] == bars["v xy invalid"]
    [(begin, end)] = bars["xy invalid"]
    seconds = (array["timestamp"] - array["timestamp"][0]) / 1e6
    invalid = seconds[~array["xy_valid"] & (seconds > 10)]
    assert begin == pytest.approx(invalid[0], abs=1e-5)
    assert 0 < end - invalid[-1] < 0.1
    [(lost, _)] = bars["gps fix lost"]
    assert begin - 6 < lost < begin - 4
    place = array[np.argmax(seconds >= begin - 1e-6)]
    assert marks_of(parts["track"], "x")[0] == pytest.approx((place["y"], place["x"]), abs=1e-3)
    valid = array[array["xy_valid"]]
    assert parts["speed"].get_ylim()[1] < 1.1 * np.hypot(valid["vx"], valid["vy"]).max()
