"""The account of a service, as it answers others: its events of the last minutes, and the state of each vehicle."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from nedbus_msgs import check_vehicle

from .account import Account
from .event import Condition, Event, Seconds

QUESTION: Final = "events"
"""The parameter of a query for the status of services that asks for this in its place."""

FORGOTTEN: Final = 3600.0
"""Seconds of silence after which a vehicle that is not asked for is no fault any more: it was switched off."""

_LEAST_EVENTS: Final = 10  # of each vehicle, as long as there is room
_MAX_EVENTS: Final = 300  # of an answer
_MAX_TOPICS: Final = 30  # of a vehicle
_MAX_VEHICLES: Final = 1000  # of an answer
_MAX_BYTES: Final = 2**17  # of the events of an answer, about, and of what holds beside them


@dataclass(frozen=True, slots=True)
class VehicleReport:
    """The state of one vehicle: severity ("info" is well), text, begin, and the kinds of its conditions.

    `flags`: the flags of its position that are not valid, each with its begin. `topics`: of the messages that it sends.
    `has_position`: True if it sends a position. `held`: conditions that hold and have no begin among the events.
    """

    severity: Literal["bad", "watch", "info"]
    text: str
    since: Seconds | None = None
    kinds: tuple[str, ...] = ()
    flags: Mapping[str, Seconds] = field(default_factory=dict)
    topics: tuple[str, ...] = ()
    has_position: bool = False
    held: tuple[Condition, ...] = ()

    @property
    def is_silent(self) -> bool:
        """True while nothing arrives from it."""
        return "silent" in self.kinds or "gone" in self.kinds

    def is_forgotten(self, now: float) -> bool:
        """Return True if it has been silent for FORGOTTEN seconds."""
        return self.is_silent and self.since is not None and now - self.since >= FORGOTTEN


def _checked(vehicle: str) -> str:
    check_vehicle(vehicle)
    return vehicle


_Name = Annotated[str, AfterValidator(_checked)]


@dataclass(frozen=True, slots=True)
class AccountReport:
    """The memory of one service; times are seconds since the epoch by its host's clock."""

    service: str
    host: str
    now: Seconds
    vehicles: Annotated[Mapping[_Name, VehicleReport], Field(max_length=_MAX_VEHICLES)]
    events: Annotated[tuple[Event, ...], Field(max_length=_MAX_EVENTS)] = ()


_REPORT: Final = TypeAdapter(AccountReport)


def report_of(account: Account, service: str, host: str, now: float, *, within: float) -> AccountReport:
    """Return the last `within` seconds of an account; of many events the last ones of each vehicle."""
    recent = [event for event in account.take(0)[0] if event.time > now - within]
    share = max(_LEAST_EVENTS, _MAX_EVENTS // max(1, len({event.vehicle for event in recent})))
    counts: Counter[str] = Counter()
    events: deque[Event] = deque()
    size = 0
    for event in reversed(recent):
        counts[event.vehicle] += 1
        if counts[event.vehicle] <= share:
            size += 200 * (1 + len(event.evidence)) + len(event.text)
            if size > _MAX_BYTES or len(events) >= _MAX_EVENTS:
                break
            events.appendleft(event)
    told = {event.identity for event in events}
    vehicles, size = {}, 0
    for name, vehicle in list(account.vehicles.items()):
        state = account.state(name, now)
        held = list(vehicle.conditions.items())
        flags = {flag: each.since for (kind, flag), each in held if kind.endswith("_invalid") and flag}
        kinds = tuple(dict.fromkeys(each.kind for each in state.conditions))
        bad = (each for _, each in held if each.severity != "info")
        untold = tuple(dict.fromkeys(each for each in bad if each.begin.identity not in told))
        size += 500 * len(untold)
        vehicles[name] = VehicleReport(
            state.severity, state.text, state.since, kinds, flags, tuple(sorted(vehicle.topics))[:_MAX_TOPICS],
            vehicle.main is not None, untold if size < _MAX_BYTES else (),
        )  # fmt: skip
    return AccountReport(service, host, now, vehicles, tuple(events))


def by_vehicle(reports: Iterable[AccountReport]) -> dict[str, AccountReport]:
    """Return the report to ask about each vehicle: that of a service that hears it, if one does."""
    found: dict[str, AccountReport] = {}
    for report in reports:
        for name in report.vehicles:
            if name not in found or found[name].vehicles[name].is_silent:
                found[name] = report
    return found


def from_json(content: object) -> AccountReport | None:
    """Parse the answer of a peer; None if it is no report, as that of an older service."""
    try:
        return _REPORT.validate_python(content)
    except ValidationError:
        return None
