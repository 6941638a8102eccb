"""Report from a service to its peers: recent events, and the state of each vehicle."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from nedbus.timings import TIMINGS
from nedbus_msgs import TOPICS, check_vehicle

from .event import ALL, Condition, Event, Seconds
from .event_log import KEPT, MAX_VEHICLES, EventLog
from .kinds import KINDS, OF_SERVICE, rank_vehicle

ACCOUNT_PARAMETER: Final = "events"
"""Parameter of a status query that requests this report instead of the status; its value is the period [s]."""

# per vehicle; those that nedbus defines come first, because verdicts depend on them
_MAX_TOPICS: Final = 30
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
        return "silent" in self.kinds or "gone" in self.kinds

    def is_forgotten(self, now: float) -> bool:
        """Return True if the vehicle has been silent for an hour."""
        return self.is_silent and self.since is not None and now - self.since >= TIMINGS.forgotten


@dataclass(frozen=True, slots=True)
class AccountReport:
    """Report of one service; times are Unix times on its host's clock [s]."""

    service: str
    host: str
    now: Seconds
    vehicles: Annotated[Mapping[_Name, VehicleReport], Field(max_length=MAX_VEHICLES)]
    events: Annotated[tuple[Event, ...], Field(max_length=KEPT)] = ()

    def about(self, vehicle: str) -> AccountReport:
        """Return what this report says about one vehicle; events of the link and the reader become its events."""
        vehicles = {name: each for name, each in self.vehicles.items() if name == vehicle}
        events = (each for each in self.events if each.vehicle in (vehicle, ALL))
        own = tuple(
            each if each.vehicle == vehicle else replace(each, vehicle=vehicle) for each in events
        )
        return replace(self, vehicles=vehicles, events=own)

    def split(self, number: int) -> list[AccountReport]:
        """Split the report into `number` parts; [] if it has at most one vehicle and one event."""
        vehicles, events = list(self.vehicles.items()), self.events
        many, some = -(-len(vehicles) // number), -(-len(events) // number)
        return [
            replace(
                self,
                vehicles=dict(vehicles[each * many :][:many]),
                events=events[each * some :][:some],
            )
            for each in range(number if max(len(vehicles), len(events)) > 1 else 0)
        ]


@cache
def _report_type() -> TypeAdapter[AccountReport]:
    """Return the validation of a reply; Pydantic takes 30 ms to compile it, so it waits for the first reply."""
    return TypeAdapter(AccountReport)


def report_of(
    event_log: EventLog, service: str, host: str, now: float, *, within: float, to_utc: float = 0.0
) -> AccountReport:
    """Return a report of the events in the last `within` seconds, and the state of each vehicle.

    `now`: time on the event log's clock [s]; `to_utc`: offset from that clock to Unix time [s].
    """
    events = [event for event in event_log.events if event.time > now - within]
    reported = {event.identity for event in events}
    vehicles = {}
    for name, vehicle in list(event_log.vehicles.items()):
        state = event_log.state(name, now)
        held = list(vehicle.conditions.items())
        flags = {
            flag: max(0.0, each.since + to_utc)
            for (kind, flag), each in held
            if KINDS[kind].validity
        }
        kinds = tuple(dict.fromkeys(each.kind for each in state.conditions))
        known = [condition for _, condition in held] + [*vehicle.usual.values()]
        bad = (condition for condition in known if condition.severity != "info")
        unreported = tuple(
            dict.fromkeys(each for each in bad if each.begin.identity not in reported)
        )
        vehicles[name] = VehicleReport(
            state.severity, state.text, None if state.since is None else max(0.0, state.since + to_utc), kinds, flags,
            tuple(sorted(vehicle.topics, key=lambda each: (each not in TOPICS, each)))[:_MAX_TOPICS],
            vehicle.main is not None, tuple(each.later(to_utc) for each in unreported), vehicle.unknown,
            max(0.0, vehicle.first + to_utc),
        )  # fmt: skip
    return AccountReport(
        service, host, now + to_utc, vehicles, tuple(each.later(to_utc) for each in events)
    )


def joined(parts: Sequence[AccountReport]) -> AccountReport:
    """Join the parts of a report."""
    vehicles = {name: vehicle for part in parts for name, vehicle in part.vehicles.items()}
    return replace(
        parts[0], vehicles=vehicles, events=tuple(event for part in parts for event in part.events)
    )


def by_vehicle(reports: Iterable[AccountReport]) -> dict[str, AccountReport]:
    """Return one report per vehicle, worst vehicle first, preferably from a service that receives the vehicle."""
    found: dict[str, AccountReport] = {}
    for report in reports:
        for name in report.vehicles:
            if name not in found or found[name].vehicles[name].is_silent:
                found[name] = report
    return dict(
        sorted(
            found.items(),
            key=lambda each: rank_vehicle(each[0], each[1].vehicles[each[0]].severity),
        )
    )


def once_per_service(reports: Iterable[AccountReport]) -> list[tuple[AccountReport, Event]]:
    """Return the events of reports in chronological order, each with its report.

    A service reports events of its link and its load for each of its vehicles; they occur once, with the vehicle ALL.
    Only equal ones are merged: the report about one vehicle replaces no event in that about another.
    """
    found: dict[object, tuple[AccountReport, Event]] = {}
    for report in reports:
        for event in report.events:
            if event.kind in OF_SERVICE:
                content = (
                    event.kind,
                    event.change,
                    event.severity,
                    event.text,
                    event.time,
                    event.lasted,
                )
                found.setdefault(
                    (report.service, report.host, content), (report, replace(event, vehicle=ALL))
                )
            else:
                found[id(event)] = report, event
    return sorted(found.values(), key=lambda each: each[1].time)


def from_json(content: object) -> AccountReport | None:
    """Validate the reply of a peer; return None if it is not a report, for example from an older service."""
    try:
        return _report_type().validate_python(content)
    except ValidationError:
        return None
