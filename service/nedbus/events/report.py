"""The account that a service sends to its peers: recent events, and the state of each vehicle."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from nedbus_msgs import check_vehicle

from .account import Account
from .event import Condition, Event, Seconds

ACCOUNT_PARAMETER: Final = "events"
"""Parameter of a status query that requests the account in place of the status; its value is the period [s]."""

FORGOTTEN: Final = 3600.0
"""Seconds of silence after which a vehicle that is not expected counts as switched off, not as a fault."""

_MIN_EVENTS: Final = 10  # per vehicle, while the report has room
_MAX_EVENTS: Final = 300  # per report
_MAX_TOPICS: Final = 30  # per vehicle
_MAX_VEHICLES: Final = 1000  # per report
_MAX_BYTES: Final = 2**17  # estimated, of the events of a report, and again of the conditions without an event


@dataclass(frozen=True, slots=True)
class VehicleReport:
    """The state of one vehicle: severity ("info" if all is well), text, begin, and the kinds of its conditions.

    `flags`: validity flags of its position that are false, each with the time since when. `topics`: published topics.
    `has_position`: True if it publishes a position. `held`: active conditions whose begin is not among the events.
    `unknown`: flags that its position does not provide.
    """

    severity: Literal["bad", "watch", "info"]
    text: str
    since: Seconds | None = None
    kinds: tuple[str, ...] = ()
    flags: Mapping[str, Seconds] = field(default_factory=dict)
    topics: tuple[str, ...] = ()
    has_position: bool = False
    held: tuple[Condition, ...] = ()
    unknown: tuple[str, ...] = ()

    @property
    def is_silent(self) -> bool:
        """True if no messages arrive from the vehicle."""
        return "silent" in self.kinds or "gone" in self.kinds

    def is_forgotten(self, now: float) -> bool:
        """Return True if the vehicle has been silent for FORGOTTEN seconds."""
        return self.is_silent and self.since is not None and now - self.since >= FORGOTTEN


def _checked(vehicle: str) -> str:
    check_vehicle(vehicle)
    return vehicle


_Name = Annotated[str, AfterValidator(_checked)]


@dataclass(frozen=True, slots=True)
class AccountReport:
    """The account of one service; times are seconds since the epoch by the clock of its host."""

    service: str
    host: str
    now: Seconds
    vehicles: Annotated[Mapping[_Name, VehicleReport], Field(max_length=_MAX_VEHICLES)]
    events: Annotated[tuple[Event, ...], Field(max_length=_MAX_EVENTS)] = ()


_REPORT: Final = TypeAdapter(AccountReport)


def report_of(
    account: Account, service: str, host: str, now: float, *, within: float, to_utc: float = 0.0
) -> AccountReport:
    """Return a report of the last `within` seconds; if it is full, each vehicle keeps its most recent events.

    `now`: by the account's clock [s]; `to_utc`: what its times need to become Unix time [s].
    """
    recent = [event for event in account.events_since(0)[0] if event.time > now - within]
    share = max(_MIN_EVENTS, _MAX_EVENTS // max(1, len({event.vehicle for event in recent})))
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
    reported = {event.identity for event in events}
    vehicles, size = {}, 0
    for name, vehicle in list(account.vehicles.items()):
        state = account.state(name, now)
        held = list(vehicle.conditions.items())
        flags = {
            flag: max(0.0, each.since + to_utc) for (kind, flag), each in held if kind.endswith("_invalid") and flag
        }
        kinds = tuple(dict.fromkeys(each.kind for each in state.conditions))
        bad = (each for _, each in held if each.severity != "info")
        unreported = tuple(dict.fromkeys(each for each in bad if each.begin.identity not in reported))
        size += 500 * len(unreported)
        vehicles[name] = VehicleReport(
            state.severity, state.text, None if state.since is None else max(0.0, state.since + to_utc), kinds, flags,
            tuple(sorted(vehicle.topics))[:_MAX_TOPICS], vehicle.main is not None,
            tuple(each.later(to_utc) for each in unreported) if size < _MAX_BYTES else (), vehicle.unknown,
        )  # fmt: skip
    return AccountReport(service, host, now + to_utc, vehicles, tuple(each.later(to_utc) for each in events))


def by_vehicle(reports: Iterable[AccountReport]) -> dict[str, AccountReport]:
    """Return a report for each vehicle, preferably from a service that hears the vehicle."""
    found: dict[str, AccountReport] = {}
    for report in reports:
        for name in report.vehicles:
            if name not in found or found[name].vehicles[name].is_silent:
                found[name] = report
    return found


def from_json(content: object) -> AccountReport | None:
    """Parse the reply of a peer; return None if it is not a report, such as the reply of an older service."""
    try:
        return _REPORT.validate_python(content)
    except ValidationError:
        return None
