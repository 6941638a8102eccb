"""The bounded event history and current conditions of all vehicles; no I/O."""

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
"""Maximum number of events in an account; older ones are discarded."""

_MAX_VEHICLES: Final = 1000
_NONE: Final[frozenset[str]] = frozenset()


class Account:
    """The events of all vehicles. Thread-safe: one thread may add samples while others update and read.

    All times are of one clock that is never set, or of a file: a step would end or hide conditions.

    `events`: the most recent events, in the order they were reported. `reported`: the total number of events.
    `counts`: the number of events by vehicle and severity.
    """

    def __init__(self, keep: int = KEPT) -> None:
        self.events: deque[Event] = deque(maxlen=keep)
        self.vehicles: dict[str, Vehicle] = {}
        self.counts: Counter[tuple[str, Severity]] = Counter()
        self.reported = 0
        self._common = Vehicle(ALL, self._record)  # the link, and the reader itself
        self._dropped = 0
        self._last_overload = self._settled = 0.0
        self._lock = threading.RLock()

    @property
    def overload(self) -> Condition | None:
        """The overload condition of this reader, None if it keeps up."""
        return self._common.conditions.get(("overload", ""))

    def add(
        self, address: Address, message: object, time: float, *, missing: frozenset[str] = _NONE, lost: int = 0
    ) -> None:
        """Add a message: a model, a row, or a dict of fields.

        `missing`: names of fields that were not provided. `lost`: messages lost before this one.
        """
        with self._lock:
            if vehicle := self._vehicle(address.vehicle):
                vehicle.add(address, message, time, missing=missing, lost=lost)

    def add_dropout(self, vehicle: str, seconds: float, time: float) -> None:
        """Record that the logger of a vehicle recorded nothing for some seconds from `time` on."""
        with self._lock:
            if known := self._vehicle(vehicle):
                known.add_dropout(seconds, time)

    def reject(self, address: Address, reason: str, time: float) -> None:
        """Record a rejected message."""
        with self._lock:
            if vehicle := self._vehicle(address.vehicle):
                vehicle.reject(address.stream, reason, time)

    def update(
        self,
        time: float,
        states: Mapping[Address, str] | None = None,
        *,
        link: str = "",
        dropped: int = 0,
        is_behind: bool = False,
    ) -> None:
        """Update the conditions of the link, of this reader, and of all vehicles.

        `states`: stream states by address ("stale", "gone", "duplicate" or another), None if unknown.
        `link`: the fault of the link, "" if it is up. `dropped`: messages dropped by this reader since it started.
        `is_behind`: it has a backlog.
        An overloaded reader reports no silent vehicles: their messages may be in its backlog.
        """
        with self._lock:
            self._update_link(time, link)
            self._update_reader(time, dropped, is_behind=is_behind)
            if self.overload is not None:
                self._settled = time + MAX_SILENCE  # delayed messages need time to arrive
            if time < self._settled:
                self.settle(time)
                return
            self._common.settle(time)
            for vehicle in self.vehicles.values():
                state = None if states is None or vehicle.main is None else states.get(vehicle.main)
                vehicle.update(time, state, is_connected=not link)

    def settle(self, time: float) -> None:
        """Report bursts of losses and rejections, and flapping, that have ended; call it at the end of a file."""
        with self._lock:
            for vehicle in (self._common, *self.vehicles.values()):
                vehicle.settle(time)

    def state(self, vehicle: str, time: float) -> State:
        """Return the current state of a vehicle; `time` is now."""
        with self._lock:
            known = self.vehicles.get(vehicle)
            return known.state(time) if known is not None else state_of(())

    def events_since(self, seen: int) -> tuple[list[Event], int]:
        """Return the events after the first `seen` ones that are still kept, and the total number of events."""
        with self._lock:
            new = min(self.reported - seen, len(self.events))
            return list(self.events)[len(self.events) - new :], self.reported

    def _vehicle(self, name: str) -> Vehicle | None:
        known = self.vehicles.get(name)
        if known is None and len(self.vehicles) < _MAX_VEHICLES:
            known = self.vehicles[name] = Vehicle(name, self._record, self._common)
        return known

    def _record(self, event: Event) -> None:
        self.events.append(event)
        self.counts[event.vehicle, event.severity] += 1
        self.reported += 1

    def _update_link(self, time: float, link: str) -> None:
        is_down = ("link_down", "") in self._common.conditions
        if link and not is_down:
            self._common.emit(Finding("link_down", "begin", "bad", link), "", time)
        elif is_down and not link:
            self._common.emit(Finding("link_down", "end", "info", "link is back"), "", time)

    def _update_reader(self, time: float, dropped: int, *, is_behind: bool) -> None:
        if dropped > self._dropped or is_behind:
            self._last_overload = time
            if self.overload is None:
                text = "the reader is slower than the data: messages are dropped"
                self._common.emit(Finding("overload", "begin", "watch", text), "", time)
        elif self.overload is not None and time - self._last_overload > PAUSE:
            text = f"the reader keeps up again: {dropped} messages were dropped"
            ended = Finding("overload", "end", "info", text, numbers={"messages": dropped})
            self._common.emit(ended, "", time, changed=self._last_overload)
        self._dropped = dropped
