"""What one viewer sees, and how it follows the fleet: a Document of Bokeh, which needs no browser."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Final

from bokeh.document import Document
from bokeh.events import ConnectionLost, DocumentReady
from bokeh.layouts import column, row
from bokeh.models import CustomJS, GlobalInlineStyleSheet, LayoutDOM, Row
from bokeh.models.widgets import Div, TextInput, Toggle

from nedbus.client import to_age
from nedbus_msgs import Address

from .fleet import CONDITIONS, MAX_STREAMS, TRUTH, Fleet, Line, Picture, main_line
from .map_plot import MapPlot
from .plots import Plots
from .stream import is_position
from .style import DARK, LIGHT, badge, to_clock
from .table import RejectionTable, StreamTable

if TYPE_CHECKING:
    from .background import Background

TICK: Final = 100
"""Milliseconds between two moves of the map."""

_LOOK: Final = 5  # ticks between two updates of text, tables and plots
_AXIS: Final = 10  # ticks between two moves of the time axis
_AHEAD: Final = 2  # pictures that are sent before the browser has drawn the first of them
_SLOW: Final = 1.0  # s between two pictures from which on the page says so
_WORST: Final = 3  # vehicles that are told of in sentences
# What Bokeh does not do: tell whether the pointer is over a table, and begin anew when the server is back.
_POINTING: Final = """
window.addEventListener("mousemove", event => {
  const inside = event.composedPath().some(node => node.classList?.contains("nedbus-streams"))
  if (inside != flag.active) flag.active = inside
})
document.documentElement.addEventListener("mouseleave", () => { flag.active = false })
"""
_DRAWN: Final = "requestAnimationFrame(() => { drawn.value = cb_obj.value })"
_LOST: Final = """
if (window.nedbusLost) return
window.nedbusLost = document.createElement("div")
window.nedbusLost.textContent = "nedbus web does not answer since " + new Date().toLocaleTimeString() + ": waiting"
window.nedbusLost.style = "position:fixed;top:0;width:100%;padding:9px;background:#c62828;color:#fff;font:15px sans"
document.body.append(window.nedbusLost)
setInterval(() => fetch("/healthz").then(answer => answer.ok && location.reload()).catch(() => {}), 1000)
"""


class Viewer:
    """One page in one browser; `update` sends what is new of the fleet, ten times a second."""

    def __init__(
        self,
        document: Document,
        fleet: Fleet,
        *,
        title: str = "nedbus",
        background: Background | None = None,
        controls: Row | None = None,
    ) -> None:
        request = getattr(document.session_context, "request", None)  # none without a browser
        light = request is not None and request.arguments.get("theme") == [b"light"]
        style = LIGHT if light else DARK
        self.chosen: Address | None = None
        self._fleet, self._style = fleet, style
        self._ticks = 0
        self._head, self._worst, self._title, self._note = (
            Div(stylesheets=[style.text_css], sizing_mode="stretch_width") for _ in range(4)
        )
        self._streams, self._rejections, self._plots = (
            StreamTable(style),
            RejectionTable(style),
            Plots(style, offset=0.0 if controls else time.localtime().tm_gmtoff),
        )
        self._grid = column(sizing_mode="stretch_both", styles={"flex": "7 1 0"})
        self._map = MapPlot(style, self._plots.chosen, background)
        self._streams.source.selected.on_change("indices", lambda _, __, rows: self._choose(rows, self._streams.order))
        self._map.marks.selected.on_change("indices", lambda _, __, rows: self._choose(rows, self._map.shown))
        self._other = "?theme=dark" if light else "?theme=light"
        self._sent, self._updated, self._slow = 0, time.monotonic(), 0.0
        self._beat, self._drawn = TextInput(visible=False), TextInput(visible=False)  # "" until a browser has drawn
        self._beat.js_on_change("value", CustomJS(args={"drawn": self._drawn}, code=_DRAWN))
        pointing = Toggle(visible=False)
        pointing.on_change("active", lambda _, __, active: setattr(self._streams, "pointing", active))
        document.title = self._name = title
        document.theme = style.theme
        document.config.update(reconnect_session=False, notify_connection_status=False)
        document.js_on_event(ConnectionLost, CustomJS(code=_LOST))
        document.js_on_event(DocumentReady, CustomJS(args={"flag": pointing}, code=_POINTING))
        document.add_root(self._lay_out(controls, pointing, self._beat, self._drawn))

    def update(self) -> None:
        """Send what is new, as soon as the browser has drawn the last: the map each time, the rest twice a second."""
        now = time.monotonic()
        if self._sent - int(self._drawn.value or self._sent) >= _AHEAD:
            return
        self._slow = now - self._updated if now - self._updated > _SLOW else 0.0
        self._sent, self._updated = self._sent + 1, now
        if self._drawn.value and not self._grid.children:  # map and table are there sooner without
            figures = self._plots.draw()
            self._grid.children = [row(*figures[first : first + 2], sizing_mode="stretch_both") for first in (0, 2)]
        picture = self._fleet.picture
        vehicles: dict[str, list[Line]] = {}
        for line in picture.lines:
            vehicles.setdefault(line.address.vehicle, []).append(line)
        mains = [main_line(lines) for lines in vehicles.values()]
        worst = sorted(map(_worst_of, vehicles.values()), key=lambda line: line.rank)
        if self.chosen is None and worst:
            self.chosen = main_line(vehicles[worst[0].address.vehicle]).address
        plotted = self.chosen
        if plotted is not None and not is_position(plotted) and plotted.vehicle in vehicles:
            plotted = main_line(vehicles[plotted.vehicle]).address
        self._map.update(picture, mains, self.chosen, self._fleet.origin.projection)
        if self._ticks % _LOOK == 0:
            self._streams.update(picture, self.chosen)
            self._rejections.update(picture)
            self._tell(picture, mains, worst, vehicles, plotted)
            self._plots.update(self._fleet, plotted, Address(plotted.vehicle, TRUTH) if plotted else None)
        if self._ticks % _AXIS == 0:
            self._plots.move(picture.time)
        self._ticks += 1
        self._beat.value = str(self._sent)

    def restart(self) -> None:
        """Send everything again: the time has jumped."""
        self._map.clear()
        self._plots.clear()
        self._ticks = 0

    def _choose(self, rows: list[int], addresses: list[Address]) -> None:
        if rows and 0 <= rows[0] < len(addresses):
            self.chosen = addresses[rows[0]]
            self._ticks = 0  # at once

    def _tell(
        self, picture: Picture, mains: Sequence[Line], worst: Sequence[Line], vehicles: Mapping[str, Sequence[Line]],
        plotted: Address | None,
    ) -> None:  # fmt: skip
        """Write the header, and sentences about the vehicles that are worst."""
        counted = Counter(line.condition for line in worst)
        counts = "".join(badge(name, counted[name]) for name in CONDITIONS if counted[name])
        facts = [
            f"{len(vehicles)} vehicle{'' if len(vehicles) == 1 else 's'}",
            f"{picture.rate:.0f} messages/s",
            f"{picture.rejected} rejected",
        ]
        facts += [f"{sum(line.health.lost for line in picture.lines)} lost"]
        facts += [f"{picture.left_out} streams beyond {MAX_STREAMS} are left out"] if picture.left_out else []
        facts += [f"this browser takes {to_age(self._slow)} for a picture"] if self._slow else []
        link = f'<span class="bad">{escape(picture.link)}</span>' if picture.link else ""
        theme = f'<a href="{self._other}">{self._other.partition("=")[2]}</a>'
        self._head.text = (
            f"<b>{escape(self._name)}</b> &ensp; {counts} {link} &ensp; {' · '.join(facts)} &ensp; {theme}"
        )
        bad = [line for line in worst if line.rank < CONDITIONS.index("ok")]
        told = [
            f"<div>{badge(line.condition)} {_sentence(line, vehicles[line.address.vehicle])}</div>"
            for line in bad[:_WORST]
        ]
        more = f'<div class="quiet">and {len(bad) - _WORST} more, in the table</div>' if len(bad) > _WORST else ""
        nothing = "every vehicle is well" if vehicles else "waiting for the first message"
        self._worst.text = "".join(told) + more or f'<div class="quiet">{nothing}</div>'
        where = next((f"last at {line.where}" for line in picture.lines if line.address == plotted), "")
        self._title.text = f'<b>{escape(str(plotted or ""))}</b> <span class="quiet">{escape(where)}</span>'
        self._note.text = f'<span class="quiet">{escape(_frame(self._fleet, mains))}</span>'

    def _lay_out(self, controls: Row | None, *hidden: LayoutDOM) -> LayoutDOM:
        self._streams.table.css_classes = ["nedbus-streams"]
        self._streams.table.styles = {"flex": "5 1 0"}
        self._rejections.table.styles = {"flex": "1.6 1 0"}
        left = column(self._note, self._map.figure, sizing_mode="stretch_both", styles={"flex": "42 1 0"})
        right = column(
            self._streams.table, self._rejections.table, self._title, self._grid,
            sizing_mode="stretch_both", styles={"flex": "58 1 0"},
        )  # fmt: skip
        for control in controls.children if controls else ():
            control.stylesheets = [self._style.text_css]
        body = row(left, right, sizing_mode="stretch_both", spacing=8)
        return column(
            *([self._head, self._worst] + ([controls] if controls else []) + [body, *hidden]),
            sizing_mode="stretch_both", stylesheets=[GlobalInlineStyleSheet(css=self._style.page_css)],
            styles={"padding": "8px", "height": "100vh", "box-sizing": "border-box"},
        )  # fmt: skip


def _worst_of(lines: Sequence[Line]) -> Line:
    """Return the line that speaks for a vehicle: of its worst condition, and the main one if that is as bad."""
    worst = min(line.rank for line in lines)
    return main_line([line for line in lines if line.rank == worst])


def _sentence(line: Line, lines: Sequence[Line]) -> str:
    """Say which vehicle, why, since when, and where it was last."""
    alike = sum(each.condition == line.condition for each in lines)
    topics = "all its topics" if alike == len(lines) else line.address.stream
    where = f"since {to_clock(line.since)}; last at {main_line(lines).where}"
    return f"<b>{escape(line.address.vehicle)}</b> {escape(f'{line.words} ({topics}), {where}')}"


def _frame(fleet: Fleet, mains: Sequence[Line]) -> str:
    """Say what the map's metres are of."""
    projection = fleet.origin.projection
    own = [line.address.vehicle for line in mains if line.stream.valid is not None and not line.stream.valid.common]
    nowhere = [line.address.vehicle for line in mains if line.stream.valid is None]
    common = f"metres from {projection.latitude:.6f}, {projection.longitude:.6f}" if projection else ""
    parts = [common, f"from their own origin: {_few(own)}" if own else ""]
    parts += [f"never had a valid position: {_few(nowhere)}" if nowhere else ""]
    return "; ".join(part for part in parts if part)


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
