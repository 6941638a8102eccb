"""The account of a service, as it answers others: its events of the last minutes, and the state of each vehicle."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from pydantic import TypeAdapter, ValidationError

from nedbus_msgs import AddressError, check_vehicle

from .account import Account
from .event import Condition, Event, to_age
from .times import to_clock

QUESTION: Final = "events"
"""The parameter of a query for the status of services that asks for this in its place."""

FORGOTTEN: Final = 3600.0
"""Seconds of silence after which a vehicle that is not asked for is no fault any more: it was switched off."""

_SILENT: Final = frozenset({"silent", "gone"})
_MAX_TIME: Final = 1e11  # s since the epoch that a peer may tell of
_LEAST_EVENTS: Final = 10  # of each vehicle, as long as there is room
_MAX_EVENTS: Final = 300  # of an answer
_MAX_TOPICS: Final = 30  # of a vehicle
_MAX_VEHICLES: Final = 1000  # of an answer
_MAX_BYTES: Final = 2**17  # of the events of an answer, about, and of what holds beside them


@dataclass(frozen=True, slots=True)
class VehicleReport:
    """The state of one vehicle: its severity ("info" is well), in words, since when, the kinds of what holds.

    `flags`: those of its position that say "not valid", each with since when. `topics`: those of the messages that it
    sends. `has_position`: whether it sends a position at all. `held`: what holds, and is not among the events, as it
    began before them, or held at the first message already.
    """

    severity: Literal["bad", "watch", "info"]
    text: str
    since: float | None = None
    kinds: tuple[str, ...] = ()
    flags: Mapping[str, float] = field(default_factory=dict)
    topics: tuple[str, ...] = ()
    has_position: bool = False
    held: tuple[Condition, ...] = ()

    @property
    def is_silent(self) -> bool:
        """True while it is not heard, so that nothing else is known of it."""
        return not _SILENT.isdisjoint(self.kinds)

    def is_forgotten(self, now: float) -> bool:
        """Return whether it has been silent for so long that it was switched off."""
        return self.is_silent and self.since is not None and now - self.since >= FORGOTTEN

    def since_text(self, now: float) -> str:
        """Return since when its state holds, to be said behind it; "" where that is not known."""
        return since_text(self.since, now)


def since_text(since: float | None, now: float) -> str:
    """Return since when something holds, to be said behind it; "" where that is not known."""
    return "" if since is None else f", since {to_clock(since)} UTC ({to_age(max(0.0, now - since))})"


@dataclass(frozen=True, slots=True)
class AccountReport:
    """The memory of one service; times are seconds since the epoch by its host's clock."""

    service: str
    host: str
    now: float
    events: tuple[Event, ...] = ()
    vehicles: Mapping[str, VehicleReport] = field(default_factory=dict)


_REPORT: Final = TypeAdapter(AccountReport)


def report_of(account: Account, service: str, host: str, now: float, *, within: float) -> AccountReport:
    """Return what an account remembers of the last seconds; of many events the last ones of each vehicle."""
    recent = [event for event in account.take(0)[0] if event.time > now - within]
    share = max(_LEAST_EVENTS, _MAX_EVENTS // max(1, len({event.vehicle for event in recent})))
    counts: Counter[str] = Counter()
    events: list[Event] = []
    size = 0
    for event in reversed(recent):
        counts[event.vehicle] += 1
        if counts[event.vehicle] <= share:
            size += 200 * (1 + len(event.evidence)) + len(event.text)
            if size > _MAX_BYTES or len(events) >= _MAX_EVENTS:
                break
            events.append(event)
    events.reverse()
    told = {_identity(event) for event in events}
    vehicles, size = {}, 0
    for name, vehicle in list(account.vehicles.items()):
        state = account.state(name, now)
        held = list(vehicle.conditions.items())
        flags = {flag: each.since for (kind, flag), each in held if kind.endswith("_invalid") and flag}
        kinds = tuple(dict.fromkeys(each.kind for each in state.conditions))
        topics = tuple(vehicle.messages.values())[:_MAX_TOPICS]
        untold = {
            _identity(each.begin): each for _, each in held
            if each.severity != "info" and _identity(each.begin) not in told
        }  # fmt: skip
        size += 500 * len(untold)
        vehicles[name] = VehicleReport(
            state.severity, state.text, state.since, kinds, flags, topics, vehicle.main is not None,
            tuple(untold.values()) if size < _MAX_BYTES else (),
        )  # fmt: skip
    return AccountReport(service, host, now, tuple(events), vehicles)


def by_vehicle(reports: Iterable[AccountReport]) -> dict[str, AccountReport]:
    """Return the report to ask about each vehicle: that of a service that hears it, if one does."""
    found: dict[str, AccountReport] = {}
    for report in reports:
        for name in report.vehicles:
            if name not in found or found[name].vehicles[name].is_silent:
                found[name] = report
    return found


def _identity(event: Event) -> tuple[object, ...]:
    return event.kind, event.time, event.names


def from_json(content: object) -> AccountReport | None:
    """Return the report in what a peer answered; None for anything else, as an older service answers."""
    match content:
        case {"vehicles": dict(vehicles)} if len(vehicles) <= _MAX_VEHICLES:
            pass
        case _:
            return None
    try:
        report = _REPORT.validate_python(content)
        for name in report.vehicles:
            check_vehicle(name)
    except (ValidationError, AddressError):
        return None
    told = [*report.events, *(each.begin for vehicle in report.vehicles.values() for each in vehicle.held)]
    states = [each for vehicle in report.vehicles.values() for each in (vehicle.since or 0.0, *vehicle.flags.values())]
    times = (report.now, *states, *_times(told))
    return report if len(report.events) <= _MAX_EVENTS and all(0 <= time <= _MAX_TIME for time in times) else None


def _times(events: Iterable[Event]) -> Iterator[float]:
    for event in events:
        yield event.time
        yield from _times(event.evidence)
