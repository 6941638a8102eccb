"""The command health: whether services answer, their sources work, and messages of the vehicles arrive."""

import json
import socket
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Final

import typer

from nedbus import Bus, Sample, limits
from nedbus.cli.absence import describe_outdated
from nedbus.cli.options import JsonOption, command
from nedbus.cli.output.streams import to_text, write, write_stderr
from nedbus.clock import format_duration
from nedbus.errors import ConfigError, NedbusError
from nedbus.health import AccountReport, ServiceStatus, VehicleReport
from nedbus.vehicle_events import VALID, Expectation, faults_of
from nedbus_msgs import ANY, DEFAULT_TOPIC, Message, check_vehicle
from nedbus_msgs.text import counted, plural

_HOST: Final = socket.gethostname()
_REQUIRED: Final = "Require a message of this vehicle, from any publisher"
_WITHIN: Final = "Require no bad or watch event in the last SECONDS"
_REFUSED: Final = (
    ", although its service reports it as published: check that the access rules of the router allow the service to"
    " publish this vehicle, and this client to read it (docs/security.md)"
)


@command
def health(
    bus: Bus,
    *,
    vehicle: Annotated[str | None, typer.Option("--vehicle", "-v", help=_REQUIRED)] = None,
    services: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Require N services, on any host")
    ] = None,
    max_age: Annotated[
        float, typer.Option(metavar="SECONDS", min=0.0, help="Maximum age of the newest message")
    ] = 3.0,
    expect: Annotated[
        str | None, typer.Option(metavar="1,2,7", help="Require these vehicles, on any host")
    ] = None,
    vehicles: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Require N vehicles, on any host")
    ] = None,
    valid: Annotated[
        str | None, typer.Option(metavar="xy,z", help="Require valid estimates: xy, z, vxy, vz")
    ] = None,
    within: Annotated[float | None, typer.Option(metavar="SECONDS", min=0.0, help=_WITHIN)] = None,
    json_output: JsonOption = False,
) -> None:
    """Check services, sources, messages and vehicles; exit with 0 if healthy.

    Otherwise exits with 1, and writes one line per fault to stderr.

    By default checks the status that the services of this host report; --services, --expect and --vehicles include
    other hosts. --vehicle queries the vehicle's publisher, as any client would. --valid and --within use the event
    history of the services. A vehicle that has been silent for an hour is considered switched off, not faulty.
    """
    required = _parse_names("--expect", expect)
    if vehicle is not None:
        required.append(vehicle)
    for name in required:
        check_vehicle(name)
    estimates = _parse_names("--valid", valid)
    for estimate in estimates:
        if estimate not in VALID:
            raise ConfigError("--valid", f"{estimate!r}: expected a list of {', '.join(VALID)}")
    names = tuple(dict.fromkeys(required))
    expected = Expectation(names, vehicles, tuple(estimates), within)
    check = _Check(bus, _Criteria(vehicle, services, max_age, expected))
    faults = check.faults()
    for remark in check.outdated:
        if remark not in faults:
            _write_line(remark)
    if json_output:
        write(json.dumps(check.fields(faults)))
    if faults:
        for fault in faults[:-1]:
            _write_line(fault)
        raise NedbusError(faults[-1])
    if not json_output:
        write(check.summary())


def _parse_names(option: str, text: str | None) -> list[str]:
    if text is None:
        return []
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise ConfigError(option, "the list is empty: check that the shell variable is set")
    return names


def _write_line(text: str) -> None:
    write_stderr(to_text(f"nedbus: {text}", limits.LINE_TEXT))


@dataclass(frozen=True, slots=True)
class _Criteria:
    """What is required.

    `vehicle`: the one to examine alone; it is among the vehicles of `expected`, too. `services`: their minimum number.
    `max_age`: the maximum age of the newest message [s].
    """

    vehicle: str | None
    services: int | None
    max_age: float
    expected: Expectation

    @property
    def queries_vehicles(self) -> bool:
        """True if the vehicles themselves are queried, not only the services."""
        return bool(self.expected.expect) or self.expected.vehicles is not None

    @property
    def is_local(self) -> bool:
        """True if only services of this host count."""
        return self.services is None and not self.queries_vehicles


