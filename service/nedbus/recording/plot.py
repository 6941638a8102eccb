"""Plot of a log or recording: track, altitude, speed, flags over time, and resets."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nedbus.errors import ConfigError, OutputError
from nedbus.events import Times, to_clock, unit_of
from nedbus.whole_file import whole_file
from nedbus_msgs import Address
from nedbus_msgs.arrays import MessageArray

from .arrays import missing_of

if TYPE_CHECKING:
    from matplotlib.typing import HashableList

_SUFFIXES: Final = (".png", ".svg", ".pdf")
_DPI: Final = 120
_WIDTH: Final = 12.0  # inches
_HEIGHT: Final = 6.0  # inches for track, altitude and speed
_ROW: Final = 0.2  # inches per row of flags below these
_FRAME: Final = 0.6  # inches for the title and axis of the rows
_COLORS: Final = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#8c564b", "#e377c2")
_WARNING_COLOR: Final = "#d62728"
_STEPS: Final = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1800, 3600, 7200, 21_600)  # s between ticks
_TICKS: Final = 6  # on a time axis
_BOOT: Final = Times()
MAX_STREAMS: Final = len(_COLORS)
"""Maximum number of streams in one plot."""

_FLAGS: Final = (  # estimator flags
    "xy_valid", "z_valid", "v_xy_valid", "v_z_valid", "heading_good_for_control", "dead_reckoning",
)  # fmt: skip
_COUNTERS: Final = {f"{name}_reset_counter": name for name in ("xy", "z", "vxy", "vz", "heading")}


class _Stream(NamedTuple):
    """A plotted stream, with the times of its messages since the first message of all streams [s], and its colour."""

    address: Address
    messages: MessageArray
    seconds: Any
    color: str

    def resets(self, counter: str) -> Any:
        """Return the times at which a reset counter changed [s]."""
        return self.seconds[1:][np.diff(self.messages[counter].astype(np.int16)) != 0]


def draw(
    streams: Sequence[tuple[Address, MessageArray]], path: str | Path, *, title: str, times: Times = _BOOT
) -> None:
    """Plot up to MAX_STREAMS streams to a file, in the format of its suffix: .png, .svg or .pdf.

    Each stream must have at least one message.
    The time axis has UTC if `times` has that of all vehicles, else seconds since boot.
    Positions are local NED in metres; altitude is -z.
    Fields named by `missing_of` are not plotted; a note lists them.

    Raises ConfigError for another suffix, OutputError if the file cannot be written; no partial file is left.
    """
    if Path(path).suffix.lower() not in _SUFFIXES:
        raise ConfigError(str(path), f"not a picture format: the name must end with {' or '.join(_SUFFIXES)}")
    try:
        with whole_file(Path(path), replace=True) as part, warnings.catch_warnings(action="ignore"):
            draw_figure(streams, title=title, times=times).savefig(part)  # a glyph missing in the font: only a warning
    except OSError as exc:
        raise OutputError(Path(path), exc) from exc


def draw_figure(streams: Sequence[tuple[Address, MessageArray]], *, title: str, times: Times = _BOOT) -> Figure:
    """Return the figure that `draw` saves."""
    start = min(int(messages["timestamp"][0]) for _, messages in streams)
    drawn = [
        _Stream(address, messages, (messages["timestamp"].astype(np.int64) - start) / 1e6, color)
        for (address, messages), color in zip(streams, _COLORS, strict=False)
    ]
    rows = _rows(drawn)
    height = _FRAME + _ROW * len(rows)
    figure = Figure(figsize=(_WIDTH, _HEIGHT + height), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    mosaic: list[HashableList[str]] = [["track", "altitude"], ["track", "speed"], ["flags", "flags"]]
    ratios = [0.6 * _HEIGHT, 0.4 * _HEIGHT, height]
    axes = figure.subplot_mosaic(mosaic, height_ratios=ratios, width_ratios=[1, 1.2])
    for name in ("speed", "flags"):
        axes[name].sharex(axes["altitude"])
    _draw_estimates(axes, drawn)
    _draw_flags(axes["flags"], rows)
    axes["track"].legend(fontsize="small", loc="best")
    seconds = np.concatenate([stream.seconds for stream in drawn])
    margin = 0.02 * (np.ptp(seconds) or 1.0)
    axes["altitude"].set_xlim(seconds.min() - margin, seconds.max() + margin)
    label = _label_times(axes["altitude"], drawn, start / 1e6, times)
    for name in ("speed", "flags"):
        axes[name].set_xlabel(label)
    figure.suptitle(title.encode(errors="replace").decode(), parse_math=False)  # a file name may have any bytes
    missing = {each.address: [*filter(missing_of(each.messages).__contains__, (*_FLAGS, *_COUNTERS))] for each in drawn}
    notes = (f"not in {address}: {', '.join(names)}" for address, names in missing.items() if names)
    figure.supxlabel("\n".join(notes), fontsize="small")
    return figure


def _label_times(axes: Any, streams: Sequence[_Stream], start: float, times: Times) -> str:
    """Put ticks on time axes that begin at `start` [s since boot], in UTC if it is one for all; return their label."""
    found = [times.utc_of_boot(stream.address.vehicle, start) for stream in streams]
    utc = [each for each in found if each is not None]
    has_utc = len(utc) == len(found) and max(utc) - min(utc) < 1.0
    shift = utc[0] if has_utc else start
    low, high = (limit + shift for limit in axes.get_xlim())
    step = next((step for step in _STEPS if high - low < _TICKS * step), _STEPS[-1])
    ticks = np.arange(np.ceil(low / step), high / step) * step
    texts = [to_clock(tick).removesuffix(".0") if has_utc else f"{tick:.7g}" for tick in ticks]
    axes.set_xticks(ticks - shift, texts)
    return f"time [{unit_of('vehicle' if has_utc else 'boot')}]"


def _draw_estimates(axes: Mapping[str, Any], streams: Sequence[_Stream]) -> None:
    """Plot the tracks, with a circle at the start and a square at the end of each, altitude and speed."""
    tracks = [(each.messages["y"], each.messages["x"]) for each in streams]
    _draw_lines(axes["track"], streams, "xy_valid", tracks, width=1.2)
    altitudes = [(each.seconds, -each.messages["z"]) for each in streams]
    _draw_lines(axes["altitude"], streams, "z_valid", altitudes, width=1.0)
    speeds = [(each.seconds, np.hypot(each.messages["vx"], each.messages["vy"])) for each in streams]
    _draw_lines(axes["speed"], streams, "v_xy_valid", speeds, width=0.9)
    for stream in streams:
        track = stream.messages[stream.messages["xy_valid"] & np.isfinite(stream.messages["x"])]
        if len(track):
            axes["track"].plot(track["y"][0], track["x"][0], "o", color=stream.color, markersize=7, fillstyle="none")
            axes["track"].plot(track["y"][-1], track["x"][-1], "s", color=stream.color, markersize=4)
        for time in np.union1d(stream.resets("z_reset_counter"), stream.resets("vz_reset_counter")):
            axes["altitude"].axvline(time, color=stream.color, linewidth=0.5, alpha=0.4, linestyle="--")
    axes["track"].set(xlabel="east [m]", ylabel="north [m]", aspect="equal", adjustable="datalim")
    axes["track"].locator_params(axis="x", nbins=6)  # more labels may overlap
    axes["track"].set_title("track; circle: start, square: end, thin: xy invalid")
    title = "altitude; thin: z invalid, dashed: z or vz reset"
    axes["altitude"].set(ylabel="altitude above origin, -z [m]", title=title)
    axes["speed"].set(ylabel="horizontal speed [m/s]", title="speed; thin: v_xy invalid")
    for name in ("track", "altitude", "speed"):
        axes[name].grid(alpha=0.3)


def _draw_lines(
    axes: Any, streams: Sequence[_Stream], flag: str, lines: Sequence[tuple[Any, Any]], *, width: float
) -> None:
    """Plot a line per stream, thin where its flag is not set; thin parts scale the axes only if no part is valid."""
    valid = [stream.messages[flag] for stream in streams]
    in_scale = not any(np.any(each & np.isfinite(y)) for each, (_, y) in zip(valid, lines, strict=True))
    for stream, each, line in zip(streams, valid, lines, strict=True):
        thin = Line2D(*line, color=stream.color, linewidth=0.5, alpha=0.6, zorder=1.9)  # below all others
        (axes.add_line if in_scale else axes.add_artist)(thin)  # artists do not affect the axis limits
        thick = (np.where(each, values, np.nan) for values in line)
        axes.plot(*thick, color=stream.color, linewidth=width, label=str(stream.address))


def _rows(streams: Sequence[_Stream]) -> list[tuple[str, _Stream, str]]:
    """Return label, stream and field of each row: flags, resets of each quantity that was reset, and heading resets."""
    rows: list[tuple[str, _Stream, str]] = []
    for stream in streams:
        suffix, missing = f" {stream.address}" if len(streams) > 1 else "", missing_of(stream.messages)
        rows += ((name + suffix, stream, name) for name in _FLAGS if name not in missing)
        for counter, name in _COUNTERS.items():
            if counter not in missing and (name == "heading" or len(stream.resets(counter))):
                rows.append((f"{name} resets{suffix}", stream, counter))
    return rows


def _draw_flags(axes: Any, rows: Sequence[tuple[str, _Stream, str]]) -> None:
    for number, (_, stream, field) in enumerate(rows):
        if field in _COUNTERS:
            times = stream.resets(field)
            axes.plot(times, np.full(len(times), number), "|", color=stream.color, markersize=7)
        else:
            flag, color = stream.messages[field], _WARNING_COLOR if field == "dead_reckoning" else stream.color
            is_shown = flag | np.append(False, flag[:-1])  # fill up to the first message without the flag
            axes.fill_between(stream.seconds, number - 0.35, number + 0.35, where=is_shown, color=color)
    axes.set_yticks(range(len(rows)), [label for label, *_ in rows], fontsize="x-small" if len(rows) > 12 else "small")
    axes.set(title="flags and resets", ylim=(len(rows) - 0.4, -0.6))
    axes.grid(axis="x", alpha=0.3)
