"""Viewer: the Bokeh document of one browser, and the actions of its clicks and keys."""

import json
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from string import Template
from typing import Any, Final
from urllib.parse import urlencode

from bokeh.document import Document
from bokeh.events import ConnectionLost, DocumentReady
from bokeh.layouts import column, row
from bokeh.models import (
    ColumnDataSource,
    CustomJS,
    CustomJSTickFormatter,
    GlobalInlineStyleSheet,
    LayoutDOM,
)
from bokeh.models.widgets import Div, TextInput
from bokeh.themes import Theme

from nedbus.health import Event
from nedbus.vehicle_events import ALL, state_at
from nedbus_msgs import Address

from .background import Background
from .event_timeline import PAST, EventTimeline
from .fleet import TRUTH, Fleet, FleetSnapshot, VehicleView
from .map import FOCUSES, Map
from .playback import Player
from .stream import is_position
from .style import DARK, LIGHT, panels, read_asset
from .time_plots import Plots, TimelinePlot, notable, set_time_range

_TICK: Final = 100  # ms between updates of the map
_TEXT_TICKS: Final = 5  # map updates per update of text and plots
_MAX_AHEAD: Final = 2  # maximum number of updates that the browser has not drawn yet
_MINUTE: Final = 60.0  # s
_AROUND: Final = 30.0  # s shown before and after a selected moment
_SECONDS: Final = re.compile(r"[0-9]{1,10}(\.[0-9])?")
_MAX_DIGITS: Final = 9  # digits of an update number
_MAX_MESSAGE: Final = 300  # characters of a message or URL argument from the browser
_STEPS: Final = {"left": -1.0, "right": 1.0, "LEFT": -10.0, "RIGHT": 10.0}  # s to seek


