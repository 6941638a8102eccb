"""Map of all vehicles: metres east and north of the common origin, north up."""

import math
import re
from collections.abc import Sequence
from typing import Any, Final

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
_MAX_EVENTS: Final = 60  # latest events marked on the map
_Placed = Sequence[tuple[VehicleView, Position]]
_SIZE: Final = re.compile(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})")


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
        self._style, self._background = style, background
        self._tracks = Tracks()
        self._ring = table("east", "north", "radius")
        self._frame = table("east", "north")
        self.figure = self._draw()

    def update(self, snapshot: FleetSnapshot, overview: Fleet, chosen: VehicleView | None) -> None:
        """Move the markers and extend the tracks; `chosen`: the selected vehicle, `overview`: long histories."""
        tracks: dict[Address, Track] = {}
        for each in sorted(snapshot.vehicles, key=lambda each: each.number):
            for stream in each.streams:
                if stream is each.main or (self.truth and stream.address.topic == TRUTH):
                    stored = overview.streams.get(stream.address) if self.is_long else None
                    tracks[stream.address] = (
                        stored.long if stored is not None else stream.stream.minute,
                        each.number,
                    )
        self._tracks.update(tracks)
        placed = [
            (each, position)
            for each in snapshot.vehicles
            if (position := each.main.stream.valid) is not None
        ]
        focused = [(each, position) for each, position in placed if each is chosen]
        frame = self._extent(focused or placed if self.focus == "vehicle" else placed, tracks)
        if self.focus == "follow" and focused:
            half = _FOLLOWED_SIDE / 2
            frame = [[middle - half, middle + half] for middle in focused[0][1][:2]]
        replace(self._frame, [{"east": frame[0][side], "north": frame[1][side]} for side in (0, 1)])
        labels = self._labels(placed, chosen, frame)
        replace(
            self.marks,
            [self._marker(each, position, labels.get(each.vehicle)) for each, position in placed],
        )
        self.shown = [each.vehicle for each, _ in placed]
        ephs = [each.main.newest.message.eph for each, _ in focused]
        radius = round(ephs[0], 1) if ephs and 0 < ephs[0] < math.inf else 0.0
        replace(
            self._ring,
            [{"east": at.east, "north": at.north, "radius": radius} for _, at in focused],
        )
        if self._background is not None and overview.origin.projection is not None:
            self._background.draw(self.figure, self._style, overview.origin.projection)
            self._background = None

    def mark_events(
        self, events: Sequence[Event], chosen: VehicleView | None, overview: Fleet
    ) -> None:
        """Mark where the selected vehicle was at each of its events."""
        placed: list[tuple[Event, Position]] = []
        if chosen is not None:
            stream = overview.streams.get(chosen.main.address, chosen.main.stream)
            events = events[-_MAX_EVENTS:]
            positions = stream.positions_at([event.time for event in events])
            placed = [
                (event, at) for event, at in zip(events, positions, strict=True) if at is not None
            ]
        self.shown_events = [event for event, _ in placed]
        marks = [
            {"east": at.east, "north": at.north, "marker": MARKERS[event.severity], "words": event.words[:80],
             "colour": self._style.colours[event.severity]}
            for event, at in placed
        ]  # fmt: skip
        replace(self.events, marks)

    def resize(self, size: str) -> None:
        """Set the map size that the browser reported, such as "600x500" [pixels]; ignore malformed text."""
        if found := _SIZE.fullmatch(size):
            self.size = float(found[1]), float(found[2])

    def _extent(self, shown: _Placed, tracks: dict[Address, Track]) -> list[list[float]]:
        """Return the extent of the map: [west, east], [south, north] [m]."""
        points = [np.array([position[:2] for _, position in shown] or [(0.0, 0.0)])]
        points += [tracks[each.main.address][0].points()[:, 1:3] for each, _ in shown]
        found = np.concatenate(points)
        sides = []
        for low, high in zip(
            np.nanmin(found, axis=0).tolist(), np.nanmax(found, axis=0).tolist(), strict=True
        ):
            grow = max(MIN_SIDE - (high - low), 2 * _MARGIN * (high - low)) / 2
            step = max(1.0, (high - low) / 20)  # move the map in steps, not continuously
            sides.append(
                [math.floor((low - grow) / step) * step, math.ceil((high + grow) / step) * step]
            )
        return sides

    def _labels(
        self, shown: _Placed, chosen: VehicleView | None, frame: list[list[float]]
    ) -> dict[str, bool]:
        """Return the vehicles whose labels fit, most severe first; True if the label is left of its marker."""
        (west, east), (south, north) = frame
        width, height = self.size
        scale, right = max((east - west) / width, (north - south) / height), east  # m per pixel
        start, end = (getattr(self.figure.x_range, side) for side in ("start", "end"))
        if (
            isinstance(start, float | int)
            and isinstance(end, float | int)
            and end - start > _MIN_ZOOM
        ):
            scale, right = (end - start) / width, end
        places = [(each, at.east / scale, at.north / scale) for each, at in shown]
        # Labels of these vehicles may cover the markers of all others.
        severe = {each.vehicle for each, _ in shown if each.grade == "bad" or each is chosen}
        taken = [
            (each.vehicle, x - _MARK, x + _MARK, y - _MARK, y + _MARK) for each, x, y in places
        ]
        labels: dict[str, bool] = {}
        for each, x, y in sorted(places, key=lambda known: known[0] is not chosen):
            name = each.vehicle
            low = y + _MARK
            size = len(each.vehicle) * _LETTER + 2 * _MARK
            is_left = x + size > right / scale  # otherwise it would extend beyond the map
            begin, end = (x - size, x) if is_left else (x, x + size)
            if each is chosen or all(
                end < left or far < begin or low + _HEIGHT <= bottom or top <= low
                for owner, left, far, bottom, top in taken
                if owner != name and (owner in ("", *severe) or name not in severe)
            ):
                taken.append(("", begin, end, low, low + _HEIGHT))
                labels[name] = is_left
        return labels

    def _marker(self, view: VehicleView, at: Position, is_left: bool | None) -> dict[str, Any]:
        """Return a marker shaped by grade: filled at the current position, open at the last valid position."""
        heading = getattr(view.main.newest.message, "heading", math.nan)
        colours, colour = self._style.colours, self._style.vehicle_colour(view.number)
        return {
            "east": round(at.east, 3), "north": round(at.north, 3), "angle": round(math.pi / 2 - heading, 3),
            "shape": MARKERS[view.grade], "colour": colour, "fill": colour if view.has_position else colours["ground"],
            "edge": colour if view.grade == "ok" else colours[view.grade],
            "label": "" if is_left is None else view.vehicle, "name": view.vehicle, "words": view.state.text,
            "align": "right" if is_left else "left", "offset": -11 if is_left else 11,
        }  # fmt: skip

    def _draw(self) -> figure:
        colours, tracks = self._style.colours, self._tracks.source
        plot = figure(
            match_aspect=True, sizing_mode="stretch_both", x_axis_label="east [m]", y_axis_label="north [m]",
            tools="pan,wheel_zoom,reset", active_scroll="wheel_zoom", height=100, css_classes=["map"],
        )  # fmt: skip
        plot.toolbar.update(logo=None, autohide=True)
        frame = plot.scatter("east", "north", source=self._frame, size=0, alpha=0)
        for axis in (plot.x_range, plot.y_range):
            axis.update(renderers=[frame], range_padding=0)
        *valid, doubtful, truth = LINE_TYPES
        plot.line(
            "east", truth, source=tracks, color=colours["truth"], line_dash="dotted", line_width=2
        )
        for number, name in enumerate(valid):
            plot.line(
                "east",
                name,
                source=tracks,
                color=self._style.vehicle_colour(number),
                line_width=1.5,
            )
        plot.line(
            "east",
            doubtful,
            source=tracks,
            color=colours["watch"],
            line_dash="dashed",
            line_width=2,
        )
        plot.circle(
            "east", "north", radius="radius", source=self._ring, fill_alpha=0.12, color=colours["text"],
            line_dash="dashed",
        )  # fmt: skip
        plot.scatter(
            "east",
            "north",
            source=self._ring,
            size=30,
            fill_alpha=0,
            color=colours["text"],
            line_width=1.5,
        )
        marked = plot.scatter(
            "east",
            "north",
            source=self.events,
            marker="marker",
            size=9,
            color="colour",
            nonselection_alpha=1.0,
        )
        plot.ray(
            "east", "north", source=self.marks, length=17, length_units="screen", angle="angle", color="edge",
            line_width=2,
        )  # fmt: skip
        marks = plot.scatter(
            "east", "north", source=self.marks, marker="shape", size=12, line_color="edge", fill_color="fill",
            line_width=2, nonselection_alpha=1.0,
        )  # fmt: skip
        plot.text(
            "east", "north", text="label", source=self.marks, x_offset="offset", y_offset=-5, text_align="align",
            text_font_size="11px", text_color=colours["text"],
        )  # fmt: skip
        plot.add_layout(ScaleBar(range=plot.x_range, unit="m", location="bottom_left"))
        plot.add_tools(
            HoverTool(
                renderers=[marks], tooltips="@name: @words, @north{0.0} m north, @east{0.0} m east"
            ),
            HoverTool(renderers=[marked], tooltips="@words"),
            TapTool(renderers=[marks, marked]),
        )
        return plot
