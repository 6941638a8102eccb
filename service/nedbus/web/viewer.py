"""Viewer: the Bokeh document of one browser, and the actions of its clicks and keys."""

import json
import re
from collections.abc import Callable, Sequence
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

from nedbus import limits
from nedbus.health import Event, Story
from nedbus.vehicle_events import ALL, state_at
from nedbus_msgs import Address

from .background import Background
from .event_timeline import PAST, EventTimeline
from .fleet import TRUTH, Fleet, FleetSnapshot, VehicleView
from .map import FOCUSES, Map
from .playback import Player
from .stream import History, is_position
from .style import DARK, LIGHT, panels, read_asset
from .time_plots import Plots, TimelinePlot, notable, set_time_range

_TICK: Final = 100  # ms between updates of the map
_TEXT_TICKS: Final = 5  # map updates per update of text and plots
_WINDOW: Final = 2  # updates that the browser has not drawn yet, after which the viewer waits
_MINUTE: Final = 60.0  # s
_SAME_MOMENT: Final = 0.05  # s; an event is not after itself
_AROUND: Final = 30.0  # s shown before and after a selected moment
_SECONDS: Final = re.compile(r"[0-9]{1,10}(\.[0-9])?")
_STEPS: Final = {"left": -1.0, "right": 1.0, "LEFT": -10.0, "RIGHT": 10.0}  # s to seek