class _Check:
    """Replies of services and publishers, and their faults.

    `ages`: age of the newest message of each vehicle [s]. `outdated`: a line for each older service.
    """

    def __init__(self, bus: Bus, wanted: _Criteria) -> None:
        self._wanted = wanted
        self._routers = " or ".join(bus.routers)
        self._statuses = bus.services()
        if wanted.is_local:
            self._statuses = [status for status in self._statuses if status.host == _HOST]
        # a source occurs once for each of its vehicles
        self._sources = [source for status in self._statuses for source in status.sources]
        self._services = dict.fromkeys(status.service for status in self._statuses)
        self._source_names = {
            (status.service, source.source)
            for status in self._statuses
            for source in status.sources
        }
        self.outdated = describe_outdated(self._statuses)
        self._reports = bus.accounts(within=wanted.expected.within or 0.0)
        self._publishers = bus.publishers()
        self._answers: list[Sample[Message]] = []
        if wanted.queries_vehicles:
            self._answers = _query_vehicles(bus, wanted.expected)
        self._refused = {name for status in self._statuses for name in status.refused}
        self.ages = _ages_by_services(self._statuses)
        # the status also lists streams that the router's access rules drop
        self._is_refused = False
        if wanted.vehicle is not None:
            self._examine(wanted.vehicle)

    def _examine(self, vehicle: str) -> None:
        """Restrict `ages` to a vehicle that answers itself, and note if it does not although a service publishes it."""
        own = [sample for sample in self._answers if sample.vehicle == vehicle]
        age = self.ages.get(vehicle)
        is_published = age is not None or vehicle in self._refused
        self._is_refused = is_published and not own
        if age is None:
            latencies = [sample.latency for sample in own if sample.latency is not None]
            age = None
            if latencies:
                age = max(0.0, min(latencies))
        self.ages = {}
        if own and age is not None:
            self.ages[vehicle] = age

    def faults(self) -> list[str]:
        """Return all faults: at most one of the services, then those of the vehicles and of their history."""
        faults = []
        rules = (
            self._missing_service,
            self._refused_vehicles,
            self._failed_source,
            self._overload,
            self._missing_message,
            self._old_message,
        )
        for rule in rules:
            fault = rule()
            if fault is not None:
                faults.append(fault)
                break
        return [*faults, *self._faults_of_vehicles(), *self._faults_of_history()]

    def fields(self, faults: Sequence[str]) -> dict[str, object]:
        """Return the result as fields of a JSON object."""
        reason = None
        if faults:
            reason = faults[0]
        return {
            "healthy": not faults,
            "reason": reason,
            "services": len(self._services),
            "sources": len(self._source_names),
            "vehicles": self.ages,
            "faults": faults,
        }

    def summary(self) -> str:
        """Return the result without faults as one line."""
        services = counted(len(self._services), "service")
        sources = counted(len(self._source_names), "source")
        vehicles = counted(len(self.ages), "vehicle")
        age = "of unknown age"
        if self.ages:
            age = f"{format_duration(min(self.ages.values()))} old"
        return f"{services}, {sources}, {vehicles}, newest message {age}"

    def _missing_service(self) -> str | None:
        number = len(self._services)
        required = self._wanted.services
        if required is not None and number < required:
            return f"{number} of {required} services answer at {self._routers}"
        if self._wanted.is_local and not number:
            hint = "to accept other hosts, use --services 1"
            return f"no service of {_HOST} answers at {self._routers}: {hint}"
        return None

    def _refused_vehicles(self) -> str | None:
        if self._wanted.vehicle is not None or not self._refused:
            return None
        refused = sorted({to_text(name, 64) for name in self._refused})
        names = ", ".join(refused)[: limits.PEER_TEXT]
        noun = f"vehicle{plural(len(refused))}"
        return f"the router refuses messages of {noun} {names}: allow them in its access rules"

    def _failed_source(self) -> str | None:
        if self._wanted.vehicle is not None:
            return None
        for source in self._sources:
            if source.state in ("retrying", "failed"):
                error = to_text(source.error, limits.PEER_TEXT)
                return f"{to_text(source.source)} is {to_text(source.state)}: {error}"
        return None

    def _overload(self) -> str | None:
        for source in self._sources:
            if source.overload:
                return f"{to_text(source.source)}: {to_text(source.overload, limits.PEER_TEXT)}"
        return None

    def _missing_message(self) -> str | None:
        """Return that there is no message of the examined vehicle, or of any."""
        vehicle = self._wanted.vehicle
        if self.ages:
            return None
        if vehicle is None:
            if self._wanted.queries_vehicles:
                return None  # the faults of vehicles name those that are missing
            return f"no vehicle is published{self._source_states()}"
        missing = f"vehicle {vehicle} is not published"
        if self._is_refused:
            return missing + _REFUSED
        others = sorted({address.vehicle for address in self._publishers} - {vehicle})
        if others:
            missing += f" (published: {', '.join(others[: limits.SHOWN_NAMES])})"
        return missing + self._source_states()

    def _source_states(self) -> str:
        """Return the states of the sources as the end of a sentence."""
        states = [
            f"{to_text(source.source, 60)} is {to_text(source.state, 20)}"
            for source in self._sources
        ]
        if not states:
            return ""
        text = ", ".join(dict.fromkeys(states))
        return f": {text[: limits.PEER_TEXT]}"

    def _old_message(self) -> str | None:
        if not self.ages:
            return None
        vehicle = min(self.ages, key=self.ages.__getitem__)
        age = self.ages[vehicle]
        limit = self._wanted.max_age
        if age <= limit:
            return None
        return f"the newest message is {format_duration(age)} old, from vehicle {vehicle}: the limit is {limit:g} s"

    def _faults_of_vehicles(self) -> Iterator[str]:
        """Yield the faults of vehicles that services report, and of vehicles that answer without a service."""
        wanted = self._wanted
        for name in self._shared_vehicles():
            yield f"vehicle {name} has several publishers: stop one, or give it another vehicle id"
        unreported = AccountReport("", _HOST, 0.0, _reports_of(self._unreported_answers()))
        host = None
        if wanted.is_local:
            host = _HOST
        faults = faults_of([*self._reports, unreported], wanted.expected, only=host)
        faults += self._faults_of_answers(faults)
        for fault in faults:
            # `_missing_message` reports it
            if wanted.vehicle and fault.startswith(f"vehicle {wanted.vehicle} is missing"):
                continue
            yield fault

    def _shared_vehicles(self) -> list[str]:
        """Return the examined vehicles that have an address with several publishers."""
        shared = {address.vehicle for address, count in self._publishers.items() if count > 1}
        if self._wanted.is_local or self._wanted.vehicle is not None:
            shared.intersection_update(self.ages)
        if self._wanted.expected.expect:
            shared.intersection_update(self._wanted.expected.expect)
        return sorted(shared)

    def _unreported_answers(self) -> Iterator[Sample[Message]]:
        """Yield the recent messages of vehicles that no service reports."""
        reported = {name for report in self._reports for name in report.vehicles}
        for sample in self._answers:
            is_recent = sample.latency is None or sample.latency <= self._wanted.max_age
            if is_recent and sample.vehicle not in reported:
                yield sample

    def _faults_of_answers(self, known: Sequence[str]) -> list[str]:
        """Return faults of expected vehicles that their own answers and tokens show, beyond the `known` ones."""
        expected = self._wanted.expected
        alive = {address.vehicle for address in self._publishers}
        answered = {sample.vehicle for sample in self._answers}
        faults = []
        for name in expected.expect:
            beginnings = f"vehicle {name}: ", f"vehicle {name} "
            if any(fault.startswith(beginnings) for fault in known):
                continue
            if self._publishers.complete and name not in alive:
                faults.append(
                    f"vehicle {name} is missing: it has no publisher, although a service reports it"
                )
                continue
            if name not in answered:
                faults.append(f"vehicle {name} does not answer a query for its last messages")
                continue
            own = _reports_of(sample for sample in self._answers if sample.vehicle == name)
            alone = replace(expected, expect=(name,), vehicles=None)
            faults += faults_of([AccountReport("", _HOST, 0.0, own)], alone)
        return faults

    def _faults_of_history(self) -> Iterator[str]:
        """Yield the services whose history is not used, or that keep none."""
        expected = self._wanted.expected
        # else the vehicles are asked, and an unrelated service is no fault of theirs
        if not expected.expect:
            yield from self.outdated
        if not expected.valid and expected.within is None:
            return
        with_history = {report.service for report in self._reports}
        outdated = {status.service for status in self._statuses if status.is_outdated}
        for service in self._services:
            if service not in with_history | outdated:
                yield f"service {to_text(service, 64)} keeps no event history: update nedbus on its host"


