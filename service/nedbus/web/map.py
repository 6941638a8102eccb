"""Map of all vehicles: metres east and north of the common origin, north up."""

import math
import re
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from bokeh.models import HoverTool, TapTool
from bokeh.models.annotations import ScaleBar
from bokeh.plotting import figure

from nedbus.health import Event
from nedbus_msgs import Address

from .background import Background
from .column_data import LINE_TYPES, Track, Tracks, replace, table
from .fleet import TRUTH, Fleet, FleetSnapshot, VehicleView
from .stream import Position
from .style import MARKERS, Style

FOCUSES: Final = ("all", "follow", "vehicle")
# minimum side of the map [m]; a smaller one would magnify the noise of a vehicle at rest
MIN_SIDE: Final = 20.0
_MIN_ZOOM: Final = 0.01  # m; smallest visible range accepted from the browser
_MARGIN: Final = 0.08  # margin on each side, as a fraction of the extent
_FOLLOWED_SIDE: Final = 60.0  # m; side of the map while following a vehicle
# pixels; width of a character, height of a label, radius of a marker
_LETTER = 6.5
_HEIGHT = 12.0
_MARK = 5.0
_LATEST_EVENTS: Final = 60  # marked on the map; more would hide the tracks
_SIZE: Final = re.compile(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})")


class _Placed(NamedTuple):
    """A vehicle with its last valid position."""

    view: VehicleView
    position: Position


class _Extent(NamedTuple):
    """The borders of the shown part of the map [m]."""

    west: float
    east: float
    south: float
    north: float


class _Box(NamedTuple):
    """Where a marker or label is [pixels]; `vehicle`: the owner of a marker, "" for a label."""

    vehicle: str
    left: float
    right: float
    bottom: float
    top: float

    def overlaps(self, other: "_Box") -> bool:
        """Return whether two boxes share more than a border."""
        if self.right < other.left or other.right < self.left:
            return False
        return self.top > other.bottom and other.top > self.bottom


