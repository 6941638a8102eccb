"""The command for health checks and watchdogs: health."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Annotated, Final

import typer

from nedbus.cli.options import JsonOption, command
from nedbus.cli.output.streams import MAX_TEXT, to_text, write, write_stderr
from nedbus.client import Bus, SourceStatus, to_age
from nedbus.errors import ConfigError, NedbusError
from nedbus.events import VALID, Expectation, faults_of
from nedbus_msgs import ANY, DEFAULT_TOPIC, check_vehicle

_DENIED: Final = (
    ", though its service reports that it is: does the router let that service write this vehicle, and this client"
    " read? (docs/security.md)"
)


@command
def health(
    bus: Bus,
    *,
    vehicle: Annotated[
        str | None, typer.Option("--vehicle", "-v", help="Judge this vehicle, of any publisher, by an answer")
    ] = None,
    services: Annotated[
        int | None, typer.Option("--services", metavar="N", min=1, help="Expect N services, on all hosts together")
    ] = None,
    max_age: Annotated[
        float, typer.Option("--max-age", metavar="SECONDS", min=0.0, help="Age of the newest message at most")
    ] = 3.0,
    expect: Annotated[
        str | None, typer.Option("--expect", metavar="1,2,7", help="Vehicles that must be heard, on all hosts together")
    ] = None,
    vehicles: Annotated[
        int | None, typer.Option("--vehicles", metavar="N", min=1, help="Expect N vehicles, on all hosts together")
    ] = None,
    valid: Annotated[
        str | None, typer.Option("--valid", metavar="xy,z", help="What must be valid: xy, z, vxy, vz")
    ] = None,
    within: Annotated[
        float | None,
        typer.Option("--within", metavar="SECONDS", min=0.0, help="Nothing bad, or to be watched, happened in these"),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Exit 0 when all is well: services answer, sources work, messages flow, no vehicle is silent; else 1 and why.

    A line on stderr for each fault. Without --vehicle, --services, --expect and --vehicles it judges the services of
    this host, by what they report; a vehicle that was silent for an hour was switched off, and is no fault.
    With --vehicle that vehicle must answer, as it does to any reader. --valid and --within are of all vehicles that are
    judged, as their services remember them.
    """
    if vehicle is not None:
        check_vehicle(vehicle)
    expected = _parse(vehicle, expect, vehicles, valid, within)
    report = _examine(bus, vehicle, services, max_age, expected)
    report.faults = [
        *([report.reason] if report.reason else []),
        *_vehicle_faults(bus, vehicle, services, expected, max_age),
    ]
    report.reason = report.faults[0] if report.faults else None
    if json_output:
        write(json.dumps({"healthy": report.reason is None, **asdict(report)}))
    if report.faults:
        for fault in report.faults[:-1]:
            write_stderr(to_text(f"nedbus: {fault}", MAX_TEXT))
        raise NedbusError(report.faults[-1])
    if not json_output:
        write(report.summary)


def _parse(
    vehicle: str | None, expect: str | None, vehicles: int | None, valid: str | None, within: float | None
) -> Expectation:
    for option, given in (("--expect", expect), ("--valid", valid)):
        if given is not None and not given.strip(" ,"):
            raise ConfigError(option, "names nothing: is a variable of the shell not set?")
    names = tuple(name.strip() for name in (expect or "").split(",") if name.strip())
    for name in names:
        check_vehicle(name)
    asked = tuple(name.strip() for name in (valid or "").split(",") if name.strip())
    for each in asked:
        if each not in VALID:
            raise ConfigError("--valid", f"{each!r}: expected some of {', '.join(VALID)}")
    return Expectation(
        (*names, *([vehicle] if vehicle is not None and vehicle not in names else [])), vehicles, asked, within
    )


