"""The account of what happened: all vehicles, in the order of events, within bounds; no I/O."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Mapping
from typing import Final

from nedbus_msgs import Address

from .event import ALL, Condition, Event, Severity, State, state_of, to_age
from .vehicle import SILENT, Vehicle

KEPT: Final = 2000
"""Events that an account keeps."""

_MAX_VEHICLES: Final = 1000
_OVERLOADED: Final = 5.0  # s without a dropped message after which an overload is over
_NONE: Final[frozenset[str]] = frozenset()


class Account:
    """Follow vehicles; samples may come from another thread than looks and questions.

    `events`: the last ones, in the order in which they were told; `counts`: of all, by vehicle and severity.
    """

    def __init__(self, keep: int = KEPT) -> None:
        self.events: deque[Event] = deque(maxlen=keep)
        self.vehicles: dict[str, Vehicle] = {}
        self.counts: Counter[tuple[str, Severity]] = Counter()
        self.told = 0
        self.link: Condition | None = None
        self.overload: Condition | None = None
        self._dropped = 0
        self._overloaded = self._calm = self._looked = 0.0
        self._lock = threading.RLock()

    def add(
        self, address: Address, message: object, time: float, *, missing: frozenset[str] = _NONE, lost: int = 0
    ) -> None:
        """Add a message: a model, a row, or fields by name; `missing` fields were not provided."""
        with self._lock:
            vehicle = self._vehicle(address.vehicle)
            if vehicle is not None:
                vehicle.add(address, message, time, missing=missing, lost=lost)

    def reject(self, address: Address, reason: str, time: float) -> None:
        """Note a message that was rejected."""
        with self._lock:
            vehicle = self._vehicle(address.vehicle)
            if vehicle is not None:
                vehicle.reject(address.stream, reason, time)

    def look(
        self,
        time: float,
        states: Mapping[Address, str] | None = None,
        *,
        link: str = "",
        dropped: int = 0,
        is_behind: bool = False,
    ) -> None:
        """Note how streams arrive now.

        `states`: by address, "stale", "gone" or another; None where that is not known. `link`: "" or what is wrong with
        it. `dropped`: the messages that this reader has not read in time since it began; `is_behind`: many wait for it.
        What a reader has not read says nothing of its vehicles.
        """
        with self._lock:
            if time < self._looked:  # the clock was set back
                self._calm, self._overloaded = min(self._calm, time), min(self._overloaded, time)
            self._looked = time
            self._look_at_link(time, link)
            self._look_at_reader(time, dropped, is_behind=is_behind)
            if self.overload is not None:
                self._calm = time + SILENT  # what was held up needs a moment to arrive
            if time < self._calm:
                self.settle(time)
                return
            for vehicle in self.vehicles.values():
                state = None if states is None or vehicle.main is None else states.get(vehicle.main)
                if state is not None:
                    silent = {"stale": "silent", "gone": "gone"}.get(state)
                else:
                    silent = "silent" if self.link is None and vehicle.silence(time) > SILENT else None
                vehicle.look(time, silent=silent)

    def settle(self, time: float) -> None:
        """Tell what is over by this time, at the end of a file."""
        with self._lock:
            for vehicle in self.vehicles.values():
                vehicle.settle(time)

    def state(self, vehicle: str, time: float) -> State:
        """Return the state of a vehicle at this time, which is now."""
        with self._lock:
            known = self.vehicles.get(vehicle)
            return known.state(time) if known is not None else state_of(())

    def take(self, seen: int) -> tuple[list[Event], int]:
        """Return the events after the first `seen` ones, and how many there have been by now."""
        with self._lock:
            new = min(self.told - seen, len(self.events))
            return list(self.events)[len(self.events) - new :], self.told

    def _vehicle(self, name: str) -> Vehicle | None:
        known = self.vehicles.get(name)
        if known is None and len(self.vehicles) < _MAX_VEHICLES:
            known = self.vehicles[name] = Vehicle(name, self._keep, self._common)
        return known

    def _common(self) -> list[Condition]:
        """Return what holds for all vehicles."""
        return [each for each in (self.link, self.overload) if each is not None]

    def _tell_all(self, event: Event) -> None:
        self._keep(event)
        for vehicle in self.vehicles.values():
            vehicle.note(event)

    def _keep(self, event: Event) -> None:
        self.events.append(event)
        self.counts[event.vehicle, event.severity] += 1
        self.told += 1

    def _look_at_link(self, time: float, link: str) -> None:
        if link and self.link is None:
            event = Event(ALL, "link_down", "begin", "bad", link, time)
            self.link = Condition("link_down", "bad", link, time, event)
            self._tell_all(event)
        elif not link and self.link is not None:
            lasted = time - self.link.since
            text = f"link is back after {to_age(lasted)}"
            self._tell_all(Event(ALL, "link_down", "end", "info", text, time, lasted=lasted))
            self.link = None

    def _look_at_reader(self, time: float, dropped: int, *, is_behind: bool) -> None:
        if dropped > self._dropped or is_behind:
            self._overloaded = time
            if self.overload is None:
                text = "this reader is slower than the data: messages are not read"
                event = Event(ALL, "overload", "begin", "watch", text, time)
                self.overload = Condition("overload", "watch", text, time, event)
                self._tell_all(event)
        elif self.overload is not None and time - self._overloaded > _OVERLOADED:
            lasted = self._overloaded - self.overload.since
            text = f"this reader keeps up again: {dropped} messages were not read"
            numbers = {"messages": dropped}
            self._tell_all(Event(ALL, "overload", "end", "info", text, time, numbers=numbers, lasted=lasted))
            self.overload = None
        self._dropped = dropped
