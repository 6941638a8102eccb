"""Events of a page in time order, with the spans, states and stories derived from them, and times as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from nedbus.events import (
    Account,
    Condition,
    Event,
    Span,
    State,
    Story,
    Times,
    spans_of,
    state_at,
    stories_of,
    story_of,
    to_clock,
)

PAST: Final = 600.0
"""Seconds of history on a live page."""

_MAX_EVENTS: Final = 500  # latest events of a vehicle used for its stories
_TENTH: Final = 0.1  # s; time resolution of the page's URL


class Chronicle:
    """The events of an account and those `before` it; re-evaluated only after new events.

    `start`: Unix time of a recording's start, or what to add to the times of live events [s]; None if unknown.
    """

    def __init__(self, account: Account, *, before: Sequence[Event] = (), times: Times | None = None) -> None:
        self.account = account
        self.times = times or Times(is_live=True)
        self.start: float | None = None
        self._before = before
        self._taken = -1
        self._events: list[Event] = []
        self._spans: dict[str, list[Span]] = {}
        self._by_vehicle: dict[str, list[Event]] = {}
        self._stories: dict[tuple[str, Event | float | None], list[Story]] = {}

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

    def state(self, vehicle: str, time: float) -> State:
        """Return the state of a vehicle at a time."""
        return state_at(self.spans.get(vehicle, ()), time)

    @property
    def has_utc(self) -> bool:
        """True if times are available in UTC."""
        return self.times.is_live or self.start is not None

    def moment(self, seconds: float) -> str:
        """Format a time of the account in UTC, or as minutes and seconds since the start if UTC is unknown."""
        return to_clock(seconds + (self.start or 0.0))[:-2] if self.has_utc else _elapsed(seconds)

    def clock(self, seconds: float) -> str:
        """Format a time of the account for the header: in UTC and, for a recording, since its start."""
        parts = [f"{self.moment(seconds)} UTC"] if self.has_utc else []
        if not self.times.is_live:
            parts.append(_elapsed(seconds))
        return ", ".join(parts)

    def story(self, vehicle: str, now: float, at: Event | float | None, held: Sequence[Condition]) -> Story | None:
        """Return the story of the selected event or time; for now, that of the current state or a recent condition.

        `at`: the selected event or time, None for now. `held`: the conditions of the current state.
        """
        self._read()
        if at is None and held:  # the condition that gives the state its text
            begin = held[0].begin.identity
            at = next((event for event in self._by_vehicle.get(vehicle, ()) if event.identity == begin), None)
        stories = self._tell(vehicle, at)
        if at is not None:
            return next(iter(stories), None)
        stories = [story for story in stories if story.since <= now]
        going = [story for story in stories if story.until is None or story.until > now]
        fitting = [story for story in going if held and held[0].text in story.what]
        recent = [story for story in stories if story not in going and (story.until or 0.0) > now - PAST]
        return next(iter([*fitting, *going, *reversed(recent)]), None)

    def _tell(self, vehicle: str, at: Event | float | None) -> list[Story]:
        """Return the stories of an event, a time, or all times; cached for all viewers until the next event."""
        if (vehicle, at) not in self._stories:
            known, events = self.account.vehicles.get(vehicle), self._by_vehicle.get(vehicle, [])
            topics, initial = ([], []) if known is None else (list(known.topics), list(known.initial))
            if isinstance(at, Event):
                story = story_of(at, events, topics=topics)
                self._stories[vehicle, at] = [] if story is None else [story]
            else:
                moment = None if at is None else at + _TENTH
                self._stories[vehicle, at] = stories_of(events[-_MAX_EVENTS:], initial, topics=topics, at=moment)
        return self._stories[vehicle, at]

    def _read(self) -> None:
        if self._taken == self.account.reported:
            return
        events, self._taken = self.account.events_since(0)
        self._events = sorted([*self._before, *events], key=lambda event: event.time)
        self._stories.clear()
        vehicles = dict(self.account.vehicles)
        self._by_vehicle = {name: [] for name in vehicles}
        for event in self._events:
            self._by_vehicle.setdefault(event.vehicle, []).append(event)
        self._spans = {
            name: spans_of(events, list(vehicles[name].initial) if name in vehicles else ())
            for name, events in self._by_vehicle.items()
        }


def _elapsed(seconds: float) -> str:
    tenths = round(seconds * 10)
    return f"{tenths // 600}:{tenths % 600 / 10:04.1f}"
