"""Plot of a log or recording: track, height, speed, flags over time, resets, and events; or named fields over time."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nedbus.atomic_write import atomic_write
from nedbus.clock import format_utc
from nedbus.errors import ConfigError, OutputError
from nedbus.health import SEVERITIES, Event, Times
from nedbus.vehicle_events import KINDS, Severity, spans_of
from nedbus_msgs import DEFAULT_TOPIC, Address
from nedbus_msgs.arrays import MessageArray, derive_column, mask_invalid
from nedbus_msgs.frames import DERIVED, derived_from

from .arrays import missing_of

if TYPE_CHECKING:
    from matplotlib.typing import HashableList

_SUFFIXES: Final = (".png", ".svg", ".pdf")
_DPI: Final = 120
_WIDTH: Final = 12.0  # inches
_HEIGHT: Final = 6.0  # inches for track, altitude and speed
_PANEL: Final = 2.0  # inches for a field
_ROW: Final = 0.2  # inches per row of flags or events below these
_FRAME: Final = 0.6  # inches for the title and axis of the rows
_COLORS: Final = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#8c564b", "#e377c2")
_WARNING_COLOR: Final = "#d62728"
_MARKERS: Final[Mapping[Severity, tuple[str, str, float]]] = {
    "bad": ("x", _WARNING_COLOR, 7.0), "watch": ("D", "#e69f00", 5.0), "info": ("|", "#707070", 6.0),
}  # fmt: skip
_LEGEND: Final[Mapping[Severity, str]] = {"watch": "watch event", "bad": "bad event"}
_LEGEND_TOP: Final = -0.1  # in heights of the track, below its axis label
# s between ticks
_STEPS: Final = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1800, 3600, 7200, 21_600)
_TICKS: Final = 6  # on a time axis
_BOOT: Final = Times()
_NEAR: Final = 1.0  # s between an event and the message with its position
_GAP: Final = 6.0  # points between a mark and its text
MAX_STREAMS: Final = len(_COLORS)
"""Maximum number of streams in one plot."""

_FLAGS: Final = (  # estimator flags
    "xy_valid", "z_valid", "v_xy_valid", "v_z_valid", "heading_good_for_control", "dead_reckoning",
)  # fmt: skip
_COUNTERS: Final = {f"{name}_reset_counter": name for name in ("xy", "z", "vxy", "vz", "heading")}

_Arrays = Sequence[tuple[Address, MessageArray]]


class _Stream(NamedTuple):
    """A plotted stream: its messages, their times since the first message of all streams [s], and its colour."""

    address: Address
    messages: MessageArray
    seconds: Any
    color: str

    def resets(self, counter: str) -> Any:
        """Return the times of the changes of a reset counter [s]."""
        return self.seconds[1:][np.diff(self.messages[counter].astype(np.int16)) != 0]


class _Mark(NamedTuple):
    """An event with its text, start and end [s], which are equal for an instantaneous event."""

    event: Event
    text: str
    begin: float
    end: float


def draw(
    streams: _Arrays, path: Path, *, title: str, events: Iterable[Event] = (), times: Times = _BOOT
) -> None:
    """Plot up to MAX_STREAMS streams to a file, in the format of its suffix: .png, .svg or .pdf.

    Each stream must have at least one message.
    The time axis shows UTC if `times` has it for all vehicles, else seconds since boot.
    Positions are local NED in metres; height is -z.
    Fields named by `missing_of` are not plotted; a note lists them.
    `events`: events of severity bad or watch, mode changes, arming and landing of plotted vehicles are marked.

    Raises ConfigError for another suffix, OutputError if the file cannot be written; no partial file is left.
    """
    _save(path, lambda: draw_figure(streams, title=title, events=events, times=times))


def draw_fields(
    streams: _Arrays, names: Sequence[str], path: Path, *, title: str, events: Iterable[Event] = (),
    times: Times = _BOOT,
) -> None:  # fmt: skip
    """Plot fields of up to MAX_STREAMS streams over time, one below the other; also names of `nedbus.frames.DERIVED`.

    Invalid values are gaps. Time axis, events and errors as in `draw`; ConfigError also for a field that no stream has,
    or that is not a number.
    """
    _save(path, lambda: draw_field_figure(streams, names, title=title, events=events, times=times))


def _save(path: Path, draw_it: Callable[[], Figure]) -> None:
    """Save a figure in the format of the file's suffix; nothing is drawn for another suffix."""
    if path.suffix.lower() not in _SUFFIXES:
        raise ConfigError(
            str(path), f"not an image format; the name must end with {' or '.join(_SUFFIXES)}"
        )
    try:
        # A glyph that the font lacks is only a warning.
        with atomic_write(path, replace=True) as part, warnings.catch_warnings(action="ignore"):
            draw_it().savefig(part)
    except OSError as exc:
        raise OutputError(path, exc) from exc


