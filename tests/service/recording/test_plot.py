"""Plots of flights: the scale, the resets of height, and the clock of the time axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from nedbus.events import Event, Times
from nedbus_msgs import Address
from nedbus_msgs.arrays import MessageArray, to_array
from tests.flights.messages import VLP, message


def flight_of(count: int = 100, *, vehicle: str = "7") -> tuple[Address, MessageArray]:
    """Return a flight of 10 Hz that begins 1 s after boot: north at 1 m/s, climbing at 0.5 m/s, all of it valid."""
    array = to_array([message(1)] * count)
    array["timestamp"] = 1_000_000 + 100_000 * np.arange(count)
    array["x"], array["y"], array["z"] = 0.1 * np.arange(count), 0.0, -0.05 * np.arange(count)
    array["vx"], array["vy"] = 1.0, 0.0
    for flag in ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"):
        array[flag] = True
    return Address(vehicle, VLP), array


def drawn(streams: Sequence[tuple[Address, MessageArray]], times: Times | None = None) -> dict[str, Any]:
    """Return the parts of a plot, by name."""
    plot = pytest.importorskip("nedbus.recording.plot", exc_type=ImportError)  # takes a second, for Matplotlib
    figure = plot.draw_figure(streams, title="a flight", times=times or Times())
    figure.draw_without_rendering()
    return {str(axes.get_label()): axes for axes in figure.axes}


def marks_of(axes: Any, marker: str) -> list[tuple[float, float]]:
    """Return where marks of one shape are."""
    lines = (line for line in axes.lines if line.get_marker() == marker)
    return [(float(x), float(y)) for line in lines for x, y in zip(*line.get_data(), strict=True)]


def rows_of(axes: Any) -> list[str]:
    """Return the labels of the rows."""
    return [label.get_text() for label in axes.get_yticklabels()]


@pytest.mark.parametrize("others", [[], [flight_of(vehicle="8")]], ids=["one", "with another"])
def test_invalid_estimate_is_thin_and_out_of_the_scale(others: list[tuple[Address, MessageArray]]) -> None:
    """A position, height or speed that is not valid is drawn thin, and takes no part in limits. Messages made up."""
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
        [thin, *_] = [line for line in parts[name].lines if line.get_linewidth() == 0.5 and line.get_linestyle() == "-"]
        assert np.array_equal(thin.get_ydata(), sign * array[field]), name
        thick = next(line for line in parts[name].lines if line.get_linewidth() > 0.8)
        assert np.array_equal(np.isfinite(np.asarray(thick.get_ydata())), array["xy_valid"]), name


def test_estimate_that_is_never_valid_is_in_the_scale() -> None:
    """Where nothing is valid the limits are those of what is drawn. Messages made up."""
    address, array = flight_of()
    array["xy_valid"] = array["z_valid"] = array["v_xy_valid"] = False
    array["x"] *= 100
    parts = drawn([(address, array)])
    assert parts["track"].get_ylim()[1] > 990
    assert parts["altitude"].get_ylim()[1] > 4.95
    assert parts["speed"].get_ylim()[0] < 1.0 < parts["speed"].get_ylim()[1]


def test_height_shows_its_own_resets() -> None:
    """Only resets of z and vz are lines in the plot of height; the rows below have all. Messages made up."""
    address, array = flight_of()
    for number, counter in enumerate(("xy", "z", "vxy", "vz", "heading"), 1):
        array[f"{counter}_reset_counter"][10 * number :] = 1
    parts = drawn([(address, array)])
    dashed = [
        float(np.asarray(line.get_xdata())[0]) for line in parts["altitude"].lines if line.get_linestyle() == "--"
    ]
    assert dashed == [2.0, 4.0]
    resets = dict(zip([row for row in rows_of(parts["flags"]) if "resets" in row], range(1, 6), strict=True))
    assert list(resets) == [f"{name} resets" for name in ("xy", "z", "vxy", "vz", "heading")]
    assert [x for x, _ in marks_of(parts["flags"], "|")] == [1.0, 2.0, 3.0, 4.0, 5.0]


@pytest.mark.parametrize(
    ("offsets", "ticks", "label"),
    [
        ({}, ["2", "4", "6", "8", "10"], "time [s since boot]"),
        ({"7": 1.7e9 + 1.3}, ["22:13:24", "22:13:26", "22:13:28", "22:13:30", "22:13:32"], "time [UTC]"),
        ({"8": 1.7e9}, ["2", "4", "6", "8", "10"], "time [s since boot]"),
    ],
)
def test_time_axis_names_its_clock(offsets: dict[str, float], ticks: list[str], label: str) -> None:
    """Ticks are round times of the clock that `why` and `events` use, UTC or seconds since boot. Messages made up."""
    times = Times(offsets=offsets)
    parts = drawn([flight_of()], times)
    assert parts["speed"].get_xlabel() == parts["flags"].get_xlabel() == label
    for name in ("altitude", "speed", "flags"):
        low, high = parts[name].get_xlim()
        assert all(low <= place <= high for place in parts[name].get_xticks())
        assert [text.get_text() for text in parts[name].get_xticklabels()] == ticks
    event = Event("7", "failsafe", "begin", "bad", "failsafe", time=3.0, boot=4.0)
    for place, text in zip(parts["flags"].get_xticks(), ticks, strict=True):
        assert times.find(text, event) == pytest.approx(place)


def test_time_axis_of_different_clocks_is_since_boot() -> None:
    """Vehicles that booted at different times share an axis only since boot. Messages made up."""
    parts = drawn([flight_of(), flight_of(vehicle="8")], times=Times(offsets={"7": 1.7e9, "8": 1.7e9 + 30}))
    assert parts["speed"].get_xlabel() == "time [s since boot]"