class Map:
    """The map of one viewer.

    `marks`: a row per vehicle in `shown`; `events`: a row per event in `shown_events`; both can be tapped.
    `focus`: one of FOCUSES; `is_long`: draw trails longer than a minute; `truth`: also draw the ground truth.
    """

    def __init__(self, style: Style, background: Background | None) -> None:
        self.marks = table(
            "east",
            "north",
            "angle",
            "shape",
            "colour",
            "edge",
            "fill",
            "label",
            "name",
            "words",
            "align",
            "offset",
        )
        self.events = table("east", "north", "marker", "colour", "words")
        self.shown: list[str] = []
        self.shown_events: list[Event] = []
        self.size = 600.0, 500.0  # pixels, until the browser reports its own
        self.focus = "all"
        self.is_long = False
        self.truth = True
        self._style = style
        self._background = background
        self._tracks = Tracks()
        self._ring = table("east", "north", "radius")
        self._frame = table("east", "north")
        self.figure = self._draw()

    def update(self, snapshot: FleetSnapshot, overview: Fleet, chosen: VehicleView | None) -> None:
        """Move the markers and extend the tracks; `chosen`: the selected vehicle, `overview`: long histories."""
        tracks = self._choose_tracks(snapshot, overview)
        self._tracks.update(tracks)
        placed = []
        for view in snapshot.vehicles:
            position = view.main.stream.valid
            if position is not None:
                placed.append(_Placed(view, position))
        focused = [vehicle for vehicle in placed if vehicle.view is chosen]
        extent = self._extent(placed, focused, tracks)
        corners = [
            {"east": extent.west, "north": extent.south},
            {"east": extent.east, "north": extent.north},
        ]
        replace(self._frame, corners)
        labels = self._labels(placed, chosen, extent)
        marks = []
        for view, position in placed:
            marks.append(self._marker(view, position, labels.get(view.vehicle)))
        replace(self.marks, marks)
        self.shown = [view.vehicle for view, _ in placed]
        rings = []
        for view, position in focused:
            radius = _radius(view)
            rings.append({"east": position.east, "north": position.north, "radius": radius})
        replace(self._ring, rings)
        if self._background is not None and overview.origin.projection is not None:
            self._background.draw(self.figure, self._style, overview.origin.projection)
            self._background = None

    def _choose_tracks(self, snapshot: FleetSnapshot, overview: Fleet) -> dict[Address, Track]:
        """Return the tracks to draw, in the order of the colours of their vehicles."""
        tracks: dict[Address, Track] = {}
        for view in sorted(snapshot.vehicles, key=lambda view: view.number):
            for stream in view.streams:
                is_truth = self.truth and stream.address.topic == TRUTH
                if stream is not view.main and not is_truth:
                    continue
                history = stream.stream.minute
                if self.is_long and stream.address in overview.streams:
                    history = overview.streams[stream.address].long
                tracks[stream.address] = Track(history, view.number)
        return tracks

    def mark_events(
        self, events: Sequence[Event], chosen: VehicleView | None, overview: Fleet
    ) -> None:
        """Mark where the selected vehicle was at each of its events."""
        self.shown_events = []
        marks = []
        if chosen is not None:
            stream = overview.streams.get(chosen.main.address, chosen.main.stream)
            latest = events[-_LATEST_EVENTS:]
            positions = stream.positions_at([event.time for event in latest])
            for event, position in zip(latest, positions, strict=True):
                if position is not None:
                    self.shown_events.append(event)
                    marks.append(self._event_mark(event, position))
        replace(self.events, marks)

    def _event_mark(self, event: Event, position: Position) -> dict[str, Any]:
        return {
            "east": position.east,
            "north": position.north,
            "marker": MARKERS[event.severity],
            "words": event.words[:80],
            "colour": self._style.colours[event.severity],
        }

    def resize(self, size: str) -> None:
        """Set the map size that the browser reported, such as "600x500" [pixels]; ignore malformed text."""
        match = _SIZE.fullmatch(size)
        if match:
            self.size = float(match[1]), float(match[2])

    def _extent(
        self, placed: list[_Placed], focused: list[_Placed], tracks: dict[Address, Track]
    ) -> _Extent:
        """Return the part of the map to show; `focused`: the selected vehicle, if it has a position."""
        if self.focus == "follow" and focused:
            position = focused[0].position
            half = _FOLLOWED_SIDE / 2
            return _Extent(
                west=position.east - half,
                east=position.east + half,
                south=position.north - half,
                north=position.north + half,
            )
        if focused and self.focus == "vehicle":
            shown = focused
        else:
            shown = placed
        points = [np.array([(position.east, position.north) for _, position in shown])]
        if not shown:
            points = [np.zeros((1, 2))]
        for view, _ in shown:
            points.append(tracks[view.main.address].history.points()[:, 1:3])
        all_points = np.concatenate(points)
        lows = np.nanmin(all_points, axis=0).tolist()
        highs = np.nanmax(all_points, axis=0).tolist()
        west, east = _widen(lows[0], highs[0])
        south, north = _widen(lows[1], highs[1])
        return _Extent(west, east, south, north)

    def _labels(
        self, placed: list[_Placed], chosen: VehicleView | None, extent: _Extent
    ) -> dict[str, bool]:
        """Return the vehicles whose labels fit, most severe first; True if the label is left of its marker."""
        scale, border = self._scale(extent)
        border /= scale
        marks: dict[str, _Box] = {}
        severe = set()
        for view, position in placed:
            x = position.east / scale
            y = position.north / scale
            marks[view.vehicle] = _Box(view.vehicle, x - _MARK, x + _MARK, y - _MARK, y + _MARK)
            if view.grade == "bad" or view is chosen:
                severe.add(view.vehicle)
        taken = [*marks.values()]
        labels: dict[str, bool] = {}
        for view, _ in sorted(placed, key=lambda vehicle: vehicle.view is not chosen):
            name = view.vehicle
            mark = marks[name]
            x = (mark.left + mark.right) / 2
            width = len(name) * _LETTER + 2 * _MARK
            is_left = x + width > border  # otherwise it would extend beyond the map
            if is_left:
                begin = x - width
            else:
                begin = x
            label = _Box("", begin, begin + width, mark.top, mark.top + _HEIGHT)
            # Labels of severe vehicles may cover the markers of all others.
            covered = [
                box
                for box in taken
                if box.vehicle != name and (name not in severe or box.vehicle in ("", *severe))
            ]
            if view is chosen or not any(map(label.overlaps, covered)):
                taken.append(label)
                labels[name] = is_left
        return labels

    def _scale(self, extent: _Extent) -> tuple[float, float]:
        """Return metres per pixel, and the east border [m], of the range that the user chose, else of the extent."""
        width, height = self.size
        start = getattr(self.figure.x_range, "start", None)
        end = getattr(self.figure.x_range, "end", None)
        if not isinstance(start, float | int) or not isinstance(end, float | int):
            start = end = 0.0  # the browser has not reported its range yet
        if end - start > _MIN_ZOOM:
            return (end - start) / width, end
        scale_x = (extent.east - extent.west) / width
        scale_y = (extent.north - extent.south) / height
        return max(scale_x, scale_y), extent.east

    def _marker(self, view: VehicleView, at: Position, is_left: bool | None) -> dict[str, Any]:
        """Return a marker shaped by grade: filled at the current position, open at the last valid position."""
        heading = getattr(view.main.newest.message, "heading", math.nan)
        colours = self._style.colours
        colour = self._style.vehicle_colour(view.number)
        fill = colours["ground"]
        if view.has_position:
            fill = colour
        edge = colour
        if view.grade != "ok":
            edge = colours[view.grade]
        label = view.vehicle
        if is_left is None:
            label = ""
        align = "left"
        offset = 11
        if is_left:
            align = "right"
            offset = -11
        return {
            "east": round(at.east, 3),
            "north": round(at.north, 3),
            "angle": round(math.pi / 2 - heading, 3),
            "shape": MARKERS[view.grade],
            "colour": colour,
            "fill": fill,
            "edge": edge,
            "label": label,
            "name": view.vehicle,
            "words": view.state.text,
            "align": align,
            "offset": offset,
        }

    def _draw(self) -> figure:
        plot = figure(
            match_aspect=True,
            sizing_mode="stretch_both",
            x_axis_label="east [m]",
            y_axis_label="north [m]",
            tools="pan,wheel_zoom,reset",
            active_scroll="wheel_zoom",
            height=100,
            css_classes=["map"],
        )
        plot.toolbar.update(logo=None, autohide=True)
        frame = plot.scatter("east", "north", source=self._frame, size=0, alpha=0)
        for axis in (plot.x_range, plot.y_range):
            axis.update(renderers=[frame], range_padding=0)
        self._draw_tracks(plot)
        self._draw_ring(plot)
        events = plot.scatter(
            "east",
            "north",
            source=self.events,
            marker="marker",
            size=9,
            color="colour",
            nonselection_alpha=1.0,
        )
        marks = self._draw_marks(plot)
        plot.add_layout(ScaleBar(range=plot.x_range, unit="m", location="bottom_left"))
        text = "@name: @words, @north{0.0} m north, @east{0.0} m east"
        plot.add_tools(
            HoverTool(renderers=[marks], tooltips=text),
            HoverTool(renderers=[events], tooltips="@words"),
            TapTool(renderers=[marks, events]),
        )
        return plot

    def _draw_tracks(self, plot: figure) -> None:
        colours = self._style.colours
        *valid, doubtful, truth = LINE_TYPES
        options: dict[str, Any] = {"source": self._tracks.source}
        plot.line(
            "east", truth, color=colours["truth"], line_dash="dotted", line_width=2, **options
        )
        for number, name in enumerate(valid):
            colour = self._style.vehicle_colour(number)
            plot.line("east", name, color=colour, line_width=1.5, **options)
        plot.line(
            "east", doubtful, color=colours["watch"], line_dash="dashed", line_width=2, **options
        )

    def _draw_ring(self, plot: figure) -> None:
        """Draw the accuracy of the selected vehicle's position, and a ring of fixed size, which is always visible."""
        options: dict[str, Any] = {"source": self._ring, "color": self._style.colours["text"]}
        plot.circle(
            "east", "north", radius="radius", fill_alpha=0.12, line_dash="dashed", **options
        )
        plot.scatter("east", "north", size=30, fill_alpha=0, line_width=1.5, **options)

    def _draw_marks(self, plot: figure) -> Any:
        """Draw the vehicles with heading and label; return their symbols."""
        plot.ray(
            "east",
            "north",
            source=self.marks,
            length=17,
            length_units="screen",
            angle="angle",
            color="edge",
            line_width=2,
        )
        marks = plot.scatter(
            "east",
            "north",
            source=self.marks,
            marker="shape",
            size=12,
            line_color="edge",
            fill_color="fill",
            line_width=2,
            nonselection_alpha=1.0,
        )
        plot.text(
            "east",
            "north",
            text="label",
            source=self.marks,
            x_offset="offset",
            y_offset=-5,
            text_align="align",
            text_font_size="11px",
            text_color=self._style.colours["text"],
        )
        return marks


def _radius(view: VehicleView) -> float:
    """Return the radius of the ring around a vehicle: the accuracy of its position [m], 0 if it is unknown."""
    eph: float = view.main.newest.message.eph
    if 0 < eph < math.inf:
        return round(eph, 1)
    return 0.0


def _widen(low: float, high: float) -> tuple[float, float]:
    """Widen a range by a margin, to at least MIN_SIDE, and to a grid, so that the map moves in steps."""
    side = high - low
    margin = max(MIN_SIDE - side, 2 * _MARGIN * side) / 2
    step = max(1.0, side / 20)
    return math.floor((low - margin) / step) * step, math.ceil((high + margin) / step) * step
