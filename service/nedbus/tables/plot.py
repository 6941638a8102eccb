"""Plot of a log or recording: track, height, speed, flags over time, resets, and events; or named fields over time."""

from __future__ import annotations

import re
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nedbus.atomic_write import atomic_write
from nedbus.clock import format_utc
from nedbus.errors import ConfigError, OutputError
from nedbus.health import SEVERITIES, Event, Span, Times
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
STREAM_COLORS: Final = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#8c564b", "#e377c2")
"""Colours of the streams of a plot, which can show as many streams."""
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
_MANY_ROWS: Final = 12  # more rows get smaller labels
_NOTE_WIDTH: Final = 160  # characters
_RESTART: Final = 1.0  # s; a longer step back is no reordering
# an element of an array field, such as `q[0]`
_ELEMENT: Final = re.compile(r"(?P<field>\w+)\[(?P<index>\d{1,3})\]", re.ASCII)

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
        steps = np.diff(self.messages[counter].astype(np.int16))
        steps[self.restarts - 1] = 0
        return self.seconds[1:][steps != 0]

    @property
    def restarts(self) -> Any:
        """The indices of the first messages after a restart of the timestamps, as after a reboot."""
        return np.flatnonzero(np.diff(self.seconds) < -_RESTART) + 1

    def line(self, values: Any) -> Any:
        """Return values of the messages for a line that breaks at restarts."""
        return np.insert(np.asarray(values, dtype=np.float64), self.restarts, np.nan)

    def position_at(self, seconds: float) -> Any:
        """Return the message nearest in time; None if it is far from that."""
        distances = np.abs(self.seconds - seconds)
        nearest = distances.argmin()
        if distances[nearest] <= _NEAR:
            return self.messages[nearest]
        return None


class _Row(NamedTuple):
    """A row of flags or resets: its label, and the stream and field that it shows."""

    label: str
    stream: _Stream
    field: str


class _Mark(NamedTuple):
    """An event with its text, start and end [s], which are equal for an instantaneous event."""

    event: Event
    text: str
    begin: float
    end: float


