"""Report from a service to its peers: recent events, and the state of each vehicle."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from nedbus import limits
from nedbus.timings import TIMINGS
from nedbus_msgs import TOPICS, check_vehicle

from .event import ALL, Condition, Event, Seconds, State
from .event_log import EventLog
from .kinds import KINDS, OF_SERVICE, rank_vehicle
from .vehicle import Vehicle

ACCOUNT_PARAMETER: Final = "events"
"""Parameter of a status query that requests this report instead of the status; its value is the period [s]."""

_Name = Annotated[str, AfterValidator(check_vehicle)]


@dataclass(frozen=True, slots=True)
class VehicleReport:
    """State of one vehicle: severity ("info" if healthy), text and start of the worst condition.

    `flags`: position validity flags that are false, with their start times if known. `topics`: published topics.
    `has_position`: it publishes a position. `held`: active conditions whose start is not among the events.
    `unknown`: flags that its position does not provide. `kinds`: kinds of all active conditions.
    `first`: time of the first position that the service received, else of the first message; None if unknown.
    """

    severity: Literal["bad", "watch", "info"]
    text: str
    since: Seconds | None = None
    kinds: tuple[str, ...] = ()
    flags: Mapping[str, Seconds | None] = field(default_factory=dict)
    topics: tuple[str, ...] = ()
    has_position: bool = False
    held: tuple[Condition, ...] = ()
    unknown: tuple[str, ...] = ()
    first: Seconds | None = None

    @property
    def is_silent(self) -> bool:
        """True if no message arrives from the vehicle."""
        return not {"silent", "gone"}.isdisjoint(self.kinds)

    def is_forgotten(self, now: float) -> bool:
        """Return True if the vehicle has been silent for an hour."""
        if not self.is_silent or self.since is None:
            return False
        return now - self.since >= TIMINGS.forgotten


@dataclass(frozen=True, slots=True)
class AccountReport:
    """Report of one service; times are Unix times on its host's clock [s]."""

    service: str
    host: str
    now: Seconds
    vehicles: Annotated[Mapping[_Name, VehicleReport], Field(max_length=limits.VEHICLES)]
    events: Annotated[tuple[Event, ...], Field(max_length=limits.EVENTS)] = ()

    def about(self, vehicle: str) -> AccountReport:
        """Return what this report says about one vehicle; events of the link and the reader become its events."""
        vehicles = {}
        known = self.vehicles.get(vehicle)
        if known is not None:
            vehicles[vehicle] = known
        events = []
        for event in self.events:
            if event.vehicle == vehicle:
                events.append(event)
            elif event.vehicle == ALL:
                events.append(replace(event, vehicle=vehicle))
        return replace(self, vehicles=vehicles, events=tuple(events))

    def split(self, number: int) -> list[AccountReport]:
        """Split the report into `number` parts; [] if it has at most one vehicle and one event."""
        names = [*self.vehicles]
        if len(names) <= 1 and len(self.events) <= 1:
            return []
        vehicles_each = math.ceil(len(names) / number)
        events_each = math.ceil(len(self.events) / number)
        parts = []
        for part in range(number):
            of_names = slice(part * vehicles_each, (part + 1) * vehicles_each)
            of_events = slice(part * events_each, (part + 1) * events_each)
            vehicles = {name: self.vehicles[name] for name in names[of_names]}
            events = self.events[of_events]
            parts.append(replace(self, vehicles=vehicles, events=events))
        return parts


@cache
def _report_type() -> TypeAdapter[AccountReport]:
    """Return the validation of a reply; Pydantic takes 30 ms to compile it, so it waits for the first reply."""
    return TypeAdapter(AccountReport)


