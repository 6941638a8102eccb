"""The command for health checks and watchdogs: health."""

from __future__ import annotations

import json
import socket
from dataclasses import asdict, dataclass
from typing import Annotated, Final

import typer

from nedbus.client import Bus, to_age
from nedbus.errors import NedbusError
from nedbus_msgs import ANY, check_vehicle

from .format import to_text
from .options import JsonOption, on_bus, write
from .status import refused_of, sources_of, streams_of

_DENIED: Final = (
    ", though its service reports that it is: does the router let that service write this vehicle, and this client"
    " read? (docs/security.md)"
)


@on_bus
def health(
    bus: Bus,
    *,
    vehicle: Annotated[
        str | None, typer.Option("--vehicle", "-v", help="Judge this vehicle, whoever publishes it, by an answer")
    ] = None,
    services: Annotated[
        int | None, typer.Option("--services", metavar="N", min=1, help="Expect N services, on all hosts together")
    ] = None,
    max_age: Annotated[
        float, typer.Option("--max-age", metavar="SECONDS", min=0.0, help="Age of the newest message at most")
    ] = 3.0,
    json_output: JsonOption = False,
) -> None:
    """Exit 0 when all is well: services answer, all their sources work, and messages flow; else 1 with the reason.

    Without --vehicle and --services it judges the services of this host, by what they report of themselves.
    With --vehicle that vehicle must answer, as it does to any reader.
    """
    if vehicle is not None:
        check_vehicle(vehicle)
    report = _examine(bus, vehicle, services, max_age)
    if json_output:
        write(json.dumps({"healthy": report.reason is None, **asdict(report)}))
    if report.reason is not None:
        raise NedbusError(report.reason)
    if not json_output:
        write(report.summary)


@dataclass(slots=True)
class _Report:
    """What was found; `vehicles` has the age of the newest message of each vehicle [s], `reason` why it is not well."""

    reason: str | None
    services: int
    sources: int
    vehicles: dict[str, float]

    @property
    def summary(self) -> str:
        newest = to_age(min(self.vehicles.values()))
        counts = f"{self.services} services, {self.sources} sources, {len(self.vehicles)} vehicles"
        return f"{counts}, newest message {newest} old"


def _examine(bus: Bus, vehicle: str | None, expected: int | None, max_age: float) -> _Report:
    host = socket.gethostname()
    anywhere = vehicle is not None or expected is not None
    found = [each for each in bus.services() if anywhere or each.get("host") == host]
    sources = [source for service in found for source in sources_of(service)]
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
    refused = sorted({to_text(name, 64) for service in found for name in refused_of(service)})
    failed = [source for source in sources if source.get("state") in {"retrying", "failed"}]
    if expected is not None and len(found) < expected:
        report.reason = f"{len(found)} of {expected} services answer at {at}"
    elif not found and not anywhere:
        report.reason = f"no service of {host} answers at {at}: --services 1 accepts those of other hosts"
    elif refused and vehicle is None:
        report.reason = f"the router refuses vehicle {', '.join(refused)[:300]}: do its access rules name it?"
    elif failed and vehicle is None:
        source = failed[0]
        report.reason = " ".join(
            (to_text(source.get("source")), "is", f"{to_text(source.get('state'))}:", to_text(source.get("error"), 300))
        )
    elif not ages:
        states = ", ".join(f"{to_text(each.get('source'), 60)} is {to_text(each.get('state'), 20)}" for each in sources)
        what = "no vehicle is published" if vehicle is None else f"vehicle {vehicle} is not published"
        report.reason = f"{what}{denied or (f': {states[:300]}' if states else '')}"
    elif min(ages.values()) > max_age:
        name = min(ages, key=lambda each: ages[each])
        report.reason = f"the newest message is {to_age(ages[name])} old, from vehicle {name}: at most {max_age:g} s"
    return report


def _ages(sources: list[dict[str, object]]) -> dict[str, float]:
    """Return the age of the newest message of each vehicle that is published, as its service measures it [s]."""
    ages: dict[str, float] = {}
    for source in sources:
        published = source.get("addresses")
        for address, health_ in streams_of(source):
            vehicle = to_text(address.partition("/")[0], 64)
            if health_.age is not None and isinstance(published, list) and address in published:
                ages[vehicle] = min(health_.age, ages.get(vehicle, health_.age))
    return ages
