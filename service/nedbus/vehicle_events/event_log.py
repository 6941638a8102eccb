"""Bounded event log of all vehicles and their current conditions; no I/O."""

import logging
import threading
from collections import Counter, defaultdict, deque
from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from itertools import takewhile

from nedbus import limits
from nedbus.log_event import about
from nedbus.timings import TIMINGS
from nedbus_msgs import Address

from .conditions import Conditions
from .detectors import Finding
from .event import ALL, AUTHORS, Condition, Event, State, state_of
from .kinds import SEVERITIES, Severity
from .rules import PAUSE, RECENT, SILENCE
from .vehicle import Vehicle

_log = logging.getLogger(__name__)


class EventLog:
    """Events of all vehicles. Thread-safe: one thread may add samples while others update and read.

    All times come from one monotonic clock or one file, because a clock step would end or hide conditions.

    `reader`: what may be overloaded, as its events name it: a reader, or a service.
    `reported`: total number of events. `counts`: number of events by vehicle (until forgotten) and severity.
    `refused`: number of messages from vehicles beyond `limits.VEHICLES`.
    """

    def __init__(self, keep: int = limits.EVENTS, *, reader: str = "reader") -> None:
        self._events: dict[int, Event] = {}  # by number
        self.vehicles: dict[str, Vehicle] = {}
        self.counts: Counter[tuple[str, Severity]] = Counter()
        self.reported = 0
        self.refused = 0
        self._keep = keep
        self._reader = reader
        self._numbers: defaultdict[str, deque[int]] = defaultdict(deque)  # event numbers by vehicle
        self._common = Conditions(ALL, self._record)  # conditions of the link and the reader
        self._dropped = 0
        self._most_present = 0
        self._last_overload = 0.0
        self._settled = 0.0
        self._full_until = 0.0
        self._lock = threading.RLock()

    @property
    def events(self) -> list[Event]:
        """The retained events, in the order in which they were reported."""
        events, _ = self.events_since(0)
        return events

    @property
    def is_full(self) -> bool:
        """True if new vehicles are ignored."""
        return len(self.vehicles) >= limits.VEHICLES

    @property
    def overload(self) -> Condition | None:
        """Overload condition of this reader, None if it keeps up."""
        return self._common.conditions.get(("overload", ""))

    def add(
        self,
        address: Address,
        message: object,
        time: float,
        *,
        missing: frozenset[str] = frozenset(),
        lost: int = 0,
        is_estimate: bool = False,
        source: str | None = None,
    ) -> None:
        """Add a message: a model, a row, or a dict of fields.

        `missing`: names of fields that were not provided. `lost`: messages lost before this one; with `is_estimate`
        about as many, of any topic, as in the vehicle's ULog stream. `source`: its source, which names the author of a
        log message that is not of PX4.
        """
        vehicle = self.vehicles.get(address.vehicle)
        # most messages; needs no lock
        if vehicle is not None and not lost and vehicle.skips(address, time):
            return
        with self._lock:
            vehicle = self._vehicle(address.vehicle, time)
            if vehicle is None:
                return
            if lost:
                vehicle.count_lost(lost, "" if is_estimate else address.stream, time)
            vehicle.author = AUTHORS.get(source, vehicle.author)
            vehicle.add(address, message, time, missing)

    def add_dropout(self, vehicle: str, seconds: float, time: float) -> None:
        """Record a logging dropout of a vehicle that starts at `time`."""
        with self._lock:
            known = self._vehicle(vehicle, time)
            if known is not None:
                known.add_dropout(seconds, time)

    def reject(self, address: Address, reason: str, time: float) -> None:
        """Record a rejected message."""
        with self._lock:
            vehicle = self._vehicle(address.vehicle, time)
            if vehicle is not None:
                vehicle.reject(address.stream, reason, time)

    def update(
        self,
        time: float,
        states: Mapping[Address, str] | None = None,
        *,
        link: str = "",
        dropped: int = 0,
        is_behind: bool = False,
        present: Collection[str] | None = None,
    ) -> None:
        """Update the conditions of the link, of this reader, and of all vehicles.

        `states`: states of position streams by address ("stale", "gone", "duplicate", ...); None if not observed.
        `link`: fault of the router link, "" if it is up. `dropped`: messages dropped by this reader since it started.
        `is_behind`: the reader has a backlog. `present`: vehicles with a publisher. Others are forgotten after an hour
        of silence with the link up, or earlier beyond `limits.GONE_VEHICLES`. If None, no vehicle is forgotten.
        An overloaded reader reports no silent vehicles, because their messages may be in its backlog.
        """
        with self._lock:
            self._update_link(link, time)
            self._update_overload(dropped, time, is_behind=is_behind)
            if present is not None:
                # without a link, no vehicle counts as gone
                self._see(self.vehicles if link else present, time)
                self._most_present = max(self._most_present, len(present))
                self._forget_gone(time)
            if self.overload is not None:
                self._settled = time + SILENCE  # delayed messages need time to arrive
            if time < self._settled:
                self.settle(time)
                return
            self._common.settle(time)
            for vehicle in self.vehicles.values():
                state = None
                if states is not None and vehicle.main is not None:
                    state = states.get(vehicle.main)
                vehicle.update(time, state, is_connected=not link)

    def _update_link(self, fault: str, time: float) -> None:
        if fault:
            finding = Finding("link_down", "begin", fault, switch=True)
        else:
            finding = Finding("link_down", "end", "link restored", switch=True)
        self._common.emit(finding, "", time)

    def _update_overload(self, dropped: int, time: float, *, is_behind: bool) -> None:
        if dropped > self._dropped or is_behind:
            self._last_overload = time
            text = f"{self._reader} overloaded: messages are delayed or dropped"
            self._common.emit(Finding("overload", "begin", text, switch=True), "", time)
        elif time - self._last_overload > PAUSE:
            text = f"messages dropped so far: {dropped}; {self._reader} caught up"
            ended = Finding("overload", "end", text, numbers={"messages": dropped}, switch=True)
            self._common.emit(ended, "", time, changed=self._last_overload)
        self._dropped = dropped

    def _see(self, names: Iterable[str], time: float) -> None:
        for name in names:
            vehicle = self.vehicles.get(name)
            if vehicle is not None:
                vehicle.last_seen = time

    def settle(self, time: float) -> None:
        """Report ended bursts of losses and rejections, and ended flapping; also call it at the end of a file."""
        with self._lock:
            for vehicle in (self._common, *self.vehicles.values()):
                vehicle.settle(time)

    def state(self, vehicle: str, time: float) -> State:
        """Return the current state of a vehicle; `time`: now."""
        with self._lock:
            known = self.vehicles.get(vehicle)
            if known is None and self.is_full:
                return State("watch", f"no events: more than {limits.VEHICLES} vehicles", None, ())
            if known is not None:
                return known.state(time)
            return state_of(())

    def events_since(self, seen: int) -> tuple[list[Event], int]:
        """Return the retained events after the first `seen` reported ones, and the number of all reported events."""
        with self._lock:
            # dicts keep the order of insertion: from the newest back to the last seen one
            unseen = takewhile(lambda number: number >= seen, reversed(self._events))
            new = [self._events[number] for number in unseen]
            return new[::-1], self.reported

    def label_first_events(self) -> None:
        """For files: set the time since boot of events that were reported before a message contained it."""
        for number, event in self._events.items():
            known = self.vehicles.get(event.vehicle)
            if event.boot is None and known is not None and known.boot is not None:
                self._events[number] = replace(event, boot=known.boot + event.time - known.time)

    def _vehicle(self, name: str, time: float) -> Vehicle | None:
        """Return a vehicle, a new one if necessary; None if the event log is full."""
        known = self.vehicles.get(name)
        if known is not None:
            return known
        if self.is_full and time >= self._full_until:
            self._full_until = time + 1.0
            self._forget(self._gone(time)[:1])
        if self.is_full:
            self._refuse()
            return None
        vehicle = Vehicle(name, self._record, self._common, first=time)
        self.vehicles[name] = vehicle
        return vehicle

    def _refuse(self) -> None:
        if not self.refused:
            text = (
                "more than %d vehicles: the others have no events; select vehicles with --vehicle"
            )
            _log.warning(text, limits.VEHICLES, extra=about("incomplete"))
        self.refused += 1

    def _gone(self, time: float) -> list[str]:
        """Return the vehicles that were not seen for a minute, longest gone first, then by name."""
        names = [
            name for name, vehicle in self.vehicles.items() if time - vehicle.last_seen > RECENT
        ]
        return sorted(names, key=lambda name: (self.vehicles[name].last_seen, name))

    def _forget_gone(self, time: float) -> None:
        """Forget the vehicles that are gone for an hour; if there are none, those beyond the limit."""
        gone = self._gone(time)
        forgotten = [
            name for name in gone if time - self.vehicles[name].last_seen > TIMINGS.forgotten
        ]
        kept = max(limits.GONE_VEHICLES, self._most_present)
        beyond = gone[:-kept]
        self._forget(forgotten or beyond)

    def _forget(self, names: Iterable[str]) -> None:
        for name in names:
            del self.vehicles[name]
            for severity in SEVERITIES:
                del self.counts[name, severity]

    def _record(self, event: Event) -> None:
        self._events[self.reported] = event
        self._numbers[event.vehicle].append(self.reported)
        self.counts[event.vehicle, event.severity] += 1
        self.reported += 1
        if len(self._events) > self._keep:
            self._delete_oldest(self._vehicle_with_most_events())

    def _vehicle_with_most_events(self) -> str:
        """Return the vehicle with the most events, that of the oldest event if none has many."""
        name = max(self._numbers, key=lambda name: len(self._numbers[name]))
        if len(self._numbers[name]) > limits.EVENTS_OF_VEHICLE:
            return name
        oldest = next(iter(self._events.values()))
        return oldest.vehicle

    def _delete_oldest(self, name: str) -> None:
        numbers = self._numbers[name]
        del self._events[numbers.popleft()]
        if not numbers:
            del self._numbers[name]
