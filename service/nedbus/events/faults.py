"""Faults of vehicles for health checks, a line each."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from .event import to_age
from .report import AccountReport, VehicleReport, by_vehicle, since_text
from .times import to_clock

VALID: Final[Mapping[str, str]] = {
    "xy": "xy_valid", "z": "z_valid", "vxy": "v_xy_valid", "vz": "v_z_valid",
}  # fmt: skip
"""Quantities that may be required to be valid, and their flags."""

_MAX_LINES: Final = 20  # of what happened lately


@dataclass(frozen=True, slots=True)
class Expectation:
    """The conditions of a health check.

    `expect`: vehicles that must be heard; `vehicles`: the least number of them; `valid`: keys of VALID that must be
    valid; `within`: seconds in which nothing may have happened that is bad or to be watched; `well`: no state is bad.
    """

    expect: tuple[str, ...] = ()
    vehicles: int | None = None
    valid: tuple[str, ...] = ()
    within: float | None = None
    well: bool = False


def faults_of(
    reports: Sequence[AccountReport], expected: Expectation, *, heard: Collection[str] = (), only: str | None = None
) -> list[str]:
    """Return what is wrong, a line each.

    `heard`: vehicles that are heard, though no service knows of them. `only`: judge the services of this host alone.
    """
    judged = [report for report in reports if only is None or report.host == only]
    vehicles = merge_vehicles(judged)
    faults = [*_missing(expected, vehicles, heard)]
    for name, (now, vehicle) in sorted(vehicles.items()):
        if expected.expect and name not in expected.expect:
            continue
        if vehicle.is_silent:
            if name in expected.expect or not vehicle.is_forgotten(now):
                faults.append(f"vehicle {name}: {vehicle.text}{vehicle.since_text(now)}")
            continue
        invalid = [each for each in expected.valid if VALID[each] in vehicle.flags]
        if invalid:
            since = min(vehicle.flags[VALID[each]] for each in invalid)
            faults.append(f"vehicle {name}: {', '.join(invalid)} not valid{since_text(since, now)}")
        elif expected.well and vehicle.severity == "bad":
            faults.append(f"vehicle {name}: {vehicle.text}{vehicle.since_text(now)}")
        elif expected.valid and not vehicle.has_position:
            faults.append(f"vehicle {name}: it sends no position")
    if expected.within is not None:
        faults += _lately(judged, expected, expected.within)
    return list(dict.fromkeys(faults))


def merge_vehicles(reports: Iterable[AccountReport]) -> dict[str, tuple[float, VehicleReport]]:
    """Return what is known of each vehicle, and when: by a service that hears it, if one does."""
    return {name: (report.now, report.vehicles[name]) for name, report in by_vehicle(reports).items()}


def _missing(
    expected: Expectation, vehicles: Mapping[str, tuple[float, VehicleReport]], heard: Collection[str]
) -> Iterator[str]:
    for name in expected.expect:
        if name not in vehicles and name not in heard:
            yield f"vehicle {name} is missing: it has no publisher"
    flying = {name for name, (_, vehicle) in vehicles.items() if not vehicle.is_silent} | set(heard)
    if expected.vehicles is not None and len(flying) < expected.vehicles:
        names = f": {', '.join(sorted(flying)[:20])}" if flying else ""
        yield f"{len(flying)} of {expected.vehicles} vehicles are heard{names}"


def _lately(reports: Sequence[AccountReport], expected: Expectation, within: float) -> Iterator[str]:
    lines = [
        f"{'vehicle ' * (event.vehicle != '*')}{event.vehicle.replace('*', report.host)}: {event.text}, at "
        f"{to_clock(event.time)} UTC, {to_age(max(0.0, report.now - event.time))} ago"
        for report in reports
        for event in report.events
        if event.severity != "info" and event.time > report.now - within
        and (not expected.expect or event.vehicle in (*expected.expect, "*"))
    ]  # fmt: skip
    yield from lines[:_MAX_LINES]
    if len(lines) > _MAX_LINES:
        yield f"{len(lines) - _MAX_LINES} events more in the last {within:g} s"
