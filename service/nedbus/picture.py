"""A flight as a picture: its track, its altitude and speed, what was valid when, and where the estimator reset."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from nedbus_msgs import Address
from nedbus_msgs.arrays import Records

from .errors import RecordError

_SIZE: Final = (12.0, 8.0)  # inches
_COLORS: Final = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#8c564b", "#e377c2")
STREAMS: Final = len(_COLORS)
"""Streams that fit one picture."""

_FLAGS: Final = ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid", "heading_good_for_control", "dead_reckoning")
_COUNTERS: Final = {
    "xy_reset_counter": "xy", "z_reset_counter": "z", "vxy_reset_counter": "vxy", "vz_reset_counter": "vz",
    "heading_reset_counter": "heading",
}  # fmt: skip


def draw(streams: Sequence[tuple[Address, Records]], path: str | Path, *, title: str) -> None:
    """Write a picture of up to six streams; its format is that of the file's suffix, .png, .svg or .pdf.

    Times are seconds since the first message of all, positions local NED in metres; altitude is -z.

    Raises RecordError when the file cannot be written.
    """
    figure = Figure(figsize=_SIZE, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplot_mosaic(
        [["track", "altitude"], ["track", "speed"], ["flags", "flags"]], height_ratios=[3, 2, 2], width_ratios=[1, 1.2]
    )
    start = min(int(records["timestamp"][0]) for _, records in streams)
    for (address, records), color in zip(streams, _COLORS, strict=False):
        seconds = (records["timestamp"].astype(np.int64) - start) / 1e6
        _draw_track(axes["track"], records, color=color, label=str(address))
        _draw_altitude(axes["altitude"], seconds, records, color=color)
        speed = np.hypot(records["vx"], records["vy"])
        axes["speed"].plot(seconds, np.where(records["v_xy_valid"], speed, np.nan), color=color, linewidth=0.9)
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
        raise RecordError(Path(path), exc) from exc


def _draw_track(axes: Any, records: Records, *, color: str, label: str) -> None:
    valid = records["xy_valid"]
    axes.plot(records["y"], records["x"], color=color, linewidth=0.5, alpha=0.35, linestyle=":")
    good = {name: np.where(valid, records[name], np.nan) for name in ("x", "y")}
    axes.plot(good["y"], good["x"], color=color, linewidth=1.2, label=label)
    ends = np.flatnonzero(np.isfinite(good["x"]))
    if len(ends):
        axes.plot(good["y"][ends[0]], good["x"][ends[0]], "o", color=color, markersize=5)
        axes.plot(good["y"][ends[-1]], good["x"][ends[-1]], "s", color=color, markersize=5)


def _draw_altitude(axes: Any, seconds: Any, records: Records, *, color: str) -> None:
    axes.plot(seconds, -records["z"], color=color, linewidth=0.5, alpha=0.35, linestyle=":")
    axes.plot(seconds, np.where(records["z_valid"], -records["z"], np.nan), color=color, linewidth=1.0)
    for when in np.unique(np.concatenate([seconds[1:][_steps(records, counter)] for counter in _COUNTERS])):
        axes.axvline(when, color=color, linewidth=0.5, alpha=0.4, linestyle="--")


def _draw_flags(axes: Any, streams: Sequence[tuple[Address, Records]], start: int) -> None:
    """Draw a bar for each flag of each stream while it is set, and a mark for each reset."""
    rows: list[str] = []
    for (address, records), color in zip(streams, _COLORS, strict=False):
        seconds = (records["timestamp"].astype(np.int64) - start) / 1e6
        of = f" {address}" if len(streams) > 1 else ""
        for flag in _FLAGS:
            bars = _spans(seconds, records[flag])
            axes.broken_barh(bars, (len(rows) - 0.35, 0.7), color="#d62728" if flag == "dead_reckoning" else color)
            rows.append(flag + of)
        for counter, name in _COUNTERS.items():
            when = seconds[1:][_steps(records, counter)]
            axes.plot(when, np.full(len(when), len(rows)), "|", color=color, markersize=7)
            if name == "heading" or len(when):
                rows.append(f"{name} resets{of}")
    axes.set_yticks(range(len(rows)), rows, fontsize="x-small" if len(rows) > 12 else "small")
    axes.set(xlabel="time [s]", title="set flags, and resets", ylim=(len(rows) - 0.4, -0.6))
    axes.grid(axis="x", alpha=0.3)


def _steps(records: Records, counter: str) -> Any:
    return np.diff(records[counter].astype(np.int16)) != 0


def _spans(seconds: Any, flag: Any) -> list[tuple[float, float]]:
    """Return start and length of each time in which a flag is set, up to the first message that says otherwise."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flag, [False])).astype(np.int8)))
    ends = np.minimum(edges[1::2], len(seconds) - 1)
    return [(float(seconds[a]), float(seconds[b] - seconds[a])) for a, b in zip(edges[::2], ends, strict=True)]