def draw(
    streams: _Arrays, path: Path, *, title: str, events: Iterable[Event] = (), times: Times = _BOOT
) -> None:
    """Plot streams to a file, in the format of its suffix: .png, .svg or .pdf.

    There are at most as many streams as STREAM_COLORS. Each stream must have at least one message.
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
    """Plot fields of streams over time, one below the other; also elements, `q[0]`, and names of `frames.DERIVED`.

    Invalid values are gaps. Time axis, events and errors as in `draw`; ConfigError also for a field that no stream has,
    or that is not a number.
    """
    _save(path, lambda: draw_field_figure(streams, names, title=title, events=events, times=times))


def _save(path: Path, draw_it: Callable[[], Figure]) -> None:
    """Save a figure in the format of the file's suffix; nothing is drawn for another suffix."""
    if path.suffix.lower() not in _SUFFIXES:
        suffixes = " or ".join(_SUFFIXES)
        raise ConfigError(str(path), f"not an image format; the name must end with {suffixes}")
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
    rows = _rows(drawn)
    marks = _marks(drawn, start, events)
    mosaic: list[HashableList[str]] = [["track", "altitude"], ["track", "speed"]]
    heights = [0.6 * _HEIGHT, 0.4 * _HEIGHT]
    lowest = "speed"
    if rows:
        lowest = "flags"
        mosaic.append([lowest, lowest])
        heights.append(_FRAME + _ROW * len(rows))
    if marks:
        lowest = "events"
        mosaic.append([lowest, lowest])
        heights.append(_FRAME + _ROW * len(marks))
    figure = _new_figure(sum(heights), title)
    axes = figure.subplot_mosaic(mosaic, height_ratios=heights, width_ratios=[1, 1.2])
    for name in axes.keys() - {"track", "altitude"}:
        axes[name].sharex(axes["altitude"])
    _draw_estimates(axes, drawn)
    if rows:
        _draw_flags(axes["flags"], rows)
    in_order = [mark for row in marks.values() for mark in row]
    in_order.sort(key=lambda mark: mark.begin)
    _mark_events(axes, drawn, in_order)
    # Below the label of the axis; inside the axes it would cover the track.
    axes["track"].legend(
        fontsize="small", ncols=2, loc="upper center", bbox_to_anchor=(0.5, _LEGEND_TOP)
    )
    _set_time_limits(axes["altitude"], drawn, in_order)
    label = _label_times(axes["altitude"], drawn, start, times)
    for name in {"speed", lowest}:
        axes[name].set_xlabel(label)
    notes = "\n".join(fill(note, _NOTE_WIDTH) for note in _notes(drawn))
    figure.supxlabel(notes, fontsize="small")
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
    marks = _marks(drawn, start, events)
    mosaic: list[HashableList[str]] = [[name] for name in names]
    heights = [_PANEL for _ in names]
    lowest = names[-1]
    if marks:
        lowest = "events"
        mosaic.append([lowest])
        heights.append(_FRAME + _ROW * len(marks))
    figure = _new_figure(_FRAME + sum(heights), title)
    axes = figure.subplot_mosaic(mosaic, height_ratios=heights)
    first = axes[names[0]]
    for panel in axes.values():
        if panel is not first:
            panel.sharex(first)
    for name in names:
        _draw_field(axes[name], drawn, name)
    if len(drawn) > 1:
        first.legend(fontsize="small", loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    label = _label_times(first, drawn, start, times)
    axes[lowest].set_xlabel(label)
    if marks:
        _draw_events(figure, axes["events"], marks)
    return figure


def _new_figure(height: float, title: str) -> Figure:
    """Return an empty figure of a height [inches]."""
    figure = Figure(figsize=(_WIDTH, height), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    printable = title.encode(errors="replace").decode()  # a file name may contain any bytes
    figure.suptitle(printable, parse_math=False)
    return figure


def _notes(streams: Sequence[_Stream]) -> Iterator[str]:
    """Yield a note for each stream that lacks plotted fields, and for each with several boots."""
    for stream in streams:
        missing = missing_of(stream.messages)
        names = [name for name in (*_FLAGS, *_COUNTERS) if name in missing]
        absent = [name for name in names if not _has(stream, name)]
        if absent:
            yield f"not in {stream.address}: {', '.join(absent)}"
        partial = [name for name in names if name not in absent]
        if partial:
            yield f"not in all messages of {stream.address}, and drawn as off there: {', '.join(partial)}"
        if len(stream.restarts):
            yield f"{stream.address} restarts, as after a reboot: its parts are drawn over one another"


def _has(stream: _Stream, name: str) -> bool:
    """Return whether any message has a flag or a counter; the missing ones are false or 0."""
    if name not in missing_of(stream.messages):
        return True
    return bool(stream.messages[name].any())


def _draw_field(axes: Any, streams: Sequence[_Stream], name: str) -> None:
    """Plot a field of the streams that have it."""
    is_drawn = False
    for stream in streams:
        values = _values_of(stream.messages, name)
        if values is not None:
            label = str(stream.address)
            seconds = stream.line(stream.seconds)
            values = stream.line(values)
            axes.plot(seconds, values, color=stream.color, linewidth=0.9, label=label)
            is_drawn = True
    if not is_drawn:
        known = set[str]()
        for stream in streams:
            known.update(_plottable(stream.messages))
        names = ", ".join(sorted(known))
        raise ConfigError("--field", f"no selected stream has a number {name!r}; they have {names}")
    if name in DERIVED:
        meaning = DERIVED[name].meaning
    else:
        meaning = name
    axes.set_title(meaning, fontsize="medium", loc="right", parse_math=False)
    axes.grid(alpha=0.3)


def _numeric_fields(messages: MessageArray) -> dict[str, int]:
    """Return the number of elements of each field of numbers or flags, 0 for a field that is not an array."""
    sizes = dict[str, int]()
    for name in messages.dtype.names or ():
        dtype = messages.dtype[name]
        if dtype.base.kind not in "biuf":
            continue
        sizes[name] = 0
        if dtype.shape:
            sizes[name] = dtype.shape[0]
    return sizes


def _plottable(messages: MessageArray) -> list[str]:
    """Return what can be plotted: fields, elements of arrays as `q[0] to q[3]`, and quantities derived from fields."""
    plottable = derived_from(messages.dtype.names or ())
    for name, size in _numeric_fields(messages).items():
        if size:
            plottable.append(f"{name}[0] to {name}[{size - 1}]")
        else:
            plottable.append(name)
    return plottable


def _values_of(messages: MessageArray, name: str) -> Any:
    """Return the values of a field or an element, NaN where invalid; None if the messages do not have it."""
    sizes = _numeric_fields(messages)
    element = _ELEMENT.fullmatch(name)
    if element is not None:
        field = element["field"]
        index = int(element["index"])
        if index < sizes.get(field, 0):
            return mask_invalid(messages)[field][:, index]
    elif sizes.get(name) == 0:
        return mask_invalid(messages)[name]
    elif name in derived_from(messages.dtype.names or ()):
        return derive_column(messages, name)
    return None


def _streams(streams: _Arrays) -> tuple[list[_Stream], float]:
    """Return the plotted streams, and the time of their first message [s since boot]."""
    start = min(int(messages["timestamp"][0]) for _, messages in streams)
    drawn = []
    for (address, messages), color in zip(streams, STREAM_COLORS, strict=False):
        seconds = (messages["timestamp"].astype(np.int64) - start) / 1e6
        drawn.append(_Stream(address, messages, seconds, color))
    return drawn, start / 1e6


def _set_time_limits(axes: Any, streams: Sequence[_Stream], marks: Sequence[_Mark]) -> None:
    """Show all messages and marks, with room for the label of the last mark."""
    seconds = [stream.seconds for stream in streams]
    ends = [time for mark in marks for time in (mark.begin, mark.end)]
    shown = np.concatenate([*seconds, ends])
    duration = np.ptp(shown) or 1.0
    margin = 0.02 * duration
    axes.set_xlim(shown.min() - margin, shown.max() + 3 * margin)


def _label_times(axes: Any, streams: Sequence[_Stream], start: float, times: Times) -> str:
    """Label time axes that begin at `start` [s since boot], in UTC if the vehicles agree; return the axis label."""
    utc = []
    for stream in streams:
        begin = times.utc_of_boot(stream.address.vehicle, start)
        if begin is not None:
            utc.append(begin)
    has_utc = len(utc) == len(streams) and max(utc) - min(utc) < 1.0
    shift = start
    unit = Times.unit("boot")
    if has_utc:
        shift = utc[0]
        unit = Times.unit("vehicle")
    low, high = axes.get_xlim()
    low += shift
    high += shift
    step = _step_of(high - low)
    first = np.ceil(low / step)
    ticks = np.arange(first, high / step) * step
    labels = [f"{tick + 0.0:.7g}" for tick in ticks]  # 0 for -0
    if has_utc:
        labels = [format_utc(tick).removesuffix(".0") for tick in ticks]
    axes.set_xticks(ticks - shift, labels)
    return f"time [{unit}]"


def _step_of(duration: float) -> float:
    """Return the time between two ticks of an axis [s]."""
    for step in _STEPS:
        if duration < _TICKS * step:
            return step
    return _STEPS[-1]


def _draw_estimates(axes: Mapping[str, Any], streams: Sequence[_Stream]) -> None:
    """Plot altitude, speed, and tracks with a circle at the start and a square at the end."""
    tracks = []
    altitudes = []
    speeds = []
    for stream in streams:
        messages = stream.messages
        tracks.append((messages["y"], messages["x"]))
        altitudes.append((stream.seconds, -messages["z"]))
        speed = np.hypot(messages["vx"], messages["vy"])
        speeds.append((stream.seconds, speed))
    _draw_lines(axes["track"], streams, "xy_valid", tracks, width=1.2)
    _draw_lines(axes["altitude"], streams, "z_valid", altitudes, width=1.0)
    _draw_lines(axes["speed"], streams, "v_xy_valid", speeds, width=0.9)
    for stream in streams:
        _mark_ends(axes["track"], stream)
        _mark_resets(axes["altitude"], stream)
    axes["track"].set(xlabel="east [m]", ylabel="north [m]", aspect="equal", adjustable="datalim")
    axes["track"].locator_params(axis="x", nbins=6)  # more labels may overlap
    axes["track"].set_title("track; circle: start, square: end, thin: xy invalid")
    title = "height; thin: z invalid, dashed: z or vz reset"
    axes["altitude"].set(ylabel="height above origin, -z [m]", title=title)
    axes["speed"].set(ylabel="horizontal speed [m/s]", title="speed; thin: v_xy invalid")
    for name in ("track", "altitude", "speed"):
        axes[name].grid(alpha=0.3)


def _mark_ends(axes: Any, stream: _Stream) -> None:
    is_valid = stream.messages["xy_valid"] & np.isfinite(stream.messages["x"])
    track = stream.messages[is_valid]
    if len(track):
        first = track[0]
        last = track[-1]
        color = stream.color
        axes.plot(first["y"], first["x"], "o", color=color, markersize=7, fillstyle="none")
        axes.plot(last["y"], last["x"], "s", color=color, markersize=4)


def _mark_resets(axes: Any, stream: _Stream) -> None:
    of_height = stream.resets("z_reset_counter")
    of_speed = stream.resets("vz_reset_counter")
    for time in np.union1d(of_height, of_speed):
        axes.axvline(time, color=stream.color, linewidth=0.5, alpha=0.4, linestyle="--")


def _draw_lines(
    axes: Any,
    streams: Sequence[_Stream],
    flag: str,
    lines: Sequence[tuple[Any, Any]],
    *,
    width: float,
) -> None:
    """Plot a line per stream, thin where its flag is false; thin parts affect the limits only if nothing is valid."""
    has_valid = False
    for stream, (_, y) in zip(streams, lines, strict=True):
        is_valid = stream.messages[flag] & np.isfinite(y)
        if is_valid.any():
            has_valid = True
    for stream, (x, y) in zip(streams, lines, strict=True):
        x_line = stream.line(x)
        y_line = stream.line(y)
        # below all other lines
        thin = Line2D(x_line, y_line, color=stream.color, linewidth=0.5, alpha=0.6, zorder=1.9)
        if has_valid:
            axes.add_artist(thin)  # artists do not affect the axis limits
        else:
            axes.add_line(thin)
        is_valid = np.insert(stream.messages[flag], stream.restarts, False)
        valid_x = np.where(is_valid, x_line, np.nan)
        valid_y = np.where(is_valid, y_line, np.nan)
        label = str(stream.address)
        axes.plot(valid_x, valid_y, color=stream.color, linewidth=width, label=label)


def _rows(streams: Sequence[_Stream]) -> list[_Row]:
    """Return the rows of all flags, of heading resets, and of other reset counters that change."""
    rows = []
    for stream in streams:
        suffix = ""
        if len(streams) > 1:
            suffix = f" {stream.address}"
        for flag in _FLAGS:
            if _has(stream, flag):
                rows.append(_Row(flag + suffix, stream, flag))
        for counter, name in _COUNTERS.items():
            if not _has(stream, counter):
                continue
            if name == "heading" or len(stream.resets(counter)):
                rows.append(_Row(f"{name} resets{suffix}", stream, counter))
    return rows


def _draw_flags(axes: Any, rows: Sequence[_Row]) -> None:
    for number, (_, stream, field) in enumerate(rows):
        if field in _COUNTERS:
            times = stream.resets(field)
            heights = np.full(len(times), number)
            axes.plot(times, heights, "|", color=stream.color, markersize=7)
            continue
        seconds = stream.line(stream.seconds)
        flag = np.insert(stream.messages[field], stream.restarts, False)
        if field == "dead_reckoning":
            color = _WARNING_COLOR
        else:
            color = stream.color
        before = np.append(False, flag[:-1])
        is_shown = flag | before  # fill to the first message without the flag
        is_shown &= np.isfinite(seconds)
        axes.fill_between(seconds, number - 0.35, number + 0.35, where=is_shown, color=color)
    size = "small"
    if len(rows) > _MANY_ROWS:
        size = "x-small"
    labels = [row.label for row in rows]
    axes.set_yticks(range(len(rows)), labels, fontsize=size)
    limits = (len(rows) - 0.4, -0.6)
    axes.set(title="flags and resets", ylim=limits)
    axes.grid(axis="x", alpha=0.3)


def _marks(
    streams: Sequence[_Stream], start: float, events: Iterable[Event]
) -> dict[str, list[_Mark]]:
    """Return the marks of the plotted vehicles by row, the most severe row first, each row in chronological order.

    `start`: of the time axis [s since boot].
    """
    timed = [event for event in events if event.boot is not None]
    by_vehicle = defaultdict[str, list[_Stream]](list)
    for stream in streams:
        by_vehicle[stream.address.vehicle].append(stream)
    rows: dict[str, list[_Mark]] = {}
    for vehicle in sorted(by_vehicle):
        suffix = ""
        if len(by_vehicle) > 1:
            suffix = f" {vehicle}"
        seconds = np.concatenate([stream.seconds for stream in by_vehicle[vehicle]])
        period = float(seconds.min()), float(seconds.max())
        own = [event for event in timed if event.vehicle == vehicle]
        spans = spans_of(own)
        for name, marks in _marks_of(spans, start, period).items():
            rows[name + suffix] = sorted(marks, key=lambda mark: mark.begin)
    return dict(sorted(rows.items(), key=lambda row: _rank(row[1])))


def _rank(marks: Sequence[_Mark]) -> tuple[int, float]:
    """Return the severity of the most severe event of a row, and its time."""
    return min((SEVERITIES.index(mark.event.severity), mark.begin) for mark in marks)


def _marks_of(
    spans: Iterable[Span], start: float, period: tuple[float, float]
) -> dict[str, list[_Mark]]:
    """Return the marks of a vehicle by row; `period`: of its messages [s].

    Events far from all messages are left out, because their timestamps must be damaged.
    """
    first, last = period
    margin = last - first + _NEAR
    rows = defaultdict[str, dict[Event, _Mark]](dict)
    for span in spans:
        event = span.begin
        is_minor = event.severity == "info" and not KINDS[event.kind].phase
        if span.initial or event.boot is None or is_minor:
            continue
        offset = event.boot - start - event.time
        begin = span.since + offset
        if not first - margin <= begin <= last + margin:
            continue
        if span.until is None:
            end = last
        else:
            end = min(span.until + offset, last)
        end = max(begin, end)
        row = KINDS[event.kind].row or event.kind.replace("_", " ")
        # Conditions that begin with the same event share a mark, which ends when the last condition ends.
        shared = rows[row].get(event)
        if shared is not None:
            end = max(end, shared.end)
        rows[row][event] = _Mark(event, _text_of(event, row), begin, end)
    return {row: list(marks.values()) for row, marks in rows.items()}


def _text_of(event: Event, row: str) -> str:
    """Return the label of an event; none if it would repeat the name of its row."""
    if event.kind == "mode":
        return event.names[-1]
    if event.text == row:
        return ""
    return event.text


def _mark_events(
    axes: Mapping[str, Any], streams: Sequence[_Stream], marks: Iterable[_Mark]
) -> None:
    """Mark the start of bad and watch events on the track and on the time axes of altitude and speed."""
    by_preference = sorted(streams, key=lambda stream: stream.address.topic == DEFAULT_TOPIC)
    main = {stream.address.vehicle: stream for stream in by_preference}
    for severity, label in _LEGEND.items():
        shown = [mark for mark in marks if mark.event.severity == severity]
        if not shown:
            continue
        norths = []
        easts = []
        for mark in shown:
            position = main[mark.event.vehicle].position_at(mark.begin)
            if position is not None:
                norths.append(position["x"])
                easts.append(position["y"])
        if norths:
            on_track = _symbols(severity, easts, norths)
            on_track.set(label=label, markeredgewidth=1.5, zorder=3)
            on_track.set_markersize(on_track.get_markersize() + 1)
            axes["track"].add_artist(on_track)
        times = [mark.begin for mark in shown]
        heights = [0.03 for _ in shown]  # as a fraction of the axes
        for name in ("altitude", "speed"):
            on_axis = _symbols(severity, times, heights)
            on_axis.set_transform(axes[name].get_xaxis_transform())
            on_axis.set_markersize(on_axis.get_markersize() - 1)
            axes[name].add_artist(on_axis)


def _symbols(severity: Severity, x: Sequence[float], y: Sequence[float]) -> Line2D:
    """Return the symbols of events of a severity, without a line between them."""
    marker, color, size = _MARKERS[severity]
    return Line2D(
        x, y, marker=marker, color=color, markersize=size, fillstyle="none", linestyle="none"
    )


def _draw_events(figure: Figure, axes: Any, rows: Mapping[str, Sequence[_Mark]]) -> None:
    """Plot the marks row by row, with labels where they fit before the next mark."""
    for number, marks in enumerate(rows.values()):
        for mark in marks:
            marker, color, size = _MARKERS[mark.event.severity]
            bar = (mark.begin, mark.end - mark.begin)
            axes.broken_barh([bar], (number - 0.35, 0.7), color=color, alpha=0.3, linewidth=0)
            axes.plot(mark.begin, number, marker, color=color, markersize=size)
    axes.set_yticks(range(len(rows)), rows.keys(), fontsize="small", parse_math=False)
    limits = (len(rows) - 0.4, -0.6)
    axes.set(title="events; x: bad, diamond: watch, bar: duration", ylim=limits)
    axes.grid(axis="x", alpha=0.3)
    figure.draw_without_rendering()  # computes the layout, on which the space for labels depends
    gap = _GAP * _DPI / 72  # pixels
    for number, marks in enumerate(rows.values()):
        limit = float(axes.get_window_extent().x1)
        for mark in reversed(marks):
            _draw_label(axes, mark, number, limit)
            x, _ = axes.transData.transform((mark.begin, number))
            limit = float(x) - gap


def _draw_label(axes: Any, mark: _Mark, row: int, limit: float) -> None:
    """Label a mark, if the text ends before `limit` [pixels]."""
    text = axes.annotate(
        mark.text, (mark.begin, row), (_GAP, 0), textcoords="offset points", va="center_baseline",
        fontsize="x-small", parse_math=False,
    )  # fmt: skip
    text.set_in_layout(False)
    box = text.get_window_extent()
    # text width differs slightly between file formats
    if box.x0 + 1.05 * box.width > limit:
        text.remove()
