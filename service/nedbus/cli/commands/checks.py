"""Commands that check: health for watchdogs, doctor for a running system, check for configuration files."""

import json
import socket
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Final

import typer

from nedbus import Bus, Sample, __version__, limits
from nedbus.cli.absence import describe_outdated
from nedbus.cli.options import JsonOption, command
from nedbus.cli.output.streams import to_text, write, write_stderr
from nedbus.cli.output.table import fold
from nedbus.clock import format_duration
from nedbus.doctor import check_router_file, check_service, examine, worst_state
from nedbus.errors import ConfigError, NedbusError
from nedbus.health import AccountReport, VehicleReport
from nedbus.settings import Settings
from nedbus.vehicle_events import VALID, Expectation, faults_of
from nedbus_msgs import ANY, DEFAULT_TOPIC, Message, check_vehicle
from nedbus_msgs.text import counted

_HOST: Final = socket.gethostname()
_REQUIRED: Final = "Require a message of this vehicle, from any publisher"
_WITHIN: Final = "Require no bad or watch event in the last SECONDS"
_EXAMINED: Final = "Examine only this vehicle; also test the write permission"
_LINK: Final = "Also listen on a MAVLink link, such as udpin:0.0.0.0:14540"
_RULES: Final = "Router's configuration: name the rules for this client's certificate"
_CONFIGS: Final = "Settings (.toml) or router files (.json5); default: the settings of serve"
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
    required = dict.fromkeys(
        [*_parse_names("--expect", expect), *([] if vehicle is None else [vehicle])]
    )
    for name in required:
        check_vehicle(name)
    estimates = _parse_names("--valid", valid)
    for estimate in estimates:
        if estimate not in VALID:
            raise ConfigError("--valid", f"{estimate!r}: expected a list of {', '.join(VALID)}")
    check = _Check(
        bus, vehicle, services, max_age, Expectation(tuple(required), vehicles, estimates, within)
    )
    faults = [*check.service_faults(), *check.vehicle_faults()]
    for remark in check.outdated:
        if remark not in faults:
            write_stderr(to_text(f"nedbus: {remark}", limits.LINE_TEXT))
    if json_output:
        counts = {
            "services": len(check.services),
            "sources": len(check.sources),
            "vehicles": check.ages,
        }
        write(
            json.dumps(
                {
                    "healthy": not faults,
                    "reason": faults[0] if faults else None,
                    **counts,
                    "faults": faults,
                }
            )
        )
    if faults:
        for fault in faults[:-1]:
            write_stderr(to_text(f"nedbus: {fault}", limits.LINE_TEXT))
        raise NedbusError(faults[-1])
    if not json_output:
        newest = (
            f"{format_duration(min(check.ages.values()))} old" if check.ages else "of unknown age"
        )
        services_text = counted(len(check.services), "service")
        sources_text = counted(len(check.sources), "source")
        vehicles_text = counted(len(check.ages), "vehicle")
        write(f"{services_text}, {sources_text}, {vehicles_text}, newest message {newest}")


def _parse_names(option: str, text: str | None) -> tuple[str, ...]:
    names = tuple(name.strip() for name in (text or "").split(",") if name.strip())
    if text is not None and not names:
        raise ConfigError(option, "the list is empty: check that the shell variable is set")
    return names


