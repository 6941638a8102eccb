"""Event timeline of a page: events in chronological order, with their spans, stories and verdicts."""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Final

from nedbus.clock import format_utc
from nedbus.health import Condition, Event, Span, Story, Times, Verdict
from nedbus.vehicle_events import EventLog, spans_of, stories_of, story_of, verdict_of

PAST: Final = 600.0  # seconds of history on a live page
_MAX_EVENTS: Final = 500  # latest events of a vehicle used for its stories
# stories and verdicts; more than the vehicles of an event log, which `faults` looks up
_MAX_CACHED: Final = 2000
_URL_RESOLUTION: Final = 0.1  # s; times in the URL are rounded to this


class EventTimeline:
    """The events of an event log, and earlier events (`before`); derived values are cached until the next event.

    `clock_offset`: added to event times to get the time on the axes [s]; `unit`: the name of the axes' clock.
    """

    def __init__(
        self, event_log: EventLog, *, before: Sequence[Event] = (), times: Times | None = None
    ) -> None:
        self.event_log = event_log
        self.times = times or Times(is_live=True)
        self.clock_offset, self.unit = 0.0, Times.unit("host" if self.times.is_live else "start")
        self._before = before
        self._reported = -1
        self._events: list[Event] = []
        self._spans: dict[str, list[Span]] = {}
        self._by_vehicle: dict[str, list[Event]] = {}
        # for all viewers
        self._find_stories_cached = functools.lru_cache(_MAX_CACHED)(self._find_stories)
        self._verdicts: dict[tuple[str, float | None], tuple[float, Verdict]] = {}

    @property
    def events(self) -> Sequence[Event]:
        """All events so far."""
        self._refresh()
        return self._events

    @property
    def spans(self) -> Mapping[str, Sequence[Span]]:
        """The spans of all conditions, by vehicle."""
        self._refresh()
        return self._spans

    def set_clock(self, vehicle: str, boot: float, time: float) -> None:
        """Set the clock of a recording's time axes, given a message received at `time`, `boot` seconds after boot."""
        utc = self.times.utc_of_boot(vehicle, boot)
        if utc is not None or len(self.event_log.vehicles) < 2:  # vehicles boot at different times
            self.clock_offset = (boot if utc is None else utc) - time
            self.unit = Times.unit("boot" if utc is None else "vehicle")

    def format_time(self, seconds: float) -> str:
        """Format an event time as on the time axes."""
        seconds += self.clock_offset
        return format_utc(seconds) if self.unit == "UTC" else f"{seconds:.1f}"

    def format_clock(self, seconds: float) -> str:
        """Format an event time with the name of its clock; for a recording, add the seconds since its start."""
        since = (
            ""
            if self.times.is_live or not self.clock_offset
            else f", {seconds:.1f} {Times.unit('start')}"
        )
        return f"{self.format_time(seconds)} {self.unit}{since}"

    def story(
        self, vehicle: str, now: float, at: Event | float | None, active: Sequence[Condition]
    ) -> Story | None:
        """Return the story of the event or time `at`; if None, of the current state or the latest recent condition.

        `active`: the active conditions; the first determines the state.
        """
        self._refresh()
        if at is None and active:
            at = active[0].begin
        stories = self._find_stories_cached(vehicle, at)
        if at is None:
            stories = [
                story
                for story in stories
                if story.since <= now and now - (story.until or now) < PAST
            ][::-1]
        return next(iter(stories), None)

    def verdict(self, vehicle: str, end: float, at: float | None = None) -> Verdict:
        """Return the verdict on a time, by default on the whole recording or the ten minutes before `end`."""
        self._refresh()
        computed, verdict = self._verdicts.get((vehicle, at), (-math.inf, None))
        if verdict is None or end - computed >= 1.0:
            events = self._by_vehicle.get(vehicle, [])[-_MAX_EVENTS:]
            (topics, held) = self._evidence(vehicle)
            events = [
                event for event in events if event.time > end - PAST or not self.times.is_live
            ]
            known = self.event_log.vehicles.get(vehicle)
            since = max(known.first, end - PAST) if known is not None else None
            verdict = verdict_of(
                vehicle, events, held, topics=topics, times=self.times, end=end, at=at, since=since
            )
            self._verdicts[vehicle, at] = end, verdict
            if len(self._verdicts) > _MAX_CACHED:
                del self._verdicts[next(iter(self._verdicts))]
        return verdict

    @property
    def faults(self) -> Sequence[tuple[str, Story]]:
        """The vehicle and story of each fault, in chronological order."""
        self._refresh()
        stories = [
            (name, story)
            for name in self._by_vehicle
            for story in self._find_stories_cached(name, None)
        ]
        return sorted(stories, key=lambda each: each[1].since)

    def _find_stories(self, vehicle: str, at: Event | float | None) -> list[Story]:
        events, (topics, held) = self._by_vehicle.get(vehicle, []), self._evidence(vehicle)
        if isinstance(at, Event):
            story = story_of(at, events, held, topics=topics)
            return [] if story is None else [story]
        moment = None if at is None else at + _URL_RESOLUTION
        return stories_of(events[-_MAX_EVENTS:], held, topics=topics, at=moment)

    def _evidence(self, vehicle: str) -> tuple[list[str], list[Condition]]:
        """Return a vehicle's topics, and its conditions that began before the first event or are still active."""
        state = self.event_log.vehicles.get(vehicle)
        return ([], []) if state is None else ([*state.topics], state.held)

    def _refresh(self) -> None:
        if self._reported == self.event_log.reported:
            return
        events, self._reported = self.event_log.events_since(0)
        self._events = sorted([*self._before, *events], key=lambda event: event.time)
        self._find_stories_cached.cache_clear()
        self._verdicts.clear()
        vehicles = dict(self.event_log.vehicles)
        self._by_vehicle = {name: [] for name in vehicles}
        for event in self._events:
            self._by_vehicle.setdefault(event.vehicle, []).append(event)
        self._spans = {
            name: spans_of(events, list(vehicles[name].initial) if name in vehicles else ())
            for name, events in self._by_vehicle.items()
        }
