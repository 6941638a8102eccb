"""The map: where every vehicle is, in metres, north up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

from bokeh.models import ColumnDataSource, DataRange1d, HoverTool, TapTool
from bokeh.models.annotations import ScaleBar
from bokeh.plotting import figure

from nedbus.events import Event
from nedbus_msgs import Address, MapProjection

from .fleet import TRUTH, Fleet, Picture, Row, places_at
from .send import replace
from .style import MARKERS, Style
from .tracks import NAMES, Track, Tracks

if TYPE_CHECKING:
    from .background import Background

Focus = Literal["all", "follow", "vehicle"]
LEAST: Final = 20.0
"""Metres that a map shows at least: less is the noise of a vehicle at rest."""

_NEAREST: Final = 0.01  # m that a browser shows where somebody has zoomed in
_MARGIN: Final = 0.08  # of what is shown, around it
_FOLLOWED: Final = 60.0  # m around a vehicle that is followed
_LETTER, _HEIGHT = 6.5, 15.0  # pixels of a label
_MARKS: Final = (
    "east", "north", "angle", "shape", "colour", "edge", "fill", "label", "name", "words", "align", "offset",
)  # fmt: skip
_EVENTS: Final = ("east", "north", "marker", "colour", "words")
_MAX_EVENTS: Final = 60


@dataclass(frozen=True, slots=True)
class View:
    """What of the map is shown: the focus, how long trails are, and whether ground truth is drawn."""

    focus: Focus = "all"
    trail: Literal["minute", "long"] = "minute"
    truth: bool = True


class MapPlot:
    """The map of one viewer; `marks` has a row for each of `shown`, `events` for each of `told`; both can be tapped."""

    def __init__(self, style: Style, background: Background | None) -> None:
        self.marks = ColumnDataSource({name: [] for name in _MARKS})
        self.events = ColumnDataSource({name: [] for name in _EVENTS})
        self.shown: list[str] = []
        self.told: list[Event] = []
        self.size = 600.0, 500.0  # pixels, until the browser has said how many
        self._style = style
        self._tracks = Tracks()
        self._ring = ColumnDataSource({"east": [], "north": [], "radius": []})
        self._frame = ColumnDataSource({"east": [], "north": []})
        self._background = background
        self.figure = self._draw()

    def update(
        self, picture: Picture, whole: Fleet, row: Row | None, view: View, projection: MapProjection | None
    ) -> None:
        """Move the vehicles, and send what is new of their tracks."""
        tracks: dict[Address, Track] = {}
        for each in sorted(picture.rows, key=lambda each: each.number):
            for line in each.lines:
                if line is each.main or (view.truth and line.address.topic == TRUTH):
                    held = whole.streams.get(line.address) if view.trail == "long" else None
                    tracks[line.address] = held.long if held is not None else line.stream.minute, each.number
        self._tracks.update(tracks)
        placed = [each for each in picture.rows if each.main.stream.valid is not None]
        self.shown = [each.vehicle for each in placed]
        frame = self._frame_of(placed, row, view, tracks)
        replace(self._frame, list(zip(frame["east"], frame["north"], strict=True)))
        labels = self._labels(placed, row, frame)
        rows = [self._mark(each, *label) for each, label in zip(placed, labels, strict=True)]
        replace(self.marks, [tuple(mark.values()) for mark in rows])
        chosen = [mark for mark in rows if row is not None and mark["name"] == row.vehicle]
        eph = row.main.stream.last.message.eph if chosen and row is not None and row.main.stream.last else 0.0
        radius = round(eph, 1) if math.isfinite(eph) and eph > 0 else 0.0
        replace(self._ring, [(mark["east"], mark["north"], radius) for mark in chosen])
        if self._background is not None and projection is not None:
            self._background.draw(self.figure, self._style, projection)
            self._background = None

    def mark(self, told: Sequence[Event], row: Row | None, whole: Fleet) -> None:
        """Show where events of the chosen vehicle happened."""
        stream = None if row is None else whole.streams.get(row.main.address, row.main.stream)
        told = told[-_MAX_EVENTS:]
        places = places_at(stream, [event.time for event in told])
        placed = [(event, place) for event, place in zip(told, places, strict=True) if place is not None]
        self.told = [event for event, _ in placed]
        marks = [
            (at.east, at.north, MARKERS[each.severity], self._style.grades[each.severity], each.text[:80])
            for each, at in placed
        ]
        replace(self.events, marks)

    def clear(self) -> None:
        """Forget what was sent: the time has jumped."""
        self._tracks.clear()

    def _frame_of(
        self, placed: Sequence[Row], row: Row | None, view: View, tracks: dict[Address, Track]
    ) -> dict[str, list[float]]:
        """Return two corners that the map shows."""
        chosen = [each for each in placed if row is not None and each.vehicle == row.vehicle]
        if view.focus == "follow" and chosen and (place := chosen[0].main.stream.valid) is not None:
            half = _FOLLOWED / 2
            return {"east": [place.east - half, place.east + half], "north": [place.north - half, place.north + half]}
        shown = chosen if view.focus == "vehicle" and chosen else placed
        sides = []
        for axis in (0, 1):
            values = [each.main.stream.valid[axis] for each in shown if each.main.stream.valid is not None]
            for each in shown:
                history = tracks[each.main.address][0]
                points = history.points(0, history.written)[:, 1 + axis]
                points = points[points == points]  # noqa: PLR0124 - NaN is not equal to itself
                values += [float(points.min()), float(points.max())] if len(points) else []
            low, high = min(values, default=0.0), max(values, default=0.0)
            grow = max(LEAST - (high - low), 2 * _MARGIN * (high - low)) / 2
            step = max(1.0, (high - low) / 20)  # the map does not creep
            sides.append([math.floor((low - grow) / step) * step, math.ceil((high + grow) / step) * step])
        return {"east": sides[0], "north": sides[1]}

    def _labels(self, placed: Sequence[Row], row: Row | None, frame: dict[str, list[float]]) -> list[tuple[str, bool]]:
        """Return the labels that do not lie on each other, the worst first, and which are on the left of their mark."""
        width, height = self.size
        scale = max((frame["east"][1] - frame["east"][0]) / width, (frame["north"][1] - frame["north"][0]) / height)
        right = frame["east"][1] / scale
        start, end = (getattr(self.figure.x_range, side) for side in ("start", "end"))
        if isinstance(start, float | int) and isinstance(end, float | int) and end - start > _NEAREST:
            scale, right = (end - start) / width, end / ((end - start) / width)
        marked = [each for each in placed if each.grade == "bad" or each is row]
        spots = [each.main.stream.valid for each in marked]
        taken = [
            (each.vehicle, at.east / scale - _HEIGHT / 2, at.north / scale, _HEIGHT)
            for each, at in zip(marked, spots, strict=True)
            if at is not None
        ]
        labels = dict.fromkeys((each.vehicle for each in placed), ("", False))
        for each in sorted(placed, key=lambda each: each is not row):
            place = each.main.stream.valid
            if place is None:
                continue
            text = each.vehicle if each.grade == "ok" else f"{each.vehicle} {each.brief}"
            x, y, size = place.east / scale, place.north / scale, len(text) * _LETTER + 14
            is_left = x + size > right  # it would leave the map
            x -= size * is_left
            if each is row or all(
                abs(y - top) > _HEIGHT or x + size < left or left + wide < x or owner == each.vehicle
                for owner, left, top, wide in taken
            ):
                taken.append(("", x, y, size))
                labels[each.vehicle] = text, is_left
        return list(labels.values())

    def _mark(self, row: Row, label: str, is_left: bool) -> dict[str, Any]:
        """Return the marker of a vehicle: filled where it is now, or open where it was last; its shape is its grade."""
        place, last = row.main.stream.valid, row.main.stream.last
        heading = getattr(last.message, "heading", math.nan) if last is not None else math.nan
        colour = self._style.vehicle(row.number)
        edge = colour if row.grade == "ok" else self._style.grades[row.grade]
        return {
            "east": round(place.east, 3) if place else math.nan,
            "north": round(place.north, 3) if place else math.nan,
            "angle": round(math.pi / 2 - heading, 3),
            "shape": {"bad": "square", "watch": "triangle", "ok": "circle"}[row.grade],
            "colour": colour,
            "edge": edge,
            "fill": colour if row.is_here else self._style.ground,
            "label": label,
            "name": row.vehicle,
            "words": row.text,
            "align": "right" if is_left else "left",
            "offset": -11 if is_left else 11,
        }

    def _draw(self) -> figure:
        style, tracks = self._style, self._tracks.source
        plot = figure(
            match_aspect=True, sizing_mode="stretch_both", x_axis_label="east [m]", y_axis_label="north [m]",
            tools="pan,wheel_zoom,reset", active_scroll="wheel_zoom", min_border=4, height=100,
            css_classes=["map"], x_range=DataRange1d(range_padding=0), y_range=DataRange1d(range_padding=0),
        )  # fmt: skip
        plot.toolbar.logo = None
        plot.toolbar.autohide = True
        frame = plot.scatter("east", "north", source=self._frame, size=0, alpha=0)
        for axis in (plot.x_range, plot.y_range):
            axis.update(renderers=[frame])
        plot.line("east", NAMES[-1], source=tracks, color=style.truth, line_dash="dotted", line_width=2)
        for number, name in enumerate(NAMES[:-2]):
            plot.line("east", name, source=tracks, color=style.vehicle(number), line_width=1.5)
        plot.line("east", NAMES[-2], source=tracks, color=style.grades["watch"], line_dash="dashed", line_width=2)
        plot.circle(
            "east", "north", radius="radius", source=self._ring, fill_alpha=0.12, color=style.text, line_dash="dashed"
        )
        plot.scatter("east", "north", source=self._ring, size=30, fill_alpha=0, color=style.text, line_width=1.5)
        marked = plot.scatter(
            "east", "north", source=self.events, marker="marker", size=9, color="colour", nonselection_alpha=1.0
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
            text_font_size="11px",
            text_color=style.text,
        )  # fmt: skip
        plot.add_layout(
            ScaleBar(
                range=plot.x_range,
                unit="m",
                location="bottom_left",
                background_fill_alpha=0.0,
                border_line_alpha=0,
                label_text_color=style.text,
                bar_line_color=style.text,
                label_text_font_size="11px",
            )
        )
        plot.add_tools(
            HoverTool(renderers=[marks], tooltips="@name: @words, @north{0.0} m north, @east{0.0} m east"),
            HoverTool(renderers=[marked], tooltips="@words"),
            TapTool(renderers=[marks, marked]),
        )
        return plot