class _Check:
    """Replies of services and publishers, and their faults.

    `ages`: age of each vehicle's newest message [s]. `outdated`: a line for each older service.
    """

    def __init__(
        self,
        bus: Bus,
        vehicle: str | None,
        count: int | None,
        max_age: float,
        expected: Expectation,
    ) -> None:
        self._vehicle = vehicle
        self._count = count
        self._max_age = max_age
        self._expected = expected
        self._routers = " or ".join(bus.routers)
        self._is_local = count is None and not expected.expect and expected.vehicles is None
        self._statuses = [
            status for status in bus.services() if not self._is_local or status.host == _HOST
        ]
        self.services = dict.fromkeys(status.service for status in self._statuses)
        self.outdated = describe_outdated(self._statuses)
        self.sources = {
            (status.service, source.source)
            for status in self._statuses
            for source in status.sources
        }
        # A source occurs once for each of its vehicles.
        self._sources = [source for status in self._statuses for source in status.sources]
        self.ages: dict[str, float] = {}  # as measured by the services
        for status in self._statuses:
            published = {address for source in status.sources for address in source.addresses}
            for stream in status.own_streams:
                age = stream.health.age
                if age is not None and stream.address in published:
                    self.ages[status.vehicle] = min(age, self.ages.get(status.vehicle, age))
        self._reports = bus.accounts(within=expected.within or 0.0)
        self._known = {name for report in self._reports for name in report.vehicles}
        self._publishers = bus.publishers()
        self._answers: list[Sample[Message]] = []
        if expected.expect or expected.vehicles is not None:
            only = (
                expected.expect[0]
                if len(expected.expect) == 1 and expected.vehicles is None
                else ANY
            )
            self._answers = [
                sample for sample in bus.latest(ANY, vehicle=only) if not sample.stored
            ]
        # The status also lists streams that the router's access rules drop.
        self._is_refused = False
        if vehicle is not None:
            latencies = [sample.latency for sample in self._answers if sample.vehicle == vehicle]
            refused = {name for status in self._statuses for name in status.refused}
            self._is_refused = (vehicle in self.ages or vehicle in refused) and not latencies
            known = [max(0.0, latency) for latency in latencies if latency is not None]
            measured = min(known, default=None)
            newest = self.ages.get(vehicle, measured)
            self.ages = {vehicle: newest} if latencies and newest is not None else {}

    def service_faults(self) -> Iterator[str]:
        """Yield at most one fault: of a service or a source, or that the newest message is missing or too old."""
        refused = sorted(
            {to_text(name, 64) for status in self._statuses for name in status.refused}
        )
        failed = [source for source in self._sources if source.state in {"retrying", "failed"}]
        if self._count is not None and len(self.services) < self._count:
            yield f"{len(self.services)} of {self._count} services answer at {self._routers}"
        elif not self.services and self._is_local:
            yield f"no service of {_HOST} answers at {self._routers}: to accept other hosts, use --services 1"
        elif refused and self._vehicle is None:
            noun, names = "vehicle" if len(refused) == 1 else "vehicles", ", ".join(refused)[:300]
            yield f"the router refuses messages of {noun} {names}: allow them in its access rules"
        elif failed and self._vehicle is None:
            source = failed[0]
            yield f"{to_text(source.source)} is {to_text(source.state)}: {to_text(source.error, 300)}"
        elif overloaded := [source for source in self._sources if source.overload]:
            yield f"{to_text(overloaded[0].source)}: {to_text(overloaded[0].overload, 300)}"
        elif not self.ages and (
            self._vehicle is not None or not (self._expected.expect or self._expected.vehicles)
        ):
            texts = (
                f"{to_text(source.source, 60)} is {to_text(source.state, 20)}"
                for source in self._sources
            )
            states = ", ".join(dict.fromkeys(texts))
            others = sorted({address.vehicle for address in self._publishers} - {self._vehicle})[
                :20
            ]
            only = f" (published: {', '.join(others)})" if others and not self._is_refused else ""
            what = (
                f"vehicle {self._vehicle} is not published{only}"
                if self._vehicle
                else "no vehicle is published"
            )
            yield f"{what}{_REFUSED if self._is_refused else f': {states[:300]}' if states else ''}"
        elif self.ages and min(self.ages.values()) > self._max_age:
            name = min(self.ages, key=self.ages.__getitem__)
            age = format_duration(self.ages[name])
            yield f"the newest message is {age} old, from vehicle {name}: the limit is {self._max_age:g} s"

    def vehicle_faults(self) -> Iterator[str]:
        """Yield the faults of vehicles that services report, and of vehicles that answer without a service."""
        expected = self._expected
        others = [
            sample
            for sample in self._answers
            if sample.vehicle not in self._known
            and (sample.latency is None or sample.latency <= self._max_age)
        ]
        shared = {address.vehicle for address, count in self._publishers.items() if count > 1}
        for name in sorted(
            shared.intersection(self.ages if self._is_local or self._vehicle else shared)
        ):
            if not expected.expect or name in expected.expect:
                yield f"vehicle {name} has several publishers: stop one, or give it another vehicle id"
        reports = [*self._reports, AccountReport("", _HOST, 0.0, _reports_of(others))]
        faults = faults_of(reports, expected, only=_HOST if self._is_local else None)
        for fault in (*faults, *self._faults_of_answers(faults)):
            # reported above
            if self._vehicle is None or not fault.startswith(f"vehicle {self._vehicle} is missing"):
                yield fault
        yield from self._faults_of_history()

    def _faults_of_answers(self, known: Sequence[str]) -> Iterator[str]:
        """Yield faults of expected vehicles that their own answers and tokens show, beyond the `known` ones."""
        alive = {address.vehicle for address in self._publishers}
        answered = {sample.vehicle for sample in self._answers}
        for name in self._expected.expect:
            if any(fault.startswith(f"vehicle {name}") for fault in known):
                continue
            if self._publishers.complete and name not in alive:
                yield f"vehicle {name} is missing: it has no publisher, although a service reports it"
            elif name not in answered:
                yield f"vehicle {name} does not answer a query for its last messages"
            else:
                own = _reports_of(sample for sample in self._answers if sample.vehicle == name)
                asked = replace(self._expected, expect=(name,), vehicles=None)
                yield from faults_of([AccountReport("", _HOST, 0.0, own)], asked)

    def _faults_of_history(self) -> Iterator[str]:
        # else the vehicles are asked, and an unrelated service is no fault of theirs
        if not self._expected.expect:
            yield from self.outdated
        if self._expected.valid or self._expected.within is not None:
            with_history = {report.service for report in self._reports}
            outdated = {status.service for status in self._statuses if status.is_outdated}
            for service in self.services:
                if service not in with_history and service not in outdated:
                    yield f"service {to_text(service, 64)} keeps no event history: update nedbus on its host"