class Viewer:
    """One page in one browser; `update`, called ten times a second, sends it the changes to the fleet.

    `timeline`: the events; `player`: playback of a recording, None for live vehicles.
    The URL contains what differs from the default of the selected vehicle, moment, view and theme, so it can be shared.
    """

    def __init__(
        self,
        document: Document,
        fleet: Fleet,
        timeline: EventTimeline,
        *,
        title: str = "nedbus",
        background: Background | None = None,
        player: Player | None = None,
    ) -> None:
        query = _query_of(document)
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
        if player is not None:
            self._overview = player.recording.overview
        else:
            self._overview = fleet
        if query.get("theme") == "light":
            self._style = LIGHT
        else:
            self._style = DARK
        self._name = title
        self._document = document
        self._ticks = 0
        self._sent = 0
        context = {"style": self._style, "timeline": timeline, "format_time": timeline.format_time}
        self._panels: Any = panels().make_module(context)
        self._clock = CustomJSTickFormatter(
            code=read_asset("clock.js"), args={"start": 0.0, "clock": ""}
        )
        self._timeline_plot = TimelinePlot(self._style, self._clock)
        self._plots = Plots(self._style, self._clock)
        self._undrawn = self._plots.draw()
        self._map = Map(self._style, background)
        if query.get("view") in FOCUSES:
            self._map.focus = query["view"]
        sheets: list[Any] = [read_asset("text.css")]
        wide: dict[str, Any] = {"stylesheets": sheets, "sizing_mode": "stretch_width"}
        names = ("head", "list", "why", "nums", "tool", "more", "marks")
        self._text = {name: Div(css_classes=[name], **wide) for name in names}
        self._search = TextInput(placeholder="search vehicle  /", css_classes=["find"], **wide)
        self._grid = column(sizing_mode="stretch_both", css_classes=["plots"], visible=False)
        # Hidden inputs exchange values with the browser.
        self._update_number = TextInput(visible=False)
        self._drawn = TextInput(visible=False)  # number of the last update that it has drawn
        self._message = TextInput(visible=False)  # action of a click or key
        self._url = TextInput(visible=False)
        self._connect_inputs()
        self._set_up_document()
        document.add_root(self._lay_out(sheets))
        document.add_periodic_callback(self.update, _TICK)
        if player is not None:
            player.on_seek = self._update_text_soon

    def _connect_inputs(self) -> None:
        drawn = "requestAnimationFrame(() => { drawn.value = cb_obj.value })"
        self._update_number.js_on_change("value", CustomJS(args={"drawn": self._drawn}, code=drawn))
        show_url = CustomJS(code='history.replaceState(null, "", cb_obj.value)')
        self._url.js_on_change("value", show_url)
        self._message.on_change("value", lambda _, __, message: self._act(message))
        self._search.on_change("value_input", lambda _, __, ___: self._update_text_soon())
        self._on_tap(self._map.marks, lambda: self._map.shown, self._choose)
        self._on_tap(self._map.events, lambda: self._map.shown_events, self._show)
        self._on_tap(self._timeline_plot.marks, lambda: self._timeline_plot.shown, self._show)

    def _set_up_document(self) -> None:
        document = self._document
        theme = Template(read_asset("theme.json")).substitute(self._style.colours)
        document.title = self._name
        document.theme = Theme(json=json.loads(theme))
        document.template = read_asset("page.html")  # type: ignore[assignment] # Bokeh compiles a string
        document.config.update(reconnect_session=False, notify_connection_status=False)
        document.js_on_event(ConnectionLost, CustomJS(code=read_asset("lost.js")))
        args = {"message": self._message, "map": self._map.figure, "search": self._search}
        document.js_on_event(DocumentReady, CustomJS(args=args, code=read_asset("actions.js")))

    def update(self) -> None:
        """Send changes: map at each tick, text and plots twice a second; do nothing while the browser is behind."""
        if self._player is not None:
            self._player.tick()
        drawn = str(self._drawn.value)[: limits.PEER_TEXT]
        is_behind = drawn.isdecimal() and self._sent - int(drawn) >= _WINDOW
        if is_behind:
            return
        self._sent += 1
        if self._drawn.value:
            self._add_plot()
        snapshot = self._fleet.snapshot
        # select the most severe vehicle until the user selects one
        if not self._is_choice and snapshot.vehicles:
            self.chosen = snapshot.vehicles[0].vehicle
        chosen = snapshot.vehicle(self.chosen)
        has_position = chosen is not None and is_position(chosen.main.address)
        self._grid.visible = has_position and bool(self._grid.children)
        self._map.update(snapshot, self._overview, chosen)
        if self._ticks % _TEXT_TICKS == 0:
            self._go_to_requested()
            if self.pinned is None:
                moment = snapshot.time
            else:
                moment = self.pinned
            self._update_text(snapshot, chosen, moment)
            self._update_plots(snapshot, chosen, moment)
        self._ticks += 1
        self._update_number.value = str(self._sent)

    def _add_plot(self) -> None:
        """Add the next plot: they follow one by one after map and list."""
        plot = next(self._undrawn, None)
        if plot is not None:
            self._grid.children = [*self._grid.children, plot]

    def _update_text_soon(self) -> None:
        self._ticks = 0

    def _show(self, event: Event) -> None:
        if event.vehicle != ALL:
            self._choose(event.vehicle)
        self._go_to(event.time)
        if event.vehicle != ALL:
            self._event = event
        else:
            self._event = None

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
        time = self._requested_time
        player = self._player
        if time is None:
            return
        if player is not None:
            if not player.recording.is_read and time > player.recording.length:
                return
            player.toggle(pause=True)
        self._go_to(time)
        self._requested_time = None

    def _update_text(self, snapshot: FleetSnapshot, chosen: VehicleView | None, now: float) -> None:
        panels = self._panels
        player = self._player
        bad = sum(view.grade == "bad" for view in snapshot.vehicles)
        if bad:
            self._document.title = f"({bad} bad) {self._name}"
        else:
            self._document.title = self._name
        self._clock.args = {"start": self._timeline.clock_offset, "clock": self._timeline.unit}
        clock = ""
        if snapshot.time or player:
            clock = self._timeline.format_clock(snapshot.time)
        wanted = str(self._search.value_input or "")
        wanted = wanted.strip().lower()
        rows = []
        for view in snapshot.vehicles:
            if wanted in f"{view.vehicle}\n{view.state.text}".lower():
                rows.append(view)
        self._listed = [view.vehicle for view in rows]
        self._text["head"].text = panels.head(self._name, snapshot, clock)
        listed = panels.vehicles(rows, self.chosen)
        end = snapshot.time
        if player is not None:
            end = player.recording.length
            faults = self._timeline.faults
            verdict = self._timeline.verdict(self.chosen or "", end)
            self._faults = [story.spans[0].begin for _, story in faults]
            several = len(snapshot.vehicles) > 1
            listed += panels.faults(faults, verdict, end, several)
        self._text["list"].text = listed
        self._text["why"].text = self._explain(chosen, now, end)
        self._text["nums"].text = panels.numbers(chosen)
        self._text["more"].text = panels.streams(chosen, snapshot.reports, self._is_open)
        long = "whole flight" if player else "15 min"
        self._text["tool"].text = panels.toolbar(
            self._map, long, self.pinned, snapshot.vehicles, self._fleet.origin.projection
        )
        if self._drawn.value:  # a browser that is not connected yet would miss the change
            self._url.value = f"?{urlencode(self._query(chosen, now))}"

    def _explain(self, chosen: VehicleView | None, now: float, end: float) -> str:
        """Return the panel that explains the state of the selected vehicle, now or at the selected moment."""
        story: Story | None = None
        verdict = None
        if chosen is not None:
            at: Event | float | None = self.pinned
            if self._event is not None and abs(now - self._event.time) < 1.0:
                at = self._event
            story = self._timeline.story(chosen.vehicle, now, at, chosen.state.conditions)
            if story is not None:
                is_now = self._player is None and self.pinned is None
                if is_now:
                    moment = None
                else:
                    moment = story.since
                verdict = self._timeline.verdict(chosen.vehicle, end, moment)
            if self.pinned is not None:
                spans = self._timeline.spans.get(chosen.vehicle, ())
                chosen = replace(chosen, state=state_at(spans, now))
        text: str = self._panels.why(chosen, story, verdict, end, self.pinned)
        return text

    def _query(self, chosen: VehicleView | None, now: float) -> dict[str, str]:
        """Return the arguments of the URL: what differs from the default."""
        query = {}
        if self._style is LIGHT:
            query["theme"] = "light"
        if chosen is not None and self._is_choice:
            query["vehicle"] = chosen.vehicle
        if self._map.focus != "all":
            query["view"] = self._map.focus
        if self.pinned is not None or self._player is not None:
            query["time"] = f"{now:.1f}"
        return query

    def _update_plots(
        self, snapshot: FleetSnapshot, chosen: VehicleView | None, now: float
    ) -> None:
        vehicle = self.chosen or ""
        is_long = self._map.is_long or now < snapshot.time - _MINUTE
        main = truth = None
        if chosen is not None and is_position(chosen.main.address):
            main = self._history(chosen.main.address, is_long=is_long)
            truth = self._history(Address(vehicle, TRUTH), is_long=is_long)
        self._plots.update(main, truth)
        begin = snapshot.time - PAST
        end = snapshot.time
        if self._player is not None:
            begin = 0.0
            end = self._player.recording.length
        if self.pinned is not None:
            set_time_range(self._plots.range, now - _AROUND, now + _AROUND)
        elif self._map.is_long:
            set_time_range(self._plots.range, begin, end)
        else:
            first = max(begin, now - _MINUTE)
            last = min(first + _MINUTE, max(end, 1.0))
            set_time_range(self._plots.range, first, last)
        events = self._events_of_chosen()
        spans = self._timeline.spans.get(vehicle, ())
        self._plots.mark_events(events, spans, end)
        self._update_timeline(snapshot, begin, end, now)
        if self._map.is_long:
            since = 0.0
        else:
            since = now - _MINUTE
        recent = [event for event in events if since < event.time <= now + 1.0]
        self._map.mark_events(recent, chosen, self._overview)

    def _history(self, address: Address, *, is_long: bool) -> History | None:
        """Return the points of a stream: of all the time, or of the last minute."""
        if is_long:
            fleet = self._overview
        else:
            fleet = self._fleet
        stream = fleet.streams.get(address)
        if stream is None:
            return None
        if is_long:
            return stream.long
        return stream.minute

    def _update_timeline(
        self, snapshot: FleetSnapshot, begin: float, end: float, now: float
    ) -> None:
        timeline = self._timeline
        if self._player is None:  # live, the timeline begins with the first event
            times = [event.time for event in timeline.events if event.time > begin]
            if times:
                first = times[0]
            else:
                first = now
            begin = max(begin, min(first, now - _MINUTE) - 1.0)
        names = [view.vehicle for view in snapshot.vehicles if view.vehicle != self.chosen]
        if self.chosen:
            names.insert(0, self.chosen)
        self._timeline_plot.update(
            timeline.events, timeline.spans, names, begin=begin, end=end, now=now
        )
        if self._ticks % (2 * _TEXT_TICKS) == 0 or self.pinned is not None:
            set_time_range(self._timeline_plot.range, begin, max(end, begin + 1.0))
        if self._player is not None:
            strip = self._panels.strip(self._timeline_plot.shown, self._player.recording.length)
            self._text["marks"].text = strip

    def _events_of_chosen(self) -> list[Event]:
        return notable(event for event in self._timeline.events if event.vehicle == self.chosen)

    def _act(self, message: str) -> None:
        """Perform an action sent by `actions.js` on a click or key; ignore malformed messages."""
        try:
            action, value, _ = map(str, json.loads(message[: limits.PEER_TEXT]))
        except (ValueError, TypeError):
            action = value = ""
        name, _, option = action.partition(":")
        self._change_view(name, option, value)
        self._navigate(name, value)
        self._update_text_soon()

    def _change_view(self, name: str, option: str, value: str) -> None:
        match name:
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

    def _navigate(self, name: str, value: str) -> None:
        """Perform an action that selects a vehicle, an event or a moment."""
        player = self._player
        match name:
            case "vehicle" if self._fleet.snapshot.vehicle(value) is not None:
                self._choose(value)
            case "event" if value.isdecimal():
                self._show_number(self._timeline_plot.shown, int(value))
            case "fault" if value.isdecimal():
                self._show_number(self._faults, int(value))
            case "now":
                self._go_to(None)
            case "down":
                self._choose_next(1)
            case "up":
                self._choose_next(-1)
            case "next":
                self._show_next()
            case "previous":
                self._show_previous()
            case "play" if player is not None:
                player.toggle()
            case "left" | "right" | "LEFT" | "RIGHT" if player is not None:
                player.seek(player.time + _STEPS[name])

    def _show_number(self, events: Sequence[Event], number: int) -> None:
        if number < len(events):
            self._show(events[number])

    def _choose_next(self, step: int) -> None:
        """Choose the vehicle `step` rows below the chosen one in the list, which wraps around."""
        names = self._listed
        if not names:
            return
        number = 0
        if self.chosen in names:
            number = names.index(self.chosen) + step
        self._choose(names[number % len(names)])

    def _moment(self) -> float | None:
        """Return the shown moment [s]; None for the current time of live vehicles."""
        if self._player is None:
            return self.pinned
        return self._player.time

    def _show_next(self) -> None:
        now = self._moment()
        later = [
            event
            for event in self._events_of_chosen()
            if now is not None and event.time > now + _SAME_MOMENT
        ]
        if later:
            self._show(later[0])

    def _show_previous(self) -> None:
        now = self._moment()
        earlier = [
            event
            for event in self._events_of_chosen()
            if now is None or event.time < now - _SAME_MOMENT
        ]
        if earlier:
            self._show(earlier[-1])

    def _on_tap(
        self,
        source: ColumnDataSource,
        shown: Callable[[], list[Any]],
        show: Callable[[Any], object],
    ) -> None:
        """Call `show` for each tapped row; clear the selection, otherwise a second tap would not be reported."""

        def tap(_: str, __: object, numbers: list[int]) -> None:
            rows = shown()
            if numbers and 0 <= numbers[0] < len(rows):
                show(rows[numbers[0]])
                self._update_text_soon()
            source.selected.indices = []

        source.selected.on_change("indices", tap)

    def _lay_out(self, sheets: list[Any]) -> LayoutDOM:
        text = self._text
        parts: list[LayoutDOM] = [text["head"]]
        if self._player is not None:
            *controls, slider = self._player.controls
            for control in self._player.controls:
                control.stylesheets = sheets
            marked = column(slider, text["marks"], sizing_mode="stretch_width")
            parts.append(row(*controls, marked, sizing_mode="stretch_width", css_classes=["ctrl"]))
        parts += [self._search, text["list"], text["why"], text["tool"], self._map.figure]
        parts += [self._timeline_plot.figure, text["nums"], self._grid, text["more"]]
        parts += [self._update_number, self._drawn, self._message, self._url]
        variables = " ".join(f"--{name}: {colour};" for name, colour in self._style.colours.items())
        css = f":root {{ {variables} }} html, body {{ margin: 0; background: var(--ground); }}"
        page: list[Any] = [GlobalInlineStyleSheet(css=css), read_asset("layout.css")]
        return column(*parts, sizing_mode="stretch_width", stylesheets=page)


def _query_of(document: Document) -> dict[str, str]:
    """Return the arguments of the URL with which a browser opened a document; none without a browser."""
    request = getattr(document.session_context, "request", None)
    if request is None:
        return {}
    query = {}
    for name, values in request.arguments.items():
        if values:
            query[name] = values[0].decode(errors="replace")[: limits.PEER_TEXT]
    return query