def draw_figure(
    streams: _Arrays, *, title: str, events: Iterable[Event] = (), times: Times = _BOOT
) -> Figure:
    """Return the figure that `draw` saves."""
    drawn, start = _streams(streams)
    rows, marks = _rows(drawn), _marks(drawn, start / 1e6, events)
    heights = [_FRAME + _ROW * len(each) for each in (rows, marks) if each]
    figure = Figure(figsize=(_WIDTH, _HEIGHT + sum(heights)), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    mosaic: list[HashableList[str]] = [["track", "altitude"], ["track", "speed"]]
    lowest = "speed"
    if rows:
        lowest = "flags"
        mosaic.append([lowest, lowest])
    if marks:
        lowest = "events"
        mosaic.append([lowest, lowest])
    ratios = [0.6 * _HEIGHT, 0.4 * _HEIGHT, *heights]
    axes = figure.subplot_mosaic(mosaic, height_ratios=ratios, width_ratios=[1, 1.2])
    for name in axes.keys() - {"track", "altitude"}:
        axes[name].sharex(axes["altitude"])
    _draw_estimates(axes, drawn)
    if rows:
        _draw_flags(axes["flags"], rows)
    by_time = sorted((mark for own in marks.values() for mark in own), key=lambda mark: mark.begin)
    _mark_events(axes, drawn, by_time)
    # Below the label of the axis; inside the axes it would cover the track.
    axes["track"].legend(
        fontsize="small", ncols=2, loc="upper center", bbox_to_anchor=(0.5, _LEGEND_TOP)
    )
    seconds = np.concatenate(
        [*(stream.seconds for stream in drawn), *([mark.begin, mark.end] for mark in by_time)]
    )
    margin = 0.02 * (np.ptp(seconds) or 1.0)
    # room for the last label
    axes["altitude"].set_xlim(seconds.min() - margin, seconds.max() + 3 * margin)
    label = _label_times(axes["altitude"], drawn, start / 1e6, times)
    for name in {"speed", lowest}:
        axes[name].set_xlabel(label)
    # a file name may contain any bytes
    figure.suptitle(title.encode(errors="replace").decode(), parse_math=False)
    missing = {
        each.address: [*filter(missing_of(each.messages).__contains__, (*_FLAGS, *_COUNTERS))]
        for each in drawn
    }
    notes = (f"not in {address}: {', '.join(names)}" for address, names in missing.items() if names)
    figure.supxlabel("\n".join(notes), fontsize="small")
    if marks:
        _draw_events(figure, axes["events"], marks)
    return figure


def draw_field_figure(
    streams: _Arrays,
    names: Sequence[str],
    *,
    title: str,
    events: Iterable[Event] = (),
    times: Times = _BOOT,
) -> Figure:
    """Return the figure that `draw_fields` saves."""
    drawn, start = _streams(streams)
    marks = _marks(drawn, start / 1e6, events)
    heights = [_PANEL] * len(names)
    mosaic: list[HashableList[str]] = [[name] for name in names]
    if marks:
        heights.append(_FRAME + _ROW * len(marks))
        mosaic.append(["events"])
    figure = Figure(figsize=(_WIDTH, _FRAME + sum(heights)), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplot_mosaic(mosaic, height_ratios=heights)
    first = axes[names[0]]
    lowest = axes["events" if marks else names[-1]]
    for panel in axes.values():
        if panel is not first:
            panel.sharex(first)
    for name in names:
        _draw_field(axes[name], drawn, name)
    if len(drawn) > 1:
        first.legend(fontsize="small", loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    lowest.set_xlabel(_label_times(first, drawn, start / 1e6, times))
    # a file name may contain any bytes
    figure.suptitle(title.encode(errors="replace").decode(), parse_math=False)
    if marks:
        _draw_events(figure, axes["events"], marks)
    return figure


def _draw_field(axes: Any, streams: Sequence[_Stream], name: str) -> None:
    """Plot a field of the streams that have it."""
    drawn = 0
    for stream in streams:
        values = _values_of(stream.messages, name)
        if values is not None:
            axes.plot(
                stream.seconds, values, color=stream.color, linewidth=0.9, label=str(stream.address)
            )
            drawn += 1
    if not drawn:
        known = sorted({each for stream in streams for each in _plottable(stream.messages)})
        raise ConfigError(
            "--field", f"no selected stream has a number {name!r}; they have {', '.join(known)}"
        )
    meaning = DERIVED[name].meaning if name in DERIVED else name
    axes.set_title(meaning, fontsize="medium", loc="right", parse_math=False)
    axes.grid(alpha=0.3)


def _plottable(messages: MessageArray) -> list[str]:
    """Return the names of the fields with one number or flag each, and of the quantities derived from fields."""
    names = messages.dtype.names or ()
    own = [
        name
        for name in names
        if messages.dtype[name].shape == () and messages.dtype[name].kind in "biuf"
    ]
    return own + derived_from(names)


def _values_of(messages: MessageArray, name: str) -> Any:
    """Return the values of a field, NaN where invalid; None if the messages do not have it."""
    if name not in _plottable(messages):
        return None
    if name in (messages.dtype.names or ()):
        return mask_invalid(messages)[name]
    return derive_column(messages, name)


def _streams(streams: _Arrays) -> tuple[list[_Stream], int]:
    """Return the plotted streams, and the time of their first message [us]."""
    start = min(int(messages["timestamp"][0]) for _, messages in streams)
    drawn = [
        _Stream(address, messages, (messages["timestamp"].astype(np.int64) - start) / 1e6, color)
        for (address, messages), color in zip(streams, _COLORS, strict=False)
    ]
    return drawn, start


def _label_times(axes: Any, streams: Sequence[_Stream], start: float, times: Times) -> str:
    """Label time axes that begin at `start` [s since boot], in UTC if the vehicles agree; return the axis label."""
    found = [times.utc_of_boot(stream.address.vehicle, start) for stream in streams]
    utc = [each for each in found if each is not None]
    has_utc = len(utc) == len(found) and max(utc) - min(utc) < 1.0
    shift = utc[0] if has_utc else start
    low, high = (limit + shift for limit in axes.get_xlim())
    step = next((step for step in _STEPS if high - low < _TICKS * step), _STEPS[-1])
    ticks = np.arange(np.ceil(low / step), high / step) * step
    texts = [format_utc(tick).removesuffix(".0") if has_utc else f"{tick:.7g}" for tick in ticks]
    axes.set_xticks(ticks - shift, texts)
    return f"time [{Times.unit('vehicle' if has_utc else 'boot')}]"


def _draw_estimates(axes: Mapping[str, Any], streams: Sequence[_Stream]) -> None:
    """Plot altitude, speed, and tracks with a circle at the start and a square at the end."""
    tracks = [(each.messages["y"], each.messages["x"]) for each in streams]
    _draw_lines(axes["track"], streams, "xy_valid", tracks, width=1.2)
    altitudes = [(each.seconds, -each.messages["z"]) for each in streams]
    _draw_lines(axes["altitude"], streams, "z_valid", altitudes, width=1.0)
    speeds = [
        (each.seconds, np.hypot(each.messages["vx"], each.messages["vy"])) for each in streams
    ]
    _draw_lines(axes["speed"], streams, "v_xy_valid", speeds, width=0.9)
    for stream in streams:
        track = stream.messages[stream.messages["xy_valid"] & np.isfinite(stream.messages["x"])]
        if len(track):
            axes["track"].plot(
                track["y"][0],
                track["x"][0],
                "o",
                color=stream.color,
                markersize=7,
                fillstyle="none",
            )
            axes["track"].plot(
                track["y"][-1], track["x"][-1], "s", color=stream.color, markersize=4
            )
        for time in np.union1d(stream.resets("z_reset_counter"), stream.resets("vz_reset_counter")):
            axes["altitude"].axvline(
                time, color=stream.color, linewidth=0.5, alpha=0.4, linestyle="--"
            )
    axes["track"].set(xlabel="east [m]", ylabel="north [m]", aspect="equal", adjustable="datalim")
    axes["track"].locator_params(axis="x", nbins=6)  # more labels may overlap
    axes["track"].set_title("track; circle: start, square: end, thin: xy invalid")
    title = "height; thin: z invalid, dashed: z or vz reset"
    axes["altitude"].set(ylabel="height above origin, -z [m]", title=title)
    axes["speed"].set(ylabel="horizontal speed [m/s]", title="speed; thin: v_xy invalid")
    for name in ("track", "altitude", "speed"):
        axes[name].grid(alpha=0.3)


def _draw_lines(
    axes: Any,
    streams: Sequence[_Stream],
    flag: str,
    lines: Sequence[tuple[Any, Any]],
    *,
    width: float,
) -> None:
    """Plot a line per stream, thin where its flag is false; thin parts affect the limits only if nothing is valid."""
    valid = [stream.messages[flag] for stream in streams]
    in_scale = not any(
        np.any(each & np.isfinite(y)) for each, (_, y) in zip(valid, lines, strict=True)
    )
    for stream, each, line in zip(streams, valid, lines, strict=True):
        # below all other lines
        thin = Line2D(*line, color=stream.color, linewidth=0.5, alpha=0.6, zorder=1.9)
        # artists do not affect the axis limits
        (axes.add_line if in_scale else axes.add_artist)(thin)
        thick = (np.where(each, values, np.nan) for values in line)
        axes.plot(*thick, color=stream.color, linewidth=width, label=str(stream.address))


def _rows(streams: Sequence[_Stream]) -> list[tuple[str, _Stream, str]]:
    """Return label, stream and field of each row: flags, heading resets, and other reset counters that change."""
    rows: list[tuple[str, _Stream, str]] = []
    for stream in streams:
        suffix = f" {stream.address}" if len(streams) > 1 else ""
        missing = missing_of(stream.messages)
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
            flag = stream.messages[field]
            color = _WARNING_COLOR if field == "dead_reckoning" else stream.color
            # fill to the first message without the flag
            is_shown = flag | np.append(False, flag[:-1])
            axes.fill_between(
                stream.seconds, number - 0.35, number + 0.35, where=is_shown, color=color
            )
    axes.set_yticks(
        range(len(rows)),
        [label for label, *_ in rows],
        fontsize="x-small" if len(rows) > 12 else "small",
    )
    axes.set(title="flags and resets", ylim=(len(rows) - 0.4, -0.6))
    axes.grid(axis="x", alpha=0.3)


def _marks(
    streams: Sequence[_Stream], start: float, events: Iterable[Event]
) -> dict[str, list[_Mark]]:
    """Return the marks of the plotted vehicles by row, the most severe row first, each row in chronological order.

    Events far from all messages are left out, because their timestamps must be damaged.
    """
    timed = [event for event in events if event.boot is not None]
    rows = defaultdict[str, dict[Event, _Mark]](dict)
    vehicles = sorted({stream.address.vehicle for stream in streams})
    for vehicle in vehicles:
        seconds = np.concatenate(
            [stream.seconds for stream in streams if stream.address.vehicle == vehicle]
        )
        first, last = float(seconds.min()), float(seconds.max())
        for span in spans_of([event for event in timed if event.vehicle == vehicle]):
            event = span.begin
            if (
                span.initial
                or event.boot is None
                or (event.severity == "info" and not KINDS[event.kind].phase)
            ):
                continue
            offset = event.boot - start - event.time
            begin = span.since + offset
            if max(first - begin, begin - last) > last - first + _NEAR:
                continue
            row = KINDS[event.kind].row or event.kind.replace("_", " ")
            text = (
                event.names[-1] if event.kind == "mode" else event.text if event.text != row else ""
            )
            marks = rows[f"{row} {vehicle}" if len(vehicles) > 1 else row]
            end = max(begin, last if span.until is None else min(span.until + offset, last))
            # Conditions that begin with the same event share a mark, which ends when the last condition ends.
            marks[event] = _Mark(
                event, text, begin, max(end, marks[event].end) if event in marks else end
            )
    order = {
        row: min((SEVERITIES.index(each.event.severity), each.begin) for each in rows[row].values())
        for row in rows
    }
    return {
        row: sorted(rows[row].values(), key=lambda mark: mark.begin)
        for row in sorted(rows, key=order.__getitem__)
    }


def _mark_events(
    axes: Mapping[str, Any], streams: Sequence[_Stream], marks: Iterable[_Mark]
) -> None:
    """Mark the start of bad and watch events on the track and on the time axes of altitude and speed."""
    by_preference = sorted(streams, key=lambda stream: stream.address.topic == DEFAULT_TOPIC)
    main = {stream.address.vehicle: stream for stream in by_preference}
    for severity, label in _LEGEND.items():
        marker, color, size = _MARKERS[severity]
        own = [mark for mark in marks if mark.event.severity == severity]
        if not own:
            continue
        style: dict[str, Any] = {
            "marker": marker,
            "color": color,
            "fillstyle": "none",
            "linestyle": "none",
        }
        places = []
        for mark in own:
            stream = main[mark.event.vehicle]
            nearest = np.abs(stream.seconds - mark.begin).argmin()
            if abs(stream.seconds[nearest] - mark.begin) <= _NEAR:
                places.append((stream.messages["y"][nearest], stream.messages["x"][nearest]))
        if places:
            found = Line2D(
                *zip(*places, strict=True),
                label=label,
                markersize=size + 1,
                markeredgewidth=1.5,
                zorder=3,
            )
            found.set(**style)
            axes["track"].add_artist(found)
        for name in ("altitude", "speed"):
            bottom = axes[name].get_xaxis_transform()
            times = [mark.begin for mark in own]
            axes[name].add_artist(
                Line2D(times, [0.03] * len(own), transform=bottom, markersize=size - 1, **style)
            )


def _draw_events(figure: Figure, axes: Any, rows: Mapping[str, Sequence[_Mark]]) -> None:
    """Plot the marks row by row, with labels where they fit before the next mark."""
    for number, marks in enumerate(rows.values()):
        for mark in marks:
            marker, color, size = _MARKERS[mark.event.severity]
            bar = [(mark.begin, mark.end - mark.begin)]
            axes.broken_barh(bar, (number - 0.35, 0.7), color=color, alpha=0.3, linewidth=0)
            axes.plot(mark.begin, number, marker, color=color, markersize=size)
    axes.set_yticks(range(len(rows)), rows.keys(), fontsize="small", parse_math=False)
    axes.set(title="events; x: bad, diamond: watch, bar: duration", ylim=(len(rows) - 0.4, -0.6))
    axes.grid(axis="x", alpha=0.3)
    figure.draw_without_rendering()  # computes the layout, on which the space for labels depends
    gap = _GAP * _DPI / 72
    for number, marks in enumerate(rows.values()):
        places = [float(axes.transData.transform((mark.begin, number))[0]) for mark in marks[1:]]
        for mark, after in zip(
            marks, [*places, float(axes.get_window_extent().x1) + gap], strict=True
        ):
            text = axes.annotate(
                mark.text, (mark.begin, number), (_GAP, 0), textcoords="offset points", va="center_baseline",
                fontsize="x-small", parse_math=False,
            )  # fmt: skip
            text.set_in_layout(False)
            box = text.get_window_extent()
            # text width differs slightly between file formats
            if box.x0 + 1.05 * box.width > after - gap:
                text.remove()
