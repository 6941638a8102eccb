"""Health checks of vehicles: the criteria, and the faults that violate them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

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

_MAX_RECENT: Final = 20  # recent events listed


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
    vehicles = {
        name: (report.now, report.vehicles[name]) for name, report in by_vehicle(checked).items()
    }
    missing = [name for name in expected.expect if name not in vehicles]
    active = [name for name, (_, vehicle) in vehicles.items() if not vehicle.is_silent]
    names = f": {', '.join(active[:20])}" if active else ""
    faults = [
        f"vehicle {name} is missing: it has no publisher{names and f'; published{names}'}"
        for name in missing
    ]
    if len(active) < (expected.vehicles or 0):
        faults.append(f"messages arrive from {len(active)} of {expected.vehicles} vehicles{names}")
    for name, (now, vehicle) in vehicles.items():
        if not expected.expect or name in expected.expect:
            faults += [
                f"vehicle {name}: {fault}"
                for fault in _faults_of_vehicle(name, vehicle, now, expected)
            ]
    return list(dict.fromkeys([*faults, *_recent_faults(checked, expected)]))


def _faults_of_vehicle(
    name: str, vehicle: VehicleReport, now: float, expected: Expectation
) -> Iterator[str]:
    invalid = [each for each in expected.valid if VALID[each] in vehicle.flags]
    unknown = [each for each in expected.valid if VALID[each] in vehicle.unknown]
    if vehicle.is_silent:
        if name in expected.expect or not vehicle.is_forgotten(now):
            yield f"{vehicle.text}{format_since(vehicle.since, now)}"
    elif invalid:
        since = min(filter(None, (vehicle.flags[VALID[each]] for each in invalid)), default=None)
        yield f"{', '.join(invalid)} not valid{format_since(since, now)}"
    elif expected.well and vehicle.severity == "bad":
        yield f"{vehicle.text}{format_since(vehicle.since, now)}"
    elif expected.valid and not vehicle.has_position:
        yield "publishes no position"
    if unknown and not vehicle.is_silent:
        yield f"validity of {', '.join(unknown)} is unknown: the vehicle does not send it"


def _recent_faults(reports: Sequence[AccountReport], expected: Expectation) -> Iterator[str]:
    # Selected before the events of a service are merged: what is said of one vehicle does not concern another.
    selected = [
        replace(report, events=tuple(without_wild(report.events)))
        for report in reports
        if not expected.expect or report.vehicles.keys() & {*expected.expect}
    ]
    lines = []
    for report, event in once_per_service(selected):
        is_recent = expected.within is not None and event.time > report.now - expected.within
        is_selected = not expected.expect or event.vehicle in (*expected.expect, ALL)
        if is_recent and is_selected and event.severity != "info":
            name = report.host if event.vehicle == ALL else f"vehicle {event.vehicle}"
            at = f"{format_utc(event.time)} UTC, {format_duration(report.now - event.time)} ago"
            lines.append(f"{name}: {event.text}, at {at}")
    yield from lines[:_MAX_RECENT]
    if (more := len(lines) - _MAX_RECENT) > 0:
        yield f"{counted(more, 'more event')} in the last {expected.within:g} s"
