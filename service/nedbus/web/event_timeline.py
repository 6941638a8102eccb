"""Event timeline of a page: events in chronological order, with their spans, stories and verdicts."""

import functools
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from nedbus import limits
from nedbus.clock import format_utc
from nedbus.health import Condition, Event, Span, Story, Times, Verdict
from nedbus.vehicle_events import EventLog, spans_of, stories_of, story_of, verdict_of

PAST: Final = 600.0  # seconds of history on a live page
_URL_RESOLUTION: Final = 0.1  # s; times in the URL are rounded to this
_VERDICT_AGE: Final = 1.0  # s of the timeline for which a verdict is kept


class _CachedVerdict(NamedTuple):
    """A verdict, and the end of the timeline for which it was found [s]."""

    verdict: Verdict
    end: float


class EventTimeline:
    """The events of an event log, and earlier events (`before`); derived values are cached until the next event.

    `clock_offset`: added to event times to get the time on the axes [s]; `unit`: the name of the axes' clock.
    """

    def __init__(
        self, event_log: EventLog, *, before: Sequence[Event] = (), times: Times | None = None
    ) -> None:
        self.event_log = event_log
        self.times = times or Times(is_live=True)
        self.clock_offset = 0.0
        self.unit = Times.unit("host" if self.times.is_live else "start")
        self._before = before
        self._reported = -1
        self._events: list[Event] = []
        self._spans: dict[str, list[Span]] = {}
        self._by_vehicle: dict[str, list[Event]] = {}
        # for all viewers
        cached = functools.lru_cache(limits.PAGE_STORIES)
        self._find_stories_cached = cached(self._find_stories)
        self._verdicts: dict[tuple[str, float | None], _CachedVerdict] = {}

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
        if utc is not None:
            self.clock_offset = utc - time
            self.unit = Times.unit("vehicle")
        elif len(self.event_log.vehicles) < 2:  # vehicles boot at different times
            self.clock_offset = boot - time
            self.unit = Times.unit("boot")

    def format_time(self, seconds: float) -> str:
        """Format an event time as on the time axes."""
        seconds += self.clock_offset
        if self.unit == "UTC":
            return format_utc(seconds)
        return f"{seconds:.1f}"

    def format_clock(self, seconds: float) -> str:
        """Format an event time with the name of its clock; for a recording, add the seconds since its start."""
        text = f"{self.format_time(seconds)} {self.unit}"
        if self.times.is_live or not self.clock_offset:
            return text
        return f"{text}, {seconds:.1f} {Times.unit('start')}"

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
            stories = [story for story in reversed(stories) if _is_recent(story, now)]
        if stories:
            return stories[0]
        return None

    def verdict(self, vehicle: str, end: float, at: float | None = None) -> Verdict:
        """Return the verdict on a time, by default on the whole recording or the ten minutes before `end`."""
        self._refresh()
        cached = self._verdicts.get((vehicle, at))
        if cached is not None and end - cached.end < _VERDICT_AGE:
            return cached.verdict
        begin = end - PAST
        events = self._by_vehicle.get(vehicle, [])
        events = events[-limits.PAGE_STORY_EVENTS :]
        if self.times.is_live:
            events = [event for event in events if event.time > begin]
        known = self.event_log.vehicles.get(vehicle)
        since = None
        if known is not None:
            since = max(known.first, begin)
        topics, held = self._evidence(vehicle)
        verdict = verdict_of(
            vehicle, events, held, topics=topics, times=self.times, end=end, at=at, since=since
        )
        self._verdicts[vehicle, at] = _CachedVerdict(verdict, end)
        if len(self._verdicts) > limits.PAGE_STORIES:
            oldest = next(iter(self._verdicts))
            del self._verdicts[oldest]
        return verdict

    @property
    def faults(self) -> Sequence[tuple[str, Story]]:
        """The vehicle and story of each fault, in chronological order."""
        self._refresh()
        faults = []
        for name in self._by_vehicle:
            for story in self._find_stories_cached(name, None):
                faults.append((name, story))
        faults.sort(key=lambda fault: fault[1].since)
        return faults

    def _find_stories(self, vehicle: str, at: Event | float | None) -> list[Story]:
        events = self._by_vehicle.get(vehicle, [])
        topics, held = self._evidence(vehicle)
        if isinstance(at, Event):
            story = story_of(at, events, held, topics=topics)
            if story is None:
                return []
            return [story]
        if at is None:
            moment = None
        else:
            moment = at + _URL_RESOLUTION
        latest = events[-limits.PAGE_STORY_EVENTS :]
        return stories_of(latest, held, topics=topics, at=moment)

    def _evidence(self, vehicle: str) -> tuple[list[str], list[Condition]]:
        """Return a vehicle's topics, and its conditions that began before the first event or are still active."""
        state = self.event_log.vehicles.get(vehicle)
        if state is None:
            return [], []
        return [*state.topics], state.held

    def _refresh(self) -> None:
        """Read new events, and drop what was derived from the events so far."""
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
        self._spans = {}
        for name, events in self._by_vehicle.items():
            initial: list[Condition] = []
            if name in vehicles:
                initial = list(vehicles[name].initial)
            self._spans[name] = spans_of(events, initial)


def _is_recent(story: Story, now: float) -> bool:
    """Return whether a story has begun, and ended less than PAST before `now`, if at all."""
    return story.since <= now and now - (story.until or now) < PAST
