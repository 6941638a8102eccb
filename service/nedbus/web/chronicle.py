"""The events of a page in the order of their time, and their spans, states, stories and times in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from nedbus.events import Account, Event, Span, State, Story, Times, about, spans_of, state_at, tell, to_clock

PAST: Final = 600.0
"""Seconds of what is over that a live page shows."""

_MAX_EVENTS: Final = 500  # of a vehicle, the last ones, that stories are told of
_TENTH: Final = 0.1  # s: an address names moments no more exactly


class Chronicle:
    """The account of a page, and the events `before` it; evaluated anew only when more has happened.

    `start`: the beginning of a recording, s since the epoch, where it is known.
    """

    def __init__(self, account: Account, *, before: Sequence[Event] = (), times: Times | None = None) -> None:
        self.account = account
        self.times = times or Times(is_live=True)
        self.start: float | None = None
        self._before = before
        self._told = -1
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
        """The spans of all conditions, by vehicle."""
        self._read()
        return self._spans

    def state(self, vehicle: str, time: float) -> State:
        """Return the state of a vehicle at a time."""
        return state_at(self.spans.get(vehicle, ()), time)

    @property
    def has_utc(self) -> bool:
        """True where its times are known in UTC."""
        return self.times.is_live or self.start is not None

    def moment(self, seconds: float) -> str:
        """Return a time of the account in words: in UTC, else minutes and seconds since the start."""
        return to_clock(seconds + (self.start or 0.0))[:-2] if self.has_utc else _elapsed(seconds)

    def clock(self, seconds: float) -> str:
        """Return a time of the account as the header has it: in UTC, and of a recording since its start."""
        utc = [f"{self.moment(seconds)} UTC"] if self.has_utc else []
        return ", ".join(utc if self.times.is_live else [*utc, _elapsed(seconds)])

    def story(self, vehicle: str, now: float, at: Event | float | None) -> Story | None:
        """Return the story of a condition that holds now or ended lately, or of a chosen event or time.

        `at`: the event or time that is chosen, None for now.
        """
        self._read()
        stories = self._tell(vehicle, at)
        if at is not None:
            return next(iter(stories), None)
        stories = [story for story in stories if story.since <= now]
        going = [story for story in stories if story.until is None or story.until > now]
        if going:
            return max(going, key=lambda story: story.is_bad)
        recent = [story for story in stories if (story.until or 0.0) > now - PAST]
        return recent[-1] if recent else None

    def _tell(self, vehicle: str, at: Event | float | None) -> list[Story]:
        """Return the stories of an event, a time, or all times; told once for all viewers until more happens."""
        if (vehicle, at) not in self._stories:
            known, events = self.account.vehicles.get(vehicle), self._by_vehicle.get(vehicle, [])
            topics, initial = ([], []) if known is None else (list(known.topics), list(known.initial))
            if isinstance(at, Event):
                story = about(at, events, topics=topics)
                self._stories[vehicle, at] = [] if story is None else [story]
            else:
                moment = None if at is None else at + _TENTH
                self._stories[vehicle, at] = tell(events[-_MAX_EVENTS:], initial, topics=topics, at=moment)
        return self._stories[vehicle, at]

    def _read(self) -> None:
        if self._told == self.account.told:
            return
        told, self._told = self.account.take(0)
        self._events = sorted([*self._before, *told], key=lambda event: event.time)
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
