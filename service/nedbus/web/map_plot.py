"""The map: where every vehicle is, in metres, north up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from bokeh.models import ColumnDataSource, HoverTool, TapTool
from bokeh.plotting import figure

from nedbus_msgs import Address, MapProjection

from .fleet import TRUTH, Line, Picture
from .send import replace
from .style import COLOURS, Style
from .tracks import Tracks

if TYPE_CHECKING:
    from .background import Background

_MINUTE: Final = 60.0  # s for which a reset is shown
_MARKS: Final = ("east", "north", "angle", "shape", "colour", "fill", "label", "words")


class MapPlot:
    """The map of one viewer; `marks` has a row for each of `shown`, and its selection is what was tapped."""

    def __init__(self, style: Style, chosen: ColumnDataSource, background: Background | None) -> None:
        self.marks = ColumnDataSource({name: [] for name in _MARKS})
        self.shown: list[Address] = []
        self._style = style
        self._tracks = Tracks()
        self._resets = ColumnDataSource({"east": [], "north": []})
        self._ring = ColumnDataSource({"east": [], "north": []})
        self._background = background
        self.figure = self._draw(chosen)

    def update(
        self, picture: Picture, mains: Sequence[Line], chosen: Address | None, projection: MapProjection | None
    ) -> None:
        """Move the vehicles, and send what is new of their tracks."""
        truths = [line for line in picture.lines if line.address.topic == TRUTH]
        self._tracks.update({line.address: line.stream for line in [*mains, *truths]})
        placed = [line for line in mains if line.stream.valid is not None]
        rows = [_mark(line, self._style) for line in placed]
        self.shown = [line.address for line in placed]
        replace(self.marks, {name: [mark[name] for mark in rows] for name in _MARKS})
        ring = [
            mark for mark, line in zip(rows, placed, strict=True) if chosen and line.address.vehicle == chosen.vehicle
        ]
        replace(self._ring, {name: [mark[name] for mark in ring] for name in ("east", "north")})
        resets = [each for line in mains for each in tuple(line.stream.resets) if each[0] > picture.time - _MINUTE]
        replace(self._resets, {"east": [each[1] for each in resets], "north": [each[2] for each in resets]})
        if self._background is not None and projection is not None:
            self._background.draw(self.figure, self._style, projection)
            self._background = None

    def clear(self) -> None:
        """Forget what was sent: the time has jumped."""
        self._tracks.clear()

    def _draw(self, chosen: ColumnDataSource) -> figure:
        style, tracks = self._style, self._tracks.source
        plot = figure(
            match_aspect=True, sizing_mode="stretch_both", x_axis_label="east [m]", y_axis_label="north [m]",
            tools="pan,wheel_zoom,box_zoom,reset", active_scroll="wheel_zoom", min_border=4,
        )  # fmt: skip
        plot.toolbar.logo = None
        plot.line("east", "truth", source=tracks, color=style.lines[2], line_dash="dotted", line_width=2)
        plot.line("east", "valid", source=tracks, color=style.track, line_width=1.5)
        plot.line("east", "doubtful", source=tracks, color=COLOURS["dead reckoning"], line_dash="dashed", line_width=2)
        plot.line("east", "north", source=chosen, color=style.lines[0], line_width=2)
        plot.scatter("east", "north", source=self._resets, marker="x", color="#e5534b", size=8, line_width=2)
        plot.scatter("east", "north", source=self._ring, size=30, fill_alpha=0, color=style.lines[0], line_width=2)
        plot.ray(
            "east",
            "north",
            source=self.marks,
            length=17,
            length_units="screen",
            angle="angle",
            color="colour",
            line_width=2,
        )
        marks = plot.scatter(
            "east", "north", source=self.marks, marker="shape", size=12, line_color="colour", fill_color="fill",
            line_width=2, nonselection_alpha=1.0,
        )  # fmt: skip
        plot.text(
            "east",
            "north",
            text="label",
            source=self.marks,
            x_offset=11,
            y_offset=-5,
            text_font_size="11px",
            text_color=style.text,
        )
        plot.add_tools(
            HoverTool(renderers=[marks], tooltips="@label: @words @north{0.0} m north, @east{0.0} m east"),
            TapTool(renderers=[marks]),
        )
        return plot


def _mark(line: Line, style: Style) -> dict[str, Any]:
    """Return the marker of a vehicle: a filled circle where it is now, or an open square where it was last."""
    place, last = line.stream.valid, line.stream.last
    heading = last.message.heading if last is not None else math.nan
    is_here = last is not None and last.message.xy_valid and line.condition not in {"disconnected", "gone", "stale"}
    colour = style.lines[0] if line.condition == "ok" else COLOURS[line.condition]
    return {
        "east": round(place.east, 3) if place else math.nan,
        "north": round(place.north, 3) if place else math.nan,
        "angle": round(math.pi / 2 - heading, 3),
        "shape": "circle" if is_here else "square",
        "colour": colour,
        "fill": colour if is_here else style.ground,
        "label": line.address.vehicle if line.condition == "ok" else f"{line.address.vehicle} {line.condition}",
        "words": line.words,
    }
