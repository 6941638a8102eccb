"""The account of all vehicles: their events in order, within bounds; no I/O."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Mapping
from typing import Final

from nedbus_msgs import Address

from .detectors import Finding
from .event import ALL, Condition, Event, Severity, State, state_of
from .rules import MAX_SILENCE, PAUSE
from .vehicle import Vehicle

KEPT: Final = 2000
"""Events that an account keeps."""

_MAX_VEHICLES: Final = 1000
_NONE: Final[frozenset[str]] = frozenset()


class Account:
    """Follow vehicles; samples may come from another thread than looks and questions.

    `events`: the last ones, in the order of their reports; `told`: the number of all; `counts`: of all, by
    vehicle and severity.
    """

    def __init__(self, keep: int = KEPT) -> None:
        self.events: deque[Event] = deque(maxlen=keep)
        self.vehicles: dict[str, Vehicle] = {}
        self.counts: Counter[tuple[str, Severity]] = Counter()
        self.told = 0
        self._common = Vehicle(ALL, self._keep)  # the link, and the reader itself
        self._dropped = 0
        self._last_overload = self._settled = 0.0
        self._lock = threading.RLock()

    @property
    def overload(self) -> Condition | None:
        """The overload of this reader, while there is one."""
        return self._common.conditions.get(("overload", ""))

    def add(
        self, address: Address, message: object, time: float, *, missing: frozenset[str] = _NONE, lost: int = 0
    ) -> None:
        """Add a message: a model, a row, or fields by name; `missing` fields were not provided."""
        with self._lock:
            if vehicle := self._vehicle(address.vehicle):
                vehicle.add(address, message, time, missing=missing, lost=lost)

    def reject(self, address: Address, reason: str, time: float) -> None:
        """Add a message that was rejected."""
        with self._lock:
            if vehicle := self._vehicle(address.vehicle):
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
        """Update from the states of streams, the link and this reader.

        `states`: by address, "stale", "gone" or another; None where that is not known. `link`: "" or what is wrong with
        it. `dropped`: the messages that this reader has not read in time since it began; `is_behind`: many wait for it.
        What a reader has not read says nothing of its vehicles.
        """
        with self._lock:
            self._look_at_link(time, link)
            self._look_at_reader(time, dropped, is_behind=is_behind)
            if self.overload is not None:
                self._settled = time + MAX_SILENCE  # what was held up needs a moment to arrive
            if time < self._settled <= time + MAX_SILENCE:  # else the clock was set back
                self.settle(time)
                return
            self._common.settle(time)
            for vehicle in self.vehicles.values():
                state = None if states is None or vehicle.main is None else states.get(vehicle.main)
                vehicle.look(time, state, is_connected=not link)

    def settle(self, time: float) -> None:
        """Report all that is over by this time; called at the end of a file."""
        with self._lock:
            for vehicle in (self._common, *self.vehicles.values()):
                vehicle.settle(time)

    def state(self, vehicle: str, time: float) -> State:
        """Return the state of a vehicle at this time, which is now."""
        with self._lock:
            known = self.vehicles.get(vehicle)
            return known.state(time) if known is not None else state_of(())

    def take(self, seen: int) -> tuple[list[Event], int]:
        """Return the events after the first `seen` ones, and the number of all by now."""
        with self._lock:
            new = min(self.told - seen, len(self.events))
            return list(self.events)[len(self.events) - new :], self.told

    def _vehicle(self, name: str) -> Vehicle | None:
        known = self.vehicles.get(name)
        if known is None and len(self.vehicles) < _MAX_VEHICLES:
            known = self.vehicles[name] = Vehicle(name, self._keep, self._common)
        return known

    def _keep(self, event: Event) -> None:
        self.events.append(event)
        self.counts[event.vehicle, event.severity] += 1
        self.told += 1

    def _look_at_link(self, time: float, link: str) -> None:
        is_down = ("link_down", "") in self._common.conditions
        if link and not is_down:
            self._common.emit(Finding("link_down", "begin", "bad", link), "", time)
        elif is_down and not link:
            self._common.emit(Finding("link_down", "end", "info", "link is back"), "", time)

    def _look_at_reader(self, time: float, dropped: int, *, is_behind: bool) -> None:
        if dropped > self._dropped or is_behind:
            self._last_overload = time
            if self.overload is None:
                text = "this reader is slower than the data: messages are not read"
                self._common.emit(Finding("overload", "begin", "watch", text), "", time)
        elif self.overload is not None and not 0 <= time - self._last_overload <= PAUSE:
            text = f"{dropped} messages were not read: this reader keeps up again"
            ended = Finding("overload", "end", "info", text, numbers={"messages": dropped})
            self._common.emit(ended, "", time, changed=self._last_overload)
        self._dropped = dropped
