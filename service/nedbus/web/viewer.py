"""What one viewer sees, and how it follows the fleet: a Document of Bokeh, which needs no browser."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, cast
from urllib.parse import urlencode

from bokeh.document import Document
from bokeh.events import ConnectionLost, DocumentReady
from bokeh.layouts import column, row
from bokeh.models import (
    ColumnDataSource,
    CustomJS,
    CustomJSTickFormatter,
    GlobalInlineStyleSheet,
    InlineStyleSheet,
    LayoutDOM,
)
from bokeh.models.widgets import Div, TextInput

from nedbus.events import ALL, Event, to_clock
from nedbus_msgs import Address

from . import panels, script
from .chronicle import PAST, Chronicle
from .fleet import TRUTH, Fleet, Picture, Row
from .map_plot import Focus, MapPlot, View
from .plots import Plots
from .stream import is_position
from .style import DARK, LIGHT
from .timeline import Timeline, is_notable

if TYPE_CHECKING:
    from .background import Background
    from .playback import Player

TICK: Final = 100
"""Milliseconds between two moves of the map."""

_LOOK: Final = 5  # ticks between two updates of text and plots
_AHEAD: Final = 2  # pictures that are sent before the browser has drawn the first of them
_SLOW: Final = 1.0  # s between two pictures from which on the page says so
_MINUTE: Final = 60.0
_EARLY: Final = 30.0  # s that are shown before and after a moment that is chosen
_DAY: Final = 86_400.0
_DIGITS: Final = 9  # of the number of a picture
_MAX_SIDE: Final = 20_000  # pixels of a map
_MAX_SAID: Final = 300  # characters of what a browser asks for
_FOCUSES: Final = ("all", "follow", "vehicle")
_STEPS: Final = {"left": -1.0, "right": 1.0, "LEFT": -10.0, "RIGHT": 10.0}  # s of a recording


class Viewer:
    """One page in one browser; `update` sends what is new of the fleet, ten times a second.

    `world`: what happened. `whole`: the fleet whose long histories are shown. `player`: of a recording.
    What the address of the page asks for is shown first, and the address follows what is shown, so that it can be sent.
    """

    def __init__(
        self,
        document: Document,
        fleet: Fleet,
        world: Chronicle,
        *,
        title: str = "nedbus",
        background: Background | None = None,
        whole: Fleet | None = None,
        player: Player | None = None,
    ) -> None:
        asked = _arguments(document)
        self._light = asked.get("theme") == "light"
        style = LIGHT if self._light else DARK
        self.chosen: str | None = asked.get("vehicle")
        self._is_choice = self.chosen is not None
        self.pinned: float | None = None
        self._event: Event | None = None
        focus = asked.get("view", "all")
        self.view = View(cast("Focus", focus if focus in _FOCUSES else "all"))
        self._asked_time = asked.get("time")
        self._fleet, self._whole, self._world, self._player = fleet, whole or fleet, world, player
        self._style, self._name = style, title
        self._ticks, self._open = 0, False
        self._listed: list[str] = []
        self._clock = CustomJSTickFormatter(code=script.CLOCK, args={"start": 0.0})
        self._timeline = Timeline(style, self._clock)
        self._plots_range = type(self._timeline.range)()
        self._plots = Plots(style, self._clock, self._plots_range)
        self._map = MapPlot(style, background)
        css = style.text_css
        self._head, self._list, self._why, self._numbers, self._tool, self._more, self._strip = (
            Div(stylesheets=[css], sizing_mode="stretch_width", css_classes=[name])
            for name in ("head", "list", "why", "nums", "tool", "more", "marks")
        )
        self._search = TextInput(
            placeholder="search vehicle  /", sizing_mode="stretch_width", css_classes=["find"], stylesheets=[css]
        )
        self._search.on_change("value_input", lambda _, __, ___: self._show_now())
        self._grid = column(sizing_mode="stretch_both", css_classes=["plots"])
        self._sent, self._updated, self._slow = 0, time.monotonic(), 0.0
        self._beat, self._drawn, self._said, self._address = (TextInput(visible=False) for _ in range(4))
        self._beat.js_on_change("value", CustomJS(args={"drawn": self._drawn}, code=script.DRAWN))
        self._address.js_on_change("value", CustomJS(code=script.ADDRESS))
        self._said.on_change("value", lambda _, __, said: self._act(said))
        self._on_tap(self._map.marks, lambda: self._map.shown, self._do_vehicle)
        self._on_tap(self._map.events, lambda: self._map.told, self.show)
        self._on_tap(self._timeline.marks, lambda: self._timeline.shown, self.show)
        document.title = title
        self._document = document
        document.theme = style.theme
        document.config.update(reconnect_session=False, notify_connection_status=False)
        document.js_on_event(ConnectionLost, CustomJS(code=script.LOST))
        args = {"said": self._said, "map": self._map.figure, "search": self._search}
        document.js_on_event(DocumentReady, CustomJS(args=args, code=script.ACTIONS))
        document.add_root(self._lay_out(css))

    def update(self) -> None:
        """Send what is new, as soon as the browser has drawn the last: the map each time, the rest twice a second."""
        now = time.monotonic()
        drawn = str(self._drawn.value)[:_DIGITS]
        if drawn.isdecimal() and self._sent - int(drawn) >= _AHEAD:
            return
        self._slow = now - self._updated if now - self._updated > _SLOW else 0.0
        self._sent, self._updated = self._sent + 1, now
        if self._drawn.value and not self._grid.children:  # map and list are there sooner without
            self._grid.children = [*self._plots.draw()]
        picture = self._fleet.picture
        if not self._is_choice and picture.rows:  # the worst, until somebody chooses
            self.chosen = picture.rows[0].vehicle
        chosen = picture.row(self.chosen)
        self._map.update(picture, self._whole, chosen, self.view, self._fleet.origin.projection)
        if self._ticks % _LOOK == 0:
            self._go_to_asked()
            self._tell(picture, chosen)
            self._plot(picture, chosen)
        self._ticks += 1
        self._beat.value = str(self._sent)

    def restart(self) -> None:
        """Send everything again: the time has jumped."""
        self._map.clear()
        self._plots.clear()
        self._show_now()

    def show(self, event: Event) -> None:
        """Show a moment: when and where something happened."""
        if event.vehicle != ALL:
            self._choose(event.vehicle)
        self._go_to(event.time)
        self._event = event

    def _choose(self, vehicle: str) -> None:
        self.chosen, self._is_choice, self._event = vehicle, True, None

    def _go_to(self, seconds: float | None) -> None:
        self._event = None
        if self._player is not None and seconds is not None:
            self._player.jump(seconds)
        elif self._player is None:
            self.pinned = seconds
        self._show_now()

    def _show_now(self) -> None:
        self._ticks = 0

    def _go_to_asked(self) -> None:
        """Show the moment that the address asks for, when something is known."""
        events = self._world.events
        if self._asked_time is None or not events or (self._player is not None and not self._player.length):
            return
        near = next((each for each in reversed(events) if each.vehicle == self.chosen), events[-1])
        with suppress(ValueError):  # an address that was written by hand: no moment is chosen then
            moment = self._world.times.find(self._asked_time, near)
            if abs(moment - near.time) < _DAY:
                if self._player is not None and not self._player.has(moment):
                    return  # it is still read
                self._go_to(moment)
                if self._player is not None:
                    self._player.pause()
        self._asked_time = None

    def _tell(self, picture: Picture, chosen: Row | None) -> None:
        """Write all text."""
        moment, start = self._world.moment, self._world.start
        bad = sum(line.grade == "bad" for line in picture.rows)
        title = f"({bad} bad) {self._name}" if bad else self._name
        if self._document.title != title:
            self._document.title = title
        self._clock.args = {"start": start or 0.0}
        clock = self._player.clock(picture.time) if self._player else f"{moment(picture.time)} UTC" * bool(picture.time)
        wanted = str(self._search.value_input or "").strip().lower()
        rows = [line for line in picture.rows if wanted in line.vehicle.lower() or wanted in line.text.lower()]
        self._listed = [line.vehicle for line in rows]
        now = picture.time if self.pinned is None else self.pinned
        story, then = None, chosen
        if chosen is not None:
            story = self._world.story(chosen.vehicle, now, pinned=self.pinned, event=self._event)
            then = chosen if self.pinned is None else chosen.at(self._world.state(chosen.vehicle, now))
        head = panels.header(self._name, picture, clock=clock, slow=self._slow, theme=self._style.name)
        _write(self._head, head)
        _write(self._list, panels.vehicle_list(rows, self.chosen, self._style, moment))
        _write(self._why, panels.why(then, story, now, moment, pinned=self.pinned is not None))
        _write(self._numbers, panels.numbers(chosen))
        _write(self._more, panels.streams(chosen, picture, is_open=self._open, moment=moment))
        pinned = "" if self.pinned is None else moment(self.pinned)
        long = "whole flight" if self._player else "15 min"
        _write(
            self._tool,
            panels.toolbar(
                focus=self.view.focus, trail=self.view.trail, long=long, truth=self.view.truth, pinned=pinned,
                note=panels.frame(self._fleet, picture.rows),
            ),
        )  # fmt: skip
        self._keep_address(chosen, now, start)

    def _plot(self, picture: Picture, chosen: Row | None) -> None:
        """Send the points, and move the time axes."""
        now, vehicle = picture.time, self.chosen or ""
        is_long = self.view.trail == "long" or (self.pinned is not None and self.pinned < now - _MINUTE)
        main = truth = None
        if chosen is not None and is_position(chosen.main.address):
            streams = self._whole.streams if is_long else self._fleet.streams
            kept = streams.get(chosen.main.address), streams.get(Address(vehicle, TRUTH))
            main, truth = (None if each is None else each.long if is_long else each.minute for each in kept)
        self._plots.update(main, truth)
        begin, end = (0.0, self._player.length) if self._player else (now - PAST, now)
        if self.pinned is not None:
            self._move(self.pinned - _EARLY, self.pinned + _EARLY)
        elif self.view.trail == "long":
            self._move(begin, end)
        else:
            first = max(begin, now - _MINUTE)
            self._move(first, first + _MINUTE)
        told = [event for event in self._world.events if event.vehicle == vehicle and is_notable(event)]
        self._plots.mark(told, self._world.spans.get(vehicle, ()), now)
        order = [vehicle, *(line.vehicle for line in picture.rows if line.vehicle != vehicle)]
        moment = now if self.pinned is None else self.pinned
        self._timeline.update(self._world.events, self._world.spans, order, begin=begin, end=end, now=moment)
        if self._ticks % (2 * _LOOK) == 0 or self.pinned is not None:
            self._timeline.move(begin, max(end, begin + 1.0))
        if self._player is not None:
            _write(self._strip, panels.strip(self._timeline.shown, self._player.length))
        since = begin if self.view.trail == "long" else moment - _MINUTE
        self._map.mark([event for event in told if since < event.time <= moment + 1.0], chosen, self._whole)

    def _move(self, begin: float, end: float) -> None:
        self._plots_range.update(start=begin * 1e3, end=end * 1e3)

    def _keep_address(self, chosen: Row | None, now: float, start: float | None) -> None:
        """Let the address of the page say what is shown."""
        asked = {"theme": "light"} if self._light else {}
        if chosen is not None and self._is_choice:
            asked["vehicle"] = chosen.vehicle
        if self.view.focus != "all":
            asked["view"] = self.view.focus
        if self.pinned is not None or self._player is not None:
            asked["time"] = self._moment_text(now, start)
        address = f"?{urlencode(asked)}"
        if self._drawn.value and self._address.value != address:  # a browser that is not there yet would miss it
            self._address.value = address

    def _moment_text(self, now: float, start: float | None) -> str:
        if self._player is not None and start is None:
            near = next(iter(self._world.events), None)
            base = 0.0 if near is None or near.boot is None else near.boot - near.time
            return f"{now + base:.1f}"
        return to_clock(now + (start or 0.0))

    def _act(self, said: str) -> None:
        """Do what a click or a key asks for; anything else is ignored."""
        try:
            action, value, _ = json.loads(said[:_MAX_SAID])
            name, _, part = str(action).partition(":")
            do = getattr(self, f"_do_{name.lower()}", None)
        except (ValueError, TypeError):
            return
        if do is not None:
            do(part or (name if name in _STEPS else str(value)))
            self._show_now()

    def _do_vehicle(self, name: str) -> None:
        if self._fleet.picture.row(name) is not None:
            self._choose(name)

    def _do_focus(self, focus: str) -> None:
        if focus in _FOCUSES:
            self.view = replace(self.view, focus=cast("Focus", focus))

    def _do_trail(self, _: str) -> None:
        self.view = replace(self.view, trail="long" if self.view.trail == "minute" else "minute")

    def _do_truth(self, _: str) -> None:
        self.view = replace(self.view, truth=not self.view.truth)

    def _do_streams(self, _: str) -> None:
        self._open = not self._open

    def _do_event(self, index: str) -> None:
        if index.isdecimal() and int(index) < len(self._timeline.shown):
            self.show(self._timeline.shown[int(index)])

    def _do_size(self, size: str) -> None:
        width, _, height = size.partition("x")
        if width.isdecimal() and height.isdecimal() and 0 < int(width) < _MAX_SIDE and 0 < int(height) < _MAX_SIDE:
            self._map.size = float(width), float(height)

    def _do_now(self, _: str) -> None:
        self._go_to(None)

    def _do_down(self, _: str, step: int = 1) -> None:
        names = self._listed
        if names:
            self._choose(names[(names.index(self.chosen) + step if self.chosen in names else 0) % len(names)])

    def _do_up(self, _: str) -> None:
        self._do_down(_, -1)

    def _do_next(self, _: str) -> None:
        self._step(1)

    def _do_previous(self, _: str) -> None:
        self._step(-1)

    def _do_play(self, _: str) -> None:
        if self._player is not None:
            self._player.toggle()

    def _do_left(self, key: str) -> None:
        if self._player is not None:
            self._player.jump(self._player.time + _STEPS.get(key, 0.0))

    _do_right = _do_left

    def _step(self, step: int) -> None:
        """Go to the next or the previous event of the chosen vehicle."""
        told = [event for event in self._world.events if event.vehicle == self.chosen and is_notable(event)]
        now = self._player.time if self._player else self.pinned
        if step > 0:
            found = next((event for event in told if now is not None and event.time > now + 0.05), None)
        else:
            found = next((event for event in reversed(told) if now is None or event.time < now - 0.05), None)
        if found is not None:
            self.show(found)

    def _on_tap(
        self, source: ColumnDataSource, shown: Callable[[], Sequence[Any]], show: Callable[[Any], object]
    ) -> None:
        """Show what is tapped, which is no selection: the same may be tapped again."""

        def tap(_: str, __: object, rows: list[int]) -> None:
            if rows and 0 <= rows[0] < len(shown()):
                show(shown()[rows[0]])
                self._show_now()
            source.selected.indices = []

        source.selected.on_change("indices", tap)

    def _lay_out(self, css: str) -> LayoutDOM:
        parts: list[LayoutDOM] = [self._head, self._search, self._list, self._tool, self._map.figure]
        parts += [self._timeline.figure, self._why, self._numbers, self._grid, self._more]
        if self._player is not None:
            *controls, slider = self._player.controls
            for control in (*controls, slider):
                control.stylesheets = [css]
            marked = column(slider, self._strip, sizing_mode="stretch_width")
            parts.insert(1, row(*controls, marked, sizing_mode="stretch_width", css_classes=["ctrl"]))
        hidden = [self._beat, self._drawn, self._said, self._address]
        sheets: list[Any] = [
            GlobalInlineStyleSheet(css=self._style.page_css), InlineStyleSheet(css=self._style.layout_css)
        ]  # fmt: skip
        return column(*parts, *hidden, sizing_mode="stretch_width", stylesheets=sheets)


def _write(div: Div, text: str) -> None:
    if div.text != text:
        div.text = text


def _arguments(document: Document) -> Mapping[str, str]:
    """Return what the address of the page asks for."""
    request = getattr(document.session_context, "request", None)  # none without a browser
    given = request.arguments if request is not None else {}
    return {name: values[0].decode(errors="replace")[:_MAX_SAID] for name, values in given.items() if values}
