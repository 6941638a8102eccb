"""Plot a log or a recording: the track, altitude and speed, the flags over time, and the estimator's resets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from nedbus.errors import OutputError
from nedbus_msgs import FLAGS, Address
from nedbus_msgs.arrays import MessageArray

_SIZE: Final = (12.0, 8.0)  # inches
_COLORS: Final = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#8c564b", "#e377c2")
_WARNING_COLOR: Final = "#d62728"
MAX_STREAMS: Final = len(_COLORS)
"""The number of streams that one plot can show."""

_FLAGS: Final = [flag for flag in FLAGS.values() if flag.kind == "estimate"]
_COUNTERS: Final = {
    "xy_reset_counter": "xy", "z_reset_counter": "z", "vxy_reset_counter": "vxy", "vz_reset_counter": "vz",
    "heading_reset_counter": "heading",
}  # fmt: skip


def draw(streams: Sequence[tuple[Address, MessageArray]], path: str | Path, *, title: str) -> None:
    """Write a plot of up to MAX_STREAMS streams; the file's suffix, .png, .svg or .pdf, is its format.

    Each stream has at least one message.
    Times are seconds since the first message of all, positions local NED in metres; altitude is -z.

    Raises OutputError when the file cannot be written.
    """
    figure = Figure(figsize=_SIZE, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplot_mosaic(
        [["track", "altitude"], ["track", "speed"], ["flags", "flags"]], height_ratios=[3, 2, 2], width_ratios=[1, 1.2]
    )
    start = min(int(messages["timestamp"][0]) for _, messages in streams)
    for (address, messages), color in zip(streams, _COLORS, strict=False):
        seconds = _seconds(messages, start)
        _draw_track(axes["track"], messages, color=color, label=str(address))
        _draw_altitude(axes["altitude"], seconds, messages, color=color)
        speed = np.hypot(messages["vx"], messages["vy"])
        axes["speed"].plot(seconds, np.where(messages["v_xy_valid"], speed, np.nan), color=color, linewidth=0.9)
    _draw_flags(axes["flags"], streams, start)
    axes["track"].set(xlabel="east [m]", ylabel="north [m]", title="track", aspect="equal", adjustable="datalim")
    axes["track"].legend(fontsize="small", loc="best")
    axes["altitude"].set(ylabel="altitude above origin, -z [m]", title="altitude; dashed: a reset")
    axes["speed"].set(xlabel="time [s]", ylabel="horizontal speed [m/s]", title="speed, while valid")
    for name in ("track", "altitude", "speed"):
        axes[name].grid(alpha=0.3)
    figure.suptitle(title)
    try:
        figure.savefig(path, dpi=120)
    except OSError as exc:
        raise OutputError(Path(path), exc) from exc


def _seconds(messages: MessageArray, start: int) -> Any:
    return (messages["timestamp"].astype(np.int64) - start) / 1e6


def _draw_track(axes: Any, messages: MessageArray, *, color: str, label: str) -> None:
    """Draw the track: thin and dotted where xy is invalid; a circle at its start, a square at its end."""
    axes.plot(messages["y"], messages["x"], color=color, linewidth=0.5, alpha=0.35, linestyle=":")
    north, east = (np.where(messages["xy_valid"], messages[name], np.nan) for name in ("x", "y"))
    axes.plot(east, north, color=color, linewidth=1.2, label=label)
    valid = np.flatnonzero(np.isfinite(north))
    if len(valid):
        axes.plot(east[valid[0]], north[valid[0]], "o", color=color, markersize=5)
        axes.plot(east[valid[-1]], north[valid[-1]], "s", color=color, markersize=5)


def _draw_altitude(axes: Any, seconds: Any, messages: MessageArray, *, color: str) -> None:
    axes.plot(seconds, -messages["z"], color=color, linewidth=0.5, alpha=0.35, linestyle=":")
    axes.plot(seconds, np.where(messages["z_valid"], -messages["z"], np.nan), color=color, linewidth=1.0)
    for time in np.unique(np.concatenate([seconds[1:][_is_reset(messages, counter)] for counter in _COUNTERS])):
        axes.axvline(time, color=color, linewidth=0.5, alpha=0.4, linestyle="--")


def _draw_flags(axes: Any, streams: Sequence[tuple[Address, MessageArray]], start: int) -> None:
    """Draw a bar for each flag of each stream while it is set, and a mark for each reset."""
    rows: list[str] = []
    for (address, messages), color in zip(streams, _COLORS, strict=False):
        seconds = _seconds(messages, start)
        suffix = f" {address}" if len(streams) > 1 else ""
        for flag in _FLAGS:
            bars = _intervals(seconds, messages[flag.name])
            axes.broken_barh(bars, (len(rows) - 0.35, 0.7), color=_WARNING_COLOR if flag.inverted else color)
            rows.append(flag.name + suffix)
        for counter, name in _COUNTERS.items():
            times = seconds[1:][_is_reset(messages, counter)]
            axes.plot(times, np.full(len(times), len(rows)), "|", color=color, markersize=7)
            if name == "heading" or len(times):
                rows.append(f"{name} resets{suffix}")
    axes.set_yticks(range(len(rows)), rows, fontsize="x-small" if len(rows) > 12 else "small")
    axes.set(xlabel="time [s]", title="set flags, and resets", ylim=(len(rows) - 0.4, -0.6))
    axes.grid(axis="x", alpha=0.3)


def _is_reset(messages: MessageArray, counter: str) -> Any:
    return np.diff(messages[counter].astype(np.int16)) != 0


def _intervals(seconds: Any, flag: Any) -> list[tuple[float, float]]:
    """Return start and length of each interval in which a flag is set, up to the first message where it is not."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flag, [False])).astype(np.int8)))
    ends = np.minimum(edges[1::2], len(seconds) - 1)
    return [(float(seconds[a]), float(seconds[b] - seconds[a])) for a, b in zip(edges[::2], ends, strict=True)]