def _vehicle_faults(
    bus: Bus, vehicle: str | None, services: int | None, expected: Expectation, max_age: float
) -> list[str]:
    """Return the faults of vehicles, as services remember them, and others answer."""
    reports = bus.accounts(within=expected.within or 0.0)
    anywhere = bool(expected.expect) or expected.vehicles is not None or services is not None
    known = {name for report in reports for name in report.vehicles}
    heard: set[str] = set()
    doubtful: list[str] = []
    if set(expected.expect) - known or expected.vehicles is not None or (vehicle is not None and expected.valid):
        for sample in bus.latest(ANY):
            is_fresh = sample.latency is None or sample.latency <= max_age
            if sample.stored or not is_fresh or sample.vehicle in known:
                continue
            heard.add(sample.vehicle)
            if sample.topic == DEFAULT_TOPIC and (not expected.expect or sample.vehicle in expected.expect):
                invalid = [each for each in expected.valid if not getattr(sample.message, VALID[each])]
                doubtful += [f"vehicle {sample.vehicle}: {', '.join(invalid)} not valid"] if invalid else []
    found = faults_of(reports, expected, heard=heard, only=None if anywhere else socket.gethostname())
    if vehicle is not None:  # that it is not published is said already
        found = [fault for fault in found if not fault.startswith(f"vehicle {vehicle} is missing")]
    if expected.valid or expected.within is not None:
        told = {report.service for report in reports}
        silent = [
            to_text(each.service, 64)
            for each in bus.services()
            if each.service not in told and (anywhere or each.host == socket.gethostname())
        ]
        found += [f"service {each} does not say what happens to its vehicles: update nedbus there" for each in silent]
    return [*found, *doubtful]


@dataclass(slots=True)
class _Report:
    """The findings; `vehicles` has the age of the newest message of each [s], `faults` all that is not well."""

    reason: str | None
    services: int
    sources: int
    vehicles: dict[str, float]
    faults: list[str] = field(default_factory=list)

    @property
    def summary(self) -> str:
        newest = to_age(min(self.vehicles.values())) if self.vehicles else "unknown, no service tells how"
        counts = {"service": self.services, "source": self.sources, "vehicle": len(self.vehicles)}
        shown = ", ".join(f"{count} {noun}{'s' * (count != 1)}" for noun, count in counts.items())
        return f"{shown}, newest message {newest} old"


def _examine(bus: Bus, vehicle: str | None, expected: int | None, max_age: float, wanted: Expectation) -> _Report:
    host = socket.gethostname()
    anywhere = vehicle is not None or expected is not None or bool(wanted.expect) or wanted.vehicles is not None
    found = [each for each in bus.services() if anywhere or each.host == host]
    sources = [source for service in found for source in service.sources]
    ages = _ages(sources)
    denied = ""
    if vehicle is not None:
        # A status says what a service publishes, and not what a router lets through.
        answers = [sample.latency for sample in bus.latest(ANY, vehicle=vehicle) if not sample.stored]
        denied = _DENIED if vehicle in ages and not answers else ""
        known = [ages[vehicle]] if vehicle in ages else [max(0.0, each) for each in answers if each is not None]
        ages = {vehicle: min(known)} if answers and known else {}
    report = _Report(None, len(found), len(sources), ages)
    at = " or ".join(bus.routers)
    refused = sorted({to_text(name, 64) for service in found for name in service.refused})
    failed = [source for source in sources if source.state in {"retrying", "failed"}]
    if expected is not None and len(found) < expected:
        report.reason = f"{len(found)} of {expected} services answer at {at}"
    elif not found and not anywhere:
        report.reason = f"no service of {host} answers at {at}: --services 1 accepts those of other hosts"
    elif refused and vehicle is None:
        report.reason = f"the router refuses vehicle {', '.join(refused)[:300]}: do its access rules name it?"
    elif failed and vehicle is None:
        source = failed[0]
        report.reason = f"{to_text(source.source)} is {to_text(source.state)}: {to_text(source.error, 300)}"
    elif not ages and (vehicle is not None or not (wanted.expect or wanted.vehicles)):
        states = ", ".join(f"{to_text(each.source, 60)} is {to_text(each.state, 20)}" for each in sources)
        what = "no vehicle is published" if vehicle is None else f"vehicle {vehicle} is not published"
        report.reason = f"{what}{denied or (f': {states[:300]}' if states else '')}"
    elif ages and min(ages.values()) > max_age:
        name = min(ages, key=lambda each: ages[each])
        report.reason = f"the newest message is {to_age(ages[name])} old, from vehicle {name}: at most {max_age:g} s"
    return report


def _ages(sources: Iterable[SourceStatus]) -> dict[str, float]:
    """Return the age of the newest message of each vehicle that is published, as its service measures it [s]."""
    ages: dict[str, float] = {}
    for source in sources:
        for stream in source.streams:
            vehicle, age = to_text(stream.address.partition("/")[0], 64), stream.health.age
            if age is not None and stream.address in source.addresses:
                ages[vehicle] = min(age, ages.get(vehicle, age))
    return ages