def _reports_of(answers: Iterable[Sample[Message]]) -> dict[str, VehicleReport]:
    """Return a report on each vehicle from its own last messages."""
    vehicles: dict[str, VehicleReport] = {}
    for sample in answers:
        if sample.topic == DEFAULT_TOPIC:
            unknown = tuple(sample.missing.intersection(VALID.values()))
            invalid = [
                flag
                for flag in VALID.values()
                if flag not in unknown and not getattr(sample.message, flag)
            ]
            flags = dict.fromkeys(invalid)
            vehicles[sample.vehicle] = VehicleReport(
                "info", "ok", flags=flags, has_position=True, unknown=unknown
            )
        vehicles.setdefault(sample.vehicle, VehicleReport("info", "ok", has_position=True))
    return vehicles


@command
def doctor(
    read_settings: Callable[[], Settings],
    *,
    vehicle: Annotated[str | None, typer.Option("--vehicle", "-v", help=_EXAMINED)] = None,
    mavlink: Annotated[str | None, typer.Option(metavar="LINK", help=_LINK)] = None,
    rules: Annotated[
        Path | None, typer.Option(metavar="FILE", help=_RULES, show_default=False)
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Diagnose why no messages arrive.

    Checks router, certificates, permissions, clocks, vehicles and MAVLink; lists the worst findings last.
    Takes a few seconds and changes nothing. Exits with 1 if the state of a finding is "wrong".
    """
    if vehicle is not None:
        check_vehicle(vehicle)
    findings = examine(
        read_settings(), version=__version__, vehicle=vehicle, mavlink=mavlink, rules=rules
    )
    state = worst_state(findings)
    if json_output:
        write(json.dumps({"state": state, "findings": [asdict(finding) for finding in findings]}))
    else:
        for finding in findings:
            name = f"{finding.check} {finding.subject}".rstrip(" :")
            write(
                fold(f"{finding.state:<8} ", to_text(f"{name}: {finding.seen}", limits.LINE_TEXT))
            )
            if finding.advice:
                write(fold(f"{'':<8} -> ", to_text(finding.advice, limits.LINE_TEXT)))
        counts = Counter(finding.state for finding in findings)
        write(f"\n{', '.join(f'{count} {name}' for name, count in counts.items())}")
    if state == "wrong":
        raise typer.Exit(1)


@command
def check(
    files: Annotated[
        list[Path] | None, typer.Argument(metavar="CONFIG", help=_CONFIGS, show_default=False)
    ] = None,
    *,
    offline: Annotated[
        bool, typer.Option("--offline", help="Check only the text of the files")
    ] = False,
) -> None:
    """Check settings and router files.

    Reports every mistake with file, line and column. Exits with 2 if there are any.
    """
    mistakes = [] if files else check_service(offline=offline)
    for file in files or ():
        is_toml = file.suffix == ".toml"
        if is_toml:
            mistakes += check_service(file, offline=offline)
        else:
            mistakes += check_router_file(file, offline=offline)
    report_mistakes(mistakes)


def report_mistakes(mistakes: Iterable[ConfigError]) -> None:
    """Write each mistake to stderr once; exit with 2 if there are any."""
    lines = dict.fromkeys(map(str, mistakes))
    for line in lines:
        write_stderr(f"nedbus: {line}")
    if lines:
        raise typer.Exit(2)
    write("no mistakes found")
