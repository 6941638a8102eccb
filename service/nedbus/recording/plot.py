"""Plot a log or a recording: the track, altitude and speed, the flags over time, and the estimator's resets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font

from nedbus.errors import ConfigError, OutputError
from nedbus.whole_file import whole_file
from nedbus_msgs import FLAGS, Address
from nedbus_msgs.arrays import MessageArray

from .arrays import missing_of

_SUFFIXES: Final = (".png", ".svg", ".pdf")
_WIDTH: Final = 12.0  # inches
_HEIGHT: Final = 6.0  # inches of the upper part
_FLAGS_HEIGHT: Final = 2.0  # inches of the lower part, at least
_ROW: Final = 0.17  # inches of the lower part that each row needs
_COLORS: Final = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#8c564b", "#e377c2")
_WARNING_COLOR: Final = "#d62728"
MAX_STREAMS: Final = len(_COLORS)
"""The number of streams that one plot can show."""

_FLAGS: Final = [flag for flag in FLAGS.values() if flag.kind == "estimate"]
_COUNTERS: Final = {
    "xy_reset_counter": "xy", "z_reset_counter": "z", "vxy_reset_counter": "vxy", "vz_reset_counter": "vz",
    "heading_reset_counter": "heading",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Row:
    """One row of the lower part: the intervals in which a flag is set, or the times of resets."""

    label: str
    color: str
    bars: Sequence[tuple[float, float]]
    marks: Sequence[float]


def draw(streams: Sequence[tuple[Address, MessageArray]], path: str | Path, *, title: str) -> None:
    """Write a plot of up to MAX_STREAMS streams; the file's suffix, .png, .svg or .pdf, is its format.

    Each stream has at least one message.
    Times are seconds since the first message of all, positions local NED in metres; altitude is -z.
    Fields that `missing_of` names are not drawn, and the plot says so.

    Raises ConfigError for another suffix, OutputError when the file cannot be written; then there is none.
    """
    if Path(path).suffix not in _SUFFIXES:
        raise ConfigError(str(path), f"expected a picture: a file that ends with {' or '.join(_SUFFIXES)}")
    start = min(int(messages["timestamp"][0]) for _, messages in streams)
    rows = [
        row for stream, color in zip(streams, _COLORS, strict=False) for row in _rows(stream, start, color, streams)
    ]
    flags_height = max(_FLAGS_HEIGHT, _ROW * len(rows))
    figure = Figure(figsize=(_WIDTH, _HEIGHT + flags_height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplot_mosaic(
        [["track", "altitude"], ["track", "speed"], ["flags", "flags"]],
        height_ratios=[0.6 * _HEIGHT, 0.4 * _HEIGHT, flags_height],
        width_ratios=[1, 1.2],
    )
    for (address, messages), color in zip(streams, _COLORS, strict=False):
        seconds = _seconds(messages, start)
        _draw_track(axes["track"], messages, color=color, label=str(address))
        _draw_altitude(axes["altitude"], seconds, messages, color=color)
        speed = np.hypot(messages["vx"], messages["vy"])
        axes["speed"].plot(seconds, np.where(messages["v_xy_valid"], speed, np.nan), color=color, linewidth=0.9)
    _draw_rows(axes["flags"], rows)
    axes["track"].set(xlabel="east [m]", ylabel="north [m]", aspect="equal", adjustable="datalim")
    axes["track"].set_title("track; circle: start, square: end, dotted: xy invalid")
    axes["track"].legend(fontsize="small", loc="best")
    axes["altitude"].set(ylabel="altitude above origin, -z [m]", title="altitude; dotted: z invalid, dashed: a reset")
    axes["speed"].set(xlabel="time [s]", ylabel="horizontal speed [m/s]", title="speed, while valid")
    for name, flag in (("track", "xy_valid"), ("altitude", "z_valid"), ("speed", "v_xy_valid")):
        axes[name].grid(alpha=0.3)
        if not any(messages[flag].any() for _, messages in streams):
            axes[name].text(0.5, 0.5, f"{flag} is never set", transform=axes[name].transAxes, ha="center")
    figure.suptitle(_legible(title), parse_math=False)
    figure.supxlabel(_explain_missing(streams), fontsize="small")
    try:
        with whole_file(Path(path), replace=True) as part:
            figure.savefig(part, dpi=120)
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
        axes.plot(east[valid[0]], north[valid[0]], "o", color=color, markersize=7, fillstyle="none")
        axes.plot(east[valid[-1]], north[valid[-1]], "s", color=color, markersize=4)


def _draw_altitude(axes: Any, seconds: Any, messages: MessageArray, *, color: str) -> None:
    axes.plot(seconds, -messages["z"], color=color, linewidth=0.5, alpha=0.35, linestyle=":")
    axes.plot(seconds, np.where(messages["z_valid"], -messages["z"], np.nan), color=color, linewidth=1.0)
    for time in np.unique(np.concatenate([seconds[1:][_is_reset(messages, counter)] for counter in _COUNTERS])):
        axes.axvline(time, color=color, linewidth=0.5, alpha=0.4, linestyle="--")


def _rows(
    stream: tuple[Address, MessageArray], start: int, color: str, streams: Sequence[tuple[Address, MessageArray]]
) -> Iterator[_Row]:
    """Yield a row for each flag of a stream, for each kind of reset that occurred, and for resets of heading."""
    address, messages = stream
    seconds, missing = _seconds(messages, start), missing_of(messages)
    suffix = f" {address}" if len(streams) > 1 else ""
    for flag in _FLAGS:
        if flag.name not in missing:
            shown = _WARNING_COLOR if flag.inverted else color
            yield _Row(flag.name + suffix, shown, _intervals(seconds, messages[flag.name]), ())
    for counter, name in _COUNTERS.items():
        times = seconds[1:][_is_reset(messages, counter)]
        if counter not in missing and (name == "heading" or len(times)):
            yield _Row(f"{name} resets{suffix}", color, (), times)


def _draw_rows(axes: Any, rows: Sequence[_Row]) -> None:
    for number, row in enumerate(rows):
        axes.broken_barh(row.bars, (number - 0.35, 0.7), color=row.color)
        axes.plot(row.marks, np.full(len(row.marks), number), "|", color=row.color, markersize=7)
    axes.set_yticks(range(len(rows)), [row.label for row in rows], fontsize="x-small" if len(rows) > 12 else "small")
    axes.set(xlabel="time [s]", title="set flags, and resets", ylim=(len(rows) - 0.4, -0.6))
    axes.grid(axis="x", alpha=0.3)


def _explain_missing(streams: Sequence[tuple[Address, MessageArray]]) -> str:
    """Return which of the rows are not drawn, as the flight does not have them."""
    drawn = [flag.name for flag in _FLAGS] + list(_COUNTERS)
    lines = []
    for address, messages in streams:
        names = [name for name in drawn if name in missing_of(messages)]
        if names:
            lines.append(f"{address} does not have {', '.join(names)}")
    return "\n".join(lines)


def _legible(text: str) -> str:
    """Return a text with "?" for each character that the font lacks, and a remark if there is any."""
    font = get_font(findfont(FontProperties()))
    shown = "".join(character if font.get_char_index(ord(character)) else "?" for character in text)
    return shown if shown == text else f"{shown} (?: a character that this font lacks)"


def _is_reset(messages: MessageArray, counter: str) -> Any:
    return np.diff(messages[counter].astype(np.int16)) != 0


def _intervals(seconds: Any, flag: Any) -> list[tuple[float, float]]:
    """Return start and length of each interval in which a flag is set, up to the first message where it is not."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flag, [False])).astype(np.int8)))
    ends = np.minimum(edges[1::2], len(seconds) - 1)
    return [(float(seconds[a]), float(seconds[b] - seconds[a])) for a, b in zip(edges[::2], ends, strict=True)]
