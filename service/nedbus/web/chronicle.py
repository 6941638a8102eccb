"""What happened, as a page tells it: events in the order of their time, what held until when, and the answer to why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from nedbus.events import Account, Event, Span, State, Story, Times, about, spans_of, state_at, tell, to_clock

PAST: Final = 600.0
"""Seconds of what is over that a live page shows."""

_MOST: Final = 500  # events of a vehicle, the last ones, that stories are told of
_TENTH: Final = 0.1  # s: an address names moments no more exactly


class Chronicle:
    """The account of a page, and what others remember of the time `before`; read anew only when more has happened.

    `times`: how times are told; `start`: when a recording began, s since the epoch, where that is known.
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
        self._stories: dict[tuple[str, object], list[Story]] = {}

    @property
    def events(self) -> Sequence[Event]:
        """What happened so far."""
        self._read()
        return self._events

    @property
    def spans(self) -> Mapping[str, Sequence[Span]]:
        """What held from when to when, by vehicle."""
        self._read()
        return self._spans

    def moment(self, seconds: float) -> str:
        """Return a time of the account in words: UTC live or where a recording tells it, else since its start."""
        if self.times.is_live or self.start is not None:
            return to_clock(seconds + (self.start or 0.0))[:-2]
        return to_elapsed(seconds)

    def story(self, vehicle: str, now: float, *, pinned: float | None, event: Event | None) -> Story | None:
        """Return what is wrong with a vehicle now, or was in the last minutes, or what a chosen moment is about.

        `pinned`: a moment that is chosen; `event`: the event that was.
        """
        self._read()
        if event is not None and event.vehicle == vehicle:
            key: tuple[str, object] = vehicle, event
            if key not in self._stories:
                story = about(event, self._by_vehicle.get(vehicle, ()), topics=self.topics(vehicle))
                self._stories[key] = [] if story is None else [story]
            return next(iter(self._stories[key]), None)
        if pinned is not None:
            return next(iter(self._tell(vehicle, pinned + _TENTH)), None)
        stories = [story for story in self._tell(vehicle, None) if story.since <= now]
        going = [story for story in stories if story.until is None or story.until > now]
        if going:
            return max(going, key=lambda story: story.is_bad)
        recent = [story for story in stories if (story.until or 0.0) > now - PAST]
        return recent[-1] if recent else None

    def state(self, vehicle: str, time: float) -> State:
        """Return the state of a vehicle at a time."""
        return state_at(self.spans.get(vehicle, ()), time)

    def topics(self, vehicle: str) -> list[str]:
        """Return the topics of the messages that a vehicle sends."""
        known = self.account.vehicles.get(vehicle)
        return list(known.messages.values()) if known is not None else []

    def _tell(self, vehicle: str, at: float | None) -> list[Story]:
        """Return its stories, told once for as long as nothing more happens: all viewers ask for them."""
        if (vehicle, at) not in self._stories:
            known = self.account.vehicles.get(vehicle)
            events = self._by_vehicle.get(vehicle, [])[-_MOST:]
            initial = list(known.initial) if known is not None else []
            self._stories[vehicle, at] = tell(events, initial, topics=self.topics(vehicle), at=at)
        return self._stories[vehicle, at]

    def _read(self) -> None:
        if self._told == self.account.told:
            return
        told, self._told = self.account.take(0)
        self._events = sorted([*self._before, *told], key=lambda event: event.time)
        self._stories.clear()
        by_vehicle = self._by_vehicle = {name: [] for name in list(self.account.vehicles)}
        for event in self._events:
            by_vehicle.setdefault(event.vehicle, []).append(event)
        vehicles = self.account.vehicles
        initial = {name: list(vehicle.initial) for name, vehicle in list(vehicles.items())}
        self._spans = {name: spans_of(events, initial.get(name, ())) for name, events in by_vehicle.items()}


def to_elapsed(seconds: float) -> str:
    """Return the minutes and seconds since the start of a recording."""
    tenths = round(seconds * 10)
    return f"{tenths // 600}:{tenths % 600 / 10:04.1f}"
