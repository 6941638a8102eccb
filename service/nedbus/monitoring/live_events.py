"""Events of live vehicles as they happen, with the losses that services report on the links of vehicles."""

from __future__ import annotations

import time
from collections import deque
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from typing import Any, Final, Self

from nedbus import Bus, Sample, Subscription, clock
from nedbus.errors import NoDataError
from nedbus.health import AccountReport, Event, Times
from nedbus.vehicle_events import ALL, once_per_service
from nedbus_msgs import Selection

from .observer import Observer

_POLL_INTERVAL: Final = 0.5  # s
_LOSS_KINDS: Final = frozenset({"lost", "dropout"})
_LOSS_QUERY: Final = 5.0  # s between queries of the services for losses
_LOSS_TIMEOUT: Final = 1.0  # s
_LOSS_WINDOW: Final = 60.0  # s; a loss is reported up to 25 s after it began
_LOSS_MEMORY: Final = 2 * _LOSS_WINDOW  # s; later, no service reports an event again


class LiveEvents(AbstractContextManager["LiveEvents"]):
    """Events of live vehicles as they happen; `nedbus.events(bus)` returns one. Iterate over it until it is closed.

    `event.time` is Unix time by this host's clock [s]. Events of the router link and of this reader have the vehicle
    "*". A program with its own loop passes each sample of `subscription` to `add`, and calls `poll` once a second.
    """

    def __init__(self, bus: Bus, selection: Selection, within: float | None) -> None:
        self._selection = selection
        self._history = list[Event]()
        if within is not None:
            self._history = self._past(bus.accounts(within=within))
        self._observer = Observer(bus, selection)
        self._seen = 0  # events of the observer's log that `poll` has returned
        self._losses = LinkLosses(bus)
        self._waiting = deque[Event]()  # of the last poll, for the iterator
        self._next_poll = 0.0

    @property
    def times(self) -> Times:
        """The conversion of event times to UTC."""
        return Times(is_live=True)

    @property
    def subscription(self) -> Subscription[Any]:
        """The subscription to all topics of the selected vehicles, in mode "every"."""
        return self._observer.subscription

    @property
    def from_start(self) -> dict[str, str]:
        """By vehicle whose position is known, the conditions that are active since its first message, as text."""
        vehicles = list(self._observer.event_log.vehicles.items())
        return {
            name: vehicle.held_from_start for name, vehicle in vehicles if vehicle.main is not None
        }

    def add(self, sample: Sample[Any]) -> None:
        """Add a sample of `subscription`."""
        self._observer.add(sample)

    def poll(self) -> list[Event]:
        """Check for silence, losses and the link, and return the events since the last call, in order.

        The first call also returns the past events of `within` seconds. Queries the services every 5 s.
        """
        events = self._history
        self._history = []
        self._observer.poll()
        new, self._seen = self._observer.event_log.events_since(self._seen)
        to_utc = clock.to_utc()
        events += [event.later(to_utc) for event in new]
        events += self._losses.poll()
        return [event for event in events if self._is_selected(event)]

    def close(self) -> None:
        """End the subscription; a second call does nothing."""
        self.subscription.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Event:
        while not self._waiting:
            if self.subscription.closed:
                raise StopIteration
            now = time.monotonic()
            if now >= self._next_poll:
                self._next_poll = now + _POLL_INTERVAL
                self._waiting.extend(self.poll())
                continue
            with suppress(NoDataError):
                self.add(self.subscription.receive(self._next_poll - now))
        return self._waiting.popleft()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _is_selected(self, event: Event) -> bool:
        return event.vehicle == ALL or self._selection.matches_vehicle(event.vehicle)

    def _past(self, reports: list[AccountReport]) -> list[Event]:
        """Return the events in reports about selected vehicles, those of a service once."""
        selected = list[AccountReport]()
        for report in reports:
            is_selected = any(map(self._selection.matches_vehicle, report.vehicles))
            if is_selected or not report.vehicles:
                selected.append(report)
        return [event for _, event in once_per_service(selected)]


class LinkLosses:
    """Losses on the links of vehicles and logging dropouts: only the services that receive the vehicles know them."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._shown: dict[tuple[object, ...], float] = {}  # monotonic time of each event [s]
        self._next_query = 0.0
        self.poll()  # earlier ones are in the history

    def poll(self) -> list[Event]:
        """Return what the services have reported since the last call; ask them at most every 5 s."""
        now = time.monotonic()
        if now < self._next_query:
            return []
        self._next_query = now + _LOSS_QUERY
        self._shown = {
            key: shown for key, shown in self._shown.items() if now - shown < _LOSS_MEMORY
        }
        new = list[Event]()
        for report in self._bus.accounts(within=_LOSS_WINDOW, timeout=_LOSS_TIMEOUT):
            for event in report.events:
                key = (report.service, event.vehicle, *event.identity)
                if event.kind in _LOSS_KINDS and key not in self._shown:
                    self._shown[key] = now
                    new.append(_on_link(event, report.service))
        return sorted(new, key=lambda event: event.time)


def _on_link(event: Event, service: str) -> Event:
    if event.kind == "dropout":  # of the vehicle's logger
        return event
    return replace(event, text=f"{event.text}, on the link to the service {service}")