def report_of(
    event_log: EventLog,
    service: str,
    host: str,
    now: float,
    *,
    within: float,
    to_utc: float = 0.0,
) -> AccountReport:
    """Return a report of the events in the last `within` seconds, and the state of each vehicle.

    `now`: time on the event log's clock [s]; `to_utc`: offset from that clock to Unix time [s].
    """
    events = [event for event in event_log.events if event.time > now - within]
    reported = {event.identity for event in events}
    vehicles = {}
    for name, vehicle in list(event_log.vehicles.items()):
        state = event_log.state(name, now)
        vehicles[name] = _report_of_vehicle(vehicle, state, reported, to_utc)
    later = [event.later(to_utc) for event in events]
    return AccountReport(service, host, now + to_utc, vehicles, tuple(later))


def _report_of_vehicle(
    vehicle: Vehicle, state: State, reported: Collection[object], to_utc: float
) -> VehicleReport:
    """Return the report of a vehicle; `reported`: the identities of the events in the report."""
    flags: dict[str, float | None] = {}
    for (kind, flag), condition in [*vehicle.conditions.items()]:
        if KINDS[kind].validity:
            flags[flag] = max(0.0, condition.since + to_utc)
    active = [*vehicle.conditions.values(), *vehicle.usual.values()]
    faults = [condition for condition in active if condition.severity != "info"]
    unreported = [condition for condition in faults if condition.begin.identity not in reported]
    kinds = [condition.kind for condition in state.conditions]
    topics = sorted(vehicle.topics, key=lambda topic: (topic not in TOPICS, topic))
    since = None
    if state.since is not None:
        since = max(0.0, state.since + to_utc)
    held = [condition.later(to_utc) for condition in dict.fromkeys(unreported)]
    return VehicleReport(
        severity=state.severity,
        text=state.text,
        since=since,
        kinds=tuple(dict.fromkeys(kinds)),
        flags=flags,
        topics=tuple(topics[: limits.REPORTED_TOPICS]),
        has_position=vehicle.main is not None,
        held=tuple(held),
        unknown=vehicle.unknown,
        first=max(0.0, vehicle.first + to_utc),
    )


def joined(parts: Sequence[AccountReport]) -> AccountReport:
    """Join the parts of a report."""
    vehicles: dict[str, VehicleReport] = {}
    events: list[Event] = []
    for part in parts:
        vehicles |= part.vehicles
        events += part.events
    return replace(parts[0], vehicles=vehicles, events=tuple(events))


def by_vehicle(reports: Iterable[AccountReport]) -> dict[str, AccountReport]:
    """Return one report per vehicle, worst vehicle first, preferably from a service that receives the vehicle."""
    best: dict[str, AccountReport] = {}
    for report in reports:
        for name in report.vehicles:
            if name not in best or best[name].vehicles[name].is_silent:
                best[name] = report

    def order(name: str) -> tuple[int, str]:
        return rank_vehicle(name, best[name].vehicles[name].severity)

    return {name: best[name] for name in sorted(best, key=order)}


def once_per_service(reports: Iterable[AccountReport]) -> list[tuple[AccountReport, Event]]:
    """Return the events of reports in chronological order, each with its report.

    A service reports events of its link and its load for each of its vehicles; they occur once, with the vehicle ALL.
    Only equal ones are merged: the report about one vehicle replaces no event in that about another.
    """
    events: list[tuple[AccountReport, Event]] = []
    known = set[object]()
    for report in reports:
        for event in report.events:
            if event.kind not in OF_SERVICE:
                events.append((report, event))
                continue
            key = (report.service, report.host, _content_of(event))
            if key not in known:
                known.add(key)
                events.append((report, replace(event, vehicle=ALL)))

    def time_of(reported: tuple[AccountReport, Event]) -> float:
        _, event = reported
        return event.time

    return sorted(events, key=time_of)


def _content_of(event: Event) -> tuple[object, ...]:
    """Return what an event says, whatever vehicle it is reported for."""
    return event.kind, event.change, event.severity, event.text, event.time, event.lasted


def from_json(content: object) -> AccountReport | None:
    """Validate the reply of a peer; return None if it is not a report, for example from an older service."""
    try:
        return _report_type().validate_python(content)
    except ValidationError:
        return None
