"""Events of a page in time order, with the spans, states and stories derived from them, and times as text."""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Final

from nedbus.events import (
    Condition,
    Event,
    EventLog,
    Span,
    Story,
    Times,
    Verdict,
    format_utc,
    spans_of,
    stories_of,
    story_of,
    unit_of,
    verdict_of,
)

PAST: Final = 600.0  # seconds of history on a live page
_MAX_EVENTS: Final = 500  # latest events of a vehicle used for its stories
_TENTH: Final = 0.1  # s; time resolution of the page's URL


class Chronicle:
    """The events of an event log and those `before` it; re-evaluated only after new events.

    `start`: what to add to times of the event log on an axis [s]; `unit`: the name of the clock that this gives.
    """

    def __init__(self, event_log: EventLog, *, before: Sequence[Event] = (), times: Times | None = None) -> None:
        self.event_log = event_log
        self.times = times or Times(is_live=True)
        self.start, self.unit = 0.0, unit_of("host" if self.times.is_live else "start")
        self._before = before
        self._taken = -1
        self._events: list[Event] = []
        self._spans: dict[str, list[Span]] = {}
        self._by_vehicle: dict[str, list[Event]] = {}
        self._tell = functools.cache(self._find_stories)  # for all viewers, until the next event
        self._verdicts: dict[tuple[str, float | None], tuple[float, Verdict]] = {}

    @property
    def events(self) -> Sequence[Event]:
        """All events so far."""
        self._read()
        return self._events

    @property
    def spans(self) -> Mapping[str, Sequence[Span]]:
        """Spans of all conditions, by vehicle."""
        self._read()
        return self._spans

    def set_start(self, vehicle: str, boot: float, time: float) -> None:
        """Set the clock of the axis in a recording, from a message `boot` seconds after a vehicle's boot."""
        utc = self.times.utc_of_boot(vehicle, boot)
        if utc is not None or len(self.event_log.vehicles) < 2:  # vehicles boot at different times
            self.start, self.unit = (boot if utc is None else utc) - time, unit_of("boot" if utc is None else "vehicle")

    def moment(self, seconds: float) -> str:
        """Format a time of the event log by the clock of the axis."""
        return format_utc(seconds + self.start) if self.unit == "UTC" else f"{seconds + self.start:.1f}"

    def clock(self, seconds: float) -> str:
        """Format a time of the event log with the name of its clock and, in a recording, since the start."""
        since = "" if self.times.is_live or not self.start else f", {seconds:.1f} {unit_of('start')}"
        return f"{self.moment(seconds)} {self.unit}{since}"

    def story(self, vehicle: str, now: float, at: Event | float | None, held: Sequence[Condition]) -> Story | None:
        """Return the story of the selected event or time; for now, that of the current state or a recent condition.

        `at`: the selected event or time, None for now. `held`: the conditions of the current state.
        """
        self._read()
        if at is None and held:  # the condition that gives the state its text
            at = held[0].begin
        stories = self._tell(vehicle, at)
        if at is None:
            stories = [story for story in stories if story.since <= now and now - (story.until or now) < PAST][::-1]
        return next(iter(stories), None)

    def verdict(self, vehicle: str, end: float, at: float | None = None) -> Verdict:
        """Return the verdict at a time, or on all of a recording or the last ten minutes; `end` is its end, or now."""
        self._read()
        made, verdict = self._verdicts.get((vehicle, at), (-math.inf, None))
        if verdict is None or end - made >= 1.0:
            events, (topics, held) = self._by_vehicle.get(vehicle, [])[-_MAX_EVENTS:], self._known(vehicle)
            events = [event for event in events if event.time > end - PAST or not self.times.is_live]
            verdict = verdict_of(vehicle, events, held, topics=topics, times=self.times, end=end, at=at)
            self._verdicts[vehicle, at] = end, verdict
        return verdict

    @property
    def faults(self) -> Sequence[tuple[str, Story]]:
        """The stories of all vehicles, in order of time."""
        self._read()
        stories = [(name, story) for name in self._by_vehicle for story in self._tell(name, None)]
        return sorted(stories, key=lambda each: each[1].since)

    def _find_stories(self, vehicle: str, at: Event | float | None) -> list[Story]:
        events, (topics, held) = self._by_vehicle.get(vehicle, []), self._known(vehicle)
        if isinstance(at, Event):
            story = story_of(at, events, held, topics=topics)
            return [] if story is None else [story]
        moment = None if at is None else at + _TENTH
        return stories_of(events[-_MAX_EVENTS:], held, topics=topics, at=moment)

    def _known(self, vehicle: str) -> tuple[list[str], list[Condition]]:
        """Return the topics of a vehicle, and the conditions that began before the first event or are still active."""
        known = self.event_log.vehicles.get(vehicle)
        return ([], []) if known is None else ([*known.topics], [*known.initial, *known.conditions.values()])

    def _read(self) -> None:
        if self._taken == self.event_log.reported:
            return
        events, self._taken = self.event_log.events_since(0)
        self._events = sorted([*self._before, *events], key=lambda event: event.time)
        self._tell.cache_clear()
        self._verdicts.clear()
        vehicles = dict(self.event_log.vehicles)
        self._by_vehicle = {name: [] for name in vehicles}
        for event in self._events:
            self._by_vehicle.setdefault(event.vehicle, []).append(event)
        self._spans = {
            name: spans_of(events, list(vehicles[name].initial) if name in vehicles else ())
            for name, events in self._by_vehicle.items()
        }