class Viewer:
    """One page in one browser; `update`, called ten times a second, sends it the changes to the fleet.

    `timeline`: the events; `player`: playback of a recording, None for live vehicles.
    The URL contains what differs from the default of the selected vehicle, moment, view and theme, so it can be shared.
    """

    def __init__(
        self, document: Document, fleet: Fleet, timeline: EventTimeline, *, title: str = "nedbus",
        background: Background | None = None, player: Player | None = None,
    ) -> None:  # fmt: skip
        request = getattr(document.session_context, "request", None)  # None without a browser
        given = request.arguments.items() if request is not None else ()
        query = {
            name: values[0].decode(errors="replace")[:_MAX_MESSAGE]
            for name, values in given
            if values
        }
        self.chosen: str | None = query.get("vehicle")
        self.pinned: float | None = None  # selected moment of live vehicles
        time = query.get("time", "")
        self._requested_time = float(time) if _SECONDS.fullmatch(time) else None
        self._is_choice = self.chosen is not None
        self._event: Event | None = None  # the selected event of the selected vehicle
        self._is_open = False  # True if the table of streams is open
        self._listed: list[str] = []
        self._faults: list[Event] = []
        self._fleet = fleet
        self._timeline = timeline
        self._player = player
        self._overview = player.recording.overview if player is not None else fleet
        self._style = LIGHT if query.get("theme") == "light" else DARK
        self._name = title
        self._document = document
        self._ticks = self._sent = 0
        self._clock = CustomJSTickFormatter(
            code=read_asset("clock.js"), args={"start": 0.0, "clock": ""}
        )
        self._timeline_plot = TimelinePlot(self._style, self._clock)
        self._plots = Plots(self._style, self._clock)
        self._undrawn = self._plots.draw()
        self._map = Map(self._style, background)
        self._map.focus = query["view"] if query.get("view") in FOCUSES else "all"
        context = {"style": self._style, "timeline": timeline, "format_time": timeline.format_time}
        self._panels: Any = panels().make_module(context)
        sheets: list[Any] = [read_asset("text.css")]
        wide: dict[str, Any] = {"stylesheets": sheets, "sizing_mode": "stretch_width"}
        names = "head", "list", "why", "nums", "tool", "more", "marks"
        self._text = {name: Div(css_classes=[name], **wide) for name in names}
        self._search = TextInput(placeholder="search vehicle  /", css_classes=["find"], **wide)
        self._grid = column(sizing_mode="stretch_both", css_classes=["plots"], visible=False)
        # Hidden inputs exchange values with the browser: update number, last update drawn, action, URL.
        self._update_number, self._drawn, self._message, self._url = (
            TextInput(visible=False) for _ in range(4)
        )
        drawn = "requestAnimationFrame(() => { drawn.value = cb_obj.value })"
        self._update_number.js_on_change("value", CustomJS(args={"drawn": self._drawn}, code=drawn))
        self._url.js_on_change(
            "value", CustomJS(code='history.replaceState(null, "", cb_obj.value)')
        )
        self._message.on_change("value", lambda _, __, message: self._act(message))
        self._search.on_change("value_input", lambda _, __, ___: self._update_text_soon())
        self._on_tap(self._map.marks, lambda: self._map.shown, self._choose)
        self._on_tap(self._map.events, lambda: self._map.shown_events, self._show)
        self._on_tap(self._timeline_plot.marks, lambda: self._timeline_plot.shown, self._show)
        theme = Template(read_asset("theme.json")).substitute(self._style.colours)
        document.title, document.theme = title, Theme(json=json.loads(theme))
        document.template = read_asset("page.html")  # type: ignore[assignment] # Bokeh compiles a string
        document.config.update(reconnect_session=False, notify_connection_status=False)
        document.js_on_event(ConnectionLost, CustomJS(code=read_asset("lost.js")))
        args = {"message": self._message, "map": self._map.figure, "search": self._search}
        document.js_on_event(DocumentReady, CustomJS(args=args, code=read_asset("actions.js")))
        document.add_root(self._lay_out(sheets))
        document.add_periodic_callback(self.update, _TICK)
        if player is not None:
            player.on_seek = self._update_text_soon

    def update(self) -> None:
        """Send changes: map at each tick, text and plots twice a second; do nothing while the browser is behind."""
        if self._player is not None:
            self._player.tick()
        drawn = str(self._drawn.value)[:_MAX_DIGITS]
        if drawn.isdecimal() and self._sent - int(drawn) >= _MAX_AHEAD:
            return
        self._sent += 1
        # plots follow one by one after map and list
        if self._drawn.value and (plot := next(self._undrawn, None)):
            self._grid.children = [*self._grid.children, plot]
        snapshot = self._fleet.snapshot
        # select the most severe vehicle until the user selects one
        if not self._is_choice and snapshot.vehicles:
            self.chosen = snapshot.vehicles[0].vehicle
        chosen = snapshot.vehicle(self.chosen)
        self._grid.visible = (
            bool(self._grid.children) and chosen is not None and is_position(chosen.main.address)
        )
        self._map.update(snapshot, self._overview, chosen)
        if self._ticks % _TEXT_TICKS == 0:
            self._go_to_requested()
            moment = snapshot.time if self.pinned is None else self.pinned
            self._update_text(snapshot, chosen, moment)
            self._update_plots(snapshot, chosen, moment)
        self._ticks += 1
        self._update_number.value = str(self._sent)

    def _update_text_soon(self) -> None:
        self._ticks = 0

    def _show(self, event: Event) -> None:
        if event.vehicle != ALL:
            self._choose(event.vehicle)
        self._go_to(event.time)
        self._event = event if event.vehicle != ALL else None

    def _choose(self, vehicle: str) -> None:
        self.chosen = vehicle
        self._is_choice = True
        self._event = None

    def _go_to(self, seconds: float | None) -> None:
        """Show a moment [s], or the current time if None."""
        self._event = None
        if self._player is None:
            self.pinned = seconds
        elif seconds is not None:
            self._player.seek(seconds)

    def _go_to_requested(self) -> None:
        """Show the moment in the URL once the recording has been read that far."""
        time, player = self._requested_time, self._player
        if time is not None and (
            player is None or player.recording.is_read or time <= player.recording.length
        ):
            if player is not None:
                player.toggle(pause=True)
            self._go_to(time)
            self._requested_time = None

    def _update_text(self, snapshot: FleetSnapshot, chosen: VehicleView | None, now: float) -> None:
        panels, player = self._panels, self._player
        bad = sum(each.grade == "bad" for each in snapshot.vehicles)
        self._document.title = f"({bad} bad) {self._name}" if bad else self._name
        self._clock.args = {"start": self._timeline.clock_offset, "clock": self._timeline.unit}
        clock = self._timeline.format_clock(snapshot.time) if snapshot.time or player else ""
        wanted = str(self._search.value_input or "").strip().lower()
        rows = [
            each
            for each in snapshot.vehicles
            if wanted in f"{each.vehicle}\n{each.state.text}".lower()
        ]
        self._listed = [each.vehicle for each in rows]
        story = None
        verdict = None
        then = chosen
        end = player.recording.length if player else snapshot.time
        if chosen is not None:
            at = (
                self._event
                if self._event is not None and abs(now - self._event.time) < 1.0
                else self.pinned
            )
            story = self._timeline.story(chosen.vehicle, now, at, chosen.state.conditions)
            if story is not None:
                is_now = player is None and self.pinned is None
                verdict = self._timeline.verdict(
                    chosen.vehicle, end, None if is_now else story.since
                )
            if self.pinned is not None:
                then = replace(
                    chosen, state=state_at(self._timeline.spans.get(chosen.vehicle, ()), now)
                )
        self._text["head"].text = panels.head(self._name, snapshot, clock)
        listed = panels.vehicles(rows, self.chosen)
        if player is not None:
            faults, whole = self._timeline.faults, self._timeline.verdict(self.chosen or "", end)
            self._faults = [story.spans[0].begin for _, story in faults]
            listed += panels.faults(faults, whole, end, len(snapshot.vehicles) > 1)
        self._text["list"].text = listed
        self._text["why"].text = panels.why(then, story, verdict, end, self.pinned)
        self._text["nums"].text = panels.numbers(chosen)
        self._text["more"].text = panels.streams(chosen, snapshot.reports, self._is_open)
        long, projection = "whole flight" if player else "15 min", self._fleet.origin.projection
        self._text["tool"].text = panels.toolbar(
            self._map, long, self.pinned, snapshot.vehicles, projection
        )
        query = {
            "theme": "light" if self._style is LIGHT else None,
            "vehicle": chosen.vehicle if chosen is not None and self._is_choice else None,
            "view": self._map.focus if self._map.focus != "all" else None,
            "time": f"{now:.1f}" if self.pinned is not None or player is not None else None,
        }
        if self._drawn.value:  # a browser that is not connected yet would miss the change
            self._url.value = (
                f"?{urlencode({name: value for name, value in query.items() if value is not None})}"
            )

    def _update_plots(
        self, snapshot: FleetSnapshot, chosen: VehicleView | None, now: float
    ) -> None:
        vehicle, is_long_trail = self.chosen or "", self._map.is_long
        is_long = is_long_trail or now < snapshot.time - _MINUTE
        main = truth = None
        if chosen is not None and is_position(chosen.main.address):
            streams = self._overview.streams if is_long else self._fleet.streams
            pair = streams.get(chosen.main.address), streams.get(Address(vehicle, TRUTH))
            main, truth = (
                None if each is None else each.long if is_long else each.minute for each in pair
            )
        self._plots.update(main, truth)
        begin, end = (
            (0.0, self._player.recording.length)
            if self._player
            else (snapshot.time - PAST, snapshot.time)
        )
        if self.pinned is not None:
            set_time_range(self._plots.range, now - _AROUND, now + _AROUND)
        elif is_long_trail:
            set_time_range(self._plots.range, begin, end)
        else:
            first = max(begin, now - _MINUTE)
            set_time_range(self._plots.range, first, min(first + _MINUTE, max(end, 1.0)))
        if self._player is None:  # live, the timeline begins with the first event
            first = next((event.time for event in self._timeline.events if event.time > begin), now)
            begin = max(begin, min(first, now - _MINUTE) - 1.0)
        events = self._events_of_chosen()
        self._plots.mark_events(events, self._timeline.spans.get(vehicle, ()), end)
        order = [
            *filter(None, [vehicle]),
            *(each.vehicle for each in snapshot.vehicles if each.vehicle != vehicle),
        ]
        self._timeline_plot.update(
            self._timeline.events, self._timeline.spans, order, begin=begin, end=end, now=now
        )
        if self._ticks % (2 * _TEXT_TICKS) == 0 or self.pinned is not None:
            set_time_range(self._timeline_plot.range, begin, max(end, begin + 1.0))
        if self._player is not None:
            self._text["marks"].text = self._panels.strip(
                self._timeline_plot.shown, self._player.recording.length
            )
        since = 0.0 if is_long_trail else now - _MINUTE
        self._map.mark_events(
            [event for event in events if since < event.time <= now + 1.0], chosen, self._overview
        )

    def _events_of_chosen(self) -> list[Event]:
        return notable(event for event in self._timeline.events if event.vehicle == self.chosen)

    def _act(self, message: str) -> None:
        """Perform an action sent by `actions.js` on a click or key; ignore malformed messages."""
        action = value = ""
        with suppress(ValueError, TypeError):
            action, value, _ = map(str, json.loads(message[:_MAX_MESSAGE]))
        (name, _, option), player = action.partition(":"), self._player
        match name:
            case "vehicle" if self._fleet.snapshot.vehicle(value) is not None:
                self._choose(value)
            case "event" | "fault" if value.isdecimal():
                for event in (self._timeline_plot.shown if name == "event" else self._faults)[
                    int(value) :
                ][:1]:
                    self._show(event)
            case "focus" if option in FOCUSES:
                self._map.focus = option
            case "trail":
                self._map.is_long = not self._map.is_long
            case "truth":
                self._map.truth = not self._map.truth
            case "streams":
                self._is_open = not self._is_open
            case "size":
                self._map.resize(value)
            case "now":
                self._go_to(None)
            case "down" | "up":
                self._choose_next(1 if name == "down" else -1)
            case "next" | "previous":
                self._show_next(is_later=name == "next")
            case "play" | "left" | "right" | "LEFT" | "RIGHT" if player is not None:
                player.toggle() if name == "play" else player.seek(player.time + _STEPS[name])
        self._update_text_soon()

    def _choose_next(self, step: int) -> None:
        if names := self._listed:  # wraps around
            self._choose(
                names[(names.index(self.chosen) + step if self.chosen in names else 0) % len(names)]
            )

    def _show_next(self, *, is_later: bool) -> None:
        now, events = self._player.time if self._player else self.pinned, self._events_of_chosen()
        later = [event for event in events if now is not None and event.time > now + 0.05]
        earlier = [event for event in events if now is None or event.time < now - 0.05]
        for event in later[:1] if is_later else earlier[-1:]:
            self._show(event)

    def _on_tap(
        self,
        source: ColumnDataSource,
        shown: Callable[[], list[Any]],
        show: Callable[[Any], object],
    ) -> None:
        """Call `show` for each tapped row; clear the selection, otherwise a second tap would not be reported."""

        def tap(_: str, __: object, rows: list[int]) -> None:
            if rows and 0 <= rows[0] < len(shown()):
                show(shown()[rows[0]])
                self._update_text_soon()
            source.selected.indices = []

        source.selected.on_change("indices", tap)

    def _lay_out(self, sheets: list[Any]) -> LayoutDOM:
        text = self._text
        parts: list[LayoutDOM] = [
            text["head"],
            self._search,
            text["list"],
            text["why"],
            text["tool"],
        ]
        parts += [
            self._map.figure,
            self._timeline_plot.figure,
            text["nums"],
            self._grid,
            text["more"],
        ]
        if self._player is not None:
            *controls, slider = self._player.controls
            for control in self._player.controls:
                control.stylesheets = sheets
            marked = column(slider, text["marks"], sizing_mode="stretch_width")
            parts.insert(
                1, row(*controls, marked, sizing_mode="stretch_width", css_classes=["ctrl"])
            )
        parts += [self._update_number, self._drawn, self._message, self._url]
        variables = " ".join(f"--{name}: {colour};" for name, colour in self._style.colours.items())
        css = f":root {{ {variables} }} html, body {{ margin: 0; background: var(--ground); }}"
        page: list[Any] = [GlobalInlineStyleSheet(css=css), read_asset("layout.css")]
        return column(*parts, sizing_mode="stretch_width", stylesheets=page)