def _query_vehicles(bus: Bus, expected: Expectation) -> list[Sample[Message]]:
    """Return the last messages that publishers still have: those of the only expected vehicle, else of all."""
    vehicle = ANY
    if expected.vehicles is None and len(expected.expect) == 1:
        vehicle = expected.expect[0]
    return [sample for sample in bus.latest(ANY, vehicle=vehicle) if not sample.stored]


def _ages_by_services(statuses: Iterable[ServiceStatus]) -> dict[str, float]:
    """Return the age of the newest message of each vehicle [s], as measured by the services that publish it."""
    ages: dict[str, float] = {}
    for status in statuses:
        published = {address for source in status.sources for address in source.addresses}
        for stream in status.own_streams:
            age = stream.health.age
            if age is not None and stream.address in published:
                ages[status.vehicle] = min(age, ages.get(status.vehicle, age))
    return ages


def _reports_of(answers: Iterable[Sample[Message]]) -> dict[str, VehicleReport]:
    """Return a report on each vehicle from its own last messages."""
    reports: dict[str, VehicleReport] = {}
    for sample in answers:
        report = VehicleReport("info", "ok", has_position=True)
        if sample.topic == DEFAULT_TOPIC:
            unknown = tuple(flag for flag in VALID.values() if flag in sample.missing)
            known = [flag for flag in VALID.values() if flag not in unknown]
            invalid = [flag for flag in known if not getattr(sample.message, flag)]
            flags = dict.fromkeys(invalid)
            reports[sample.vehicle] = replace(report, flags=flags, unknown=unknown)
        reports.setdefault(sample.vehicle, report)
    return reports
