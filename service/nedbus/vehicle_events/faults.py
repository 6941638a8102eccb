"""Health checks of vehicles: the criteria, and the faults that violate them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from nedbus import limits
from nedbus.clock import format_duration, format_since, format_utc
from nedbus_msgs.text import counted

from .event import ALL, without_wild
from .report import AccountReport, VehicleReport, by_vehicle, once_per_service

VALID: Final[Mapping[str, str]] = {
    "xy": "xy_valid",
    "z": "z_valid",
    "vxy": "v_xy_valid",
    "vz": "v_z_valid",
}
"""Quantities whose validity a health check can require, and their flags in VehicleLocalPosition."""


@dataclass(frozen=True, slots=True)
class Expectation:
    """The criteria of a health check.

    `expect`: names of required vehicles. `vehicles`: minimum number of vehicles. `valid`: required keys of VALID.
    `within`: seconds that must be free of bad and watch events. `well`: no vehicle may be in a bad state.
    """

    expect: tuple[str, ...] = ()
    vehicles: int | None = None
    valid: tuple[str, ...] = ()
    within: float | None = None
    well: bool = False


def faults_of(
    reports: Sequence[AccountReport], expected: Expectation, *, only: str | None = None
) -> list[str]:
    """Return the faults that fail a health check, one line each; `only`: consider only reports of this host."""
    checked = [report for report in reports if only is None or report.host == only]
    states = {
        name: _StateAt(report.now, report.vehicles[name])
        for name, report in by_vehicle(checked).items()
    }
    faults = [*_faults_of_fleet(states, expected)]
    for name, state in states.items():
        if not expected.expect or name in expected.expect:
            own = _faults_of_vehicle(name, state, expected)
            faults += [f"vehicle {name}: {fault}" for fault in own]
    faults += _recent_faults(checked, expected)
    return list(dict.fromkeys(faults))


class _StateAt(NamedTuple):
    """The state of a vehicle, and the time of its report."""

    now: float
    vehicle: VehicleReport


def _faults_of_fleet(states: Mapping[str, _StateAt], expected: Expectation) -> Iterator[str]:
    """Yield the missing vehicles, and that there are too few."""
    active = [name for name, state in states.items() if not state.vehicle.is_silent]
    names = ", ".join(active[: limits.SHOWN_NAMES])
    published = f"; published: {names}" if names else ""
    for name in expected.expect:
        if name not in states:
            yield f"vehicle {name} is missing: it has no publisher{published}"
    if expected.vehicles is not None and len(active) < expected.vehicles:
        of_names = f": {names}" if names else ""
        yield f"messages arrive from {len(active)} of {expected.vehicles} vehicles{of_names}"


def _faults_of_vehicle(name: str, state: _StateAt, expected: Expectation) -> Iterator[str]:
    now, vehicle = state
    worst = f"{vehicle.text}{format_since(vehicle.since, now)}"
    if vehicle.is_silent:
        if name in expected.expect or not vehicle.is_forgotten(now):
            yield worst
        return
    invalid = [quantity for quantity in expected.valid if VALID[quantity] in vehicle.flags]
    if invalid:
        starts = [vehicle.flags[VALID[quantity]] for quantity in invalid]
        since = min((start for start in starts if start), default=None)
        yield f"{', '.join(invalid)} not valid{format_since(since, now)}"
    elif expected.well and vehicle.severity == "bad":
        yield worst
    elif expected.valid and not vehicle.has_position:
        yield "publishes no position"
    unknown = [quantity for quantity in expected.valid if VALID[quantity] in vehicle.unknown]
    if unknown:
        yield f"validity of {', '.join(unknown)} is unknown: the vehicle does not send it"


def _recent_faults(reports: Sequence[AccountReport], expected: Expectation) -> Iterator[str]:
    """Yield the recent bad and watch events."""
    if expected.within is None:
        return
    # Selected before the events of a service are merged: what is said of one vehicle does not concern another.
    selected = list(reports)
    if expected.expect:
        required = {*expected.expect}
        selected = [report for report in reports if report.vehicles.keys() & required]
    sound = [replace(report, events=tuple(without_wild(report.events))) for report in selected]
    lines = []
    for report, event in once_per_service(sound):
        is_recent = event.time > report.now - expected.within
        is_selected = not expected.expect or event.vehicle in (*expected.expect, ALL)
        if is_recent and is_selected and event.severity != "info":
            if event.vehicle == ALL:
                name = report.host
            else:
                name = f"vehicle {event.vehicle}"
            at = f"{format_utc(event.time)} UTC, {format_duration(report.now - event.time)} ago"
            lines.append(f"{name}: {event.text}, at {at}")
    yield from lines[: limits.SHOWN_NAMES]
    more = len(lines) - limits.SHOWN_NAMES
    if more > 0:
        yield f"{counted(more, 'more event')} in the last {expected.within:g} s"
