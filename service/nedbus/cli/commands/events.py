"""Commands for vehicle events and their causes: events, why."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

import nedbus
from nedbus import limits
from nedbus.cli.options import (
    CsvOption,
    DurationOption,
    FilesArgument,
    JsonOption,
    OpenBus,
    VehiclesOption,
    allow_one,
    command,
)
from nedbus.cli.output.events import (
    CSV_HEAD,
    describe_stories,
    describe_verdict,
    to_csv,
    to_json,
    to_line,
    verdict_json,
)
from nedbus.cli.output.streams import csv_line, to_text, write, write_stderr
from nedbus.errors import ArgumentError, ConfigError, NedbusError
from nedbus.health import SEVERITIES, Event, EventHistory, Times, Verdict
from nedbus_msgs import ANY, Selection, check_vehicle
from nedbus_msgs.text import counted

if TYPE_CHECKING:
    from nedbus import Bus
    from nedbus.health import LiveEvents

_WITHIN: Final = "First show the events of the last SECONDS"
_ORIGIN: Final = "PX4's own log messages, or events derived by nedbus"
_AT: Final = "14:05:12 (UTC), 123.4 (s since boot) or +12.3 (s since the start of the recording)"
_ORIGINS: Final = ("px4", "nedbus", ANY)
_LIVE_ADVICE: Final = (
    "to publish them, add them to PX4's dds_topics.yaml or pub.csv, "
    "and to topics= of the source if it is set"
)
_ADVICE: Final = {
    ".ulg": "PX4 1.14 and later log them by default (SDLOG_PROFILE, bit 0)",
    ".mcap": (
        "to record them, run 'nedbus record' without --topic while a source publishes them; "
        "to have them in a converted log, run 'nedbus convert --topics \"*\"' with the log"
    ),
}


@command
def events(
    open_bus: OpenBus,
    files: FilesArgument = None,
    *,
    vehicle: VehiclesOption = None,
    within: Annotated[float | None, typer.Option(metavar="SECONDS", min=0.0, help=_WITHIN)] = None,
    severity: Annotated[
        str, typer.Option(metavar="bad|watch|info", help="Lowest severity to show")
    ] = "info",
    origin: Annotated[str, typer.Option(metavar="px4|nedbus", help=_ORIGIN)] = ANY,
    json_output: JsonOption = False,
    csv_output: CsvOption = False,
    duration: DurationOption = None,
) -> None:
    """Show vehicle events and their evidence, live or from a file.

    Events are PX4's own log messages, and those derived from messages: validity, dead reckoning, resets, origin, GPS,
    fusion, failsafe, mode, arming, landing, battery, reboot, silence, loss, rejected messages and the link. The
    evidence of an event is earlier events that may explain it: those of the ten seconds before it, and those whose
    condition is still active. Live events are shown until Ctrl-C.
    """
    allow_one({"--json": json_output, "--csv": csv_output})
    if severity not in SEVERITIES:
        raise ConfigError("--severity", f"{severity!r}: expected {' or '.join(SEVERITIES)}")
    if origin not in _ORIGINS:
        raise ConfigError("--origin", f"{origin!r}: expected {' or '.join(_ORIGINS)}")
    form = to_line
    if json_output:
        form = to_json
    if csv_output:
        form = to_csv
    printer = _Printer(Selection(ANY, vehicle or ANY), severity, origin, form)
    if not files:
        with open_bus() as bus:
            _show_live(bus, printer, within, duration)
        return
    if within is not None:
        raise ConfigError("--within", "needs live vehicles, not a file")
    if duration is not None:
        raise ConfigError("--duration", "needs live vehicles, not a file")
    history = _read(files)
    _require_vehicles(_name(files), history.vehicles, vehicle or ())
    _show_history(history, printer, _name(files))


@dataclass(frozen=True, slots=True)
class _Printer:
    """What the options of `events` select, and the format of a line."""

    selection: Selection
    severity: str
    origin: str
    form: Callable[[Event, Times], str]

    def begin(self, times: Times, clocks: set[str]) -> None:
        """Write the header of CSV; of lines, the clocks of their times."""
        if self.form is to_csv:
            write(csv_line(CSV_HEAD))
        if self.form is to_line and clocks:
            write_stderr(f"times: {times.describe(clocks)}")

    def show(self, events: Iterable[Event], times: Times) -> None:
        """Write the selected events."""
        for event in self.select(events):
            write(self.form(event, times))

    def select(self, events: Iterable[Event]) -> list[Event]:
        """Return the events of these vehicles and of all, of this origin, and at least as severe."""
        return [event for event in events if self._is_selected(event)]

    def _is_selected(self, event: Event) -> bool:
        if SEVERITIES.index(event.severity) > SEVERITIES.index(self.severity):
            return False
        if self.origin not in (ANY, event.origin):
            return False
        return event.vehicle == ANY or self.selection.matches_vehicle(event.vehicle)


def _show_live(bus: "Bus", printer: _Printer, within: float | None, duration: float | None) -> None:
    """Show the events of the last `within` seconds, then new ones until `duration` [s] has passed."""
    with nedbus.events(bus, vehicle=printer.selection.vehicles, within=within) as live:
        printer.begin(live.times, {"host"})
        if within is not None:
            printer.show(live.poll(), live.times)  # before the first message arrives
        _follow(bus, live, printer, duration)


def _follow(bus: "Bus", live: "LiveEvents", printer: _Printer, duration: float | None) -> None:
    from nedbus.cli.follow import follow

    known: set[str] = set()

    def show_new() -> None:
        printer.show(live.poll(), live.times)
        from_start = live.from_start
        known.intersection_update(from_start)
        for name, text in from_start.items():
            if name not in known and text:
                write_stderr(f"{name}: {text}, from the start")
        known.update(from_start)

    follow(bus, live.subscription, live.add, count=None, duration=duration, each_second=show_new)


def _show_history(history: EventHistory, printer: _Printer, where: str) -> None:
    """Show the events of files, then the conditions that are active throughout."""
    times = history.times
    events = printer.select(history)
    clocks = {times.clock(event) for event in events}
    if not clocks and times.remarks.keys() - times.offsets.keys():
        clocks = {"boot"}
    printer.begin(times, clocks)
    printer.show(events, times)
    lines = [
        f"{name}: {text}, throughout the file"
        for name, text in history.from_start.items()
        if printer.selection.matches_vehicle(name)
    ]
    if lines:
        write_stderr("\n".join(lines))
    elif not events:
        limit = ""
        if printer.severity != SEVERITIES[-1]:
            limit = f" of severity {printer.severity}"
        write_stderr(f"{where}: no events{limit} in {history.end:.0f} s")


@command
def why(
    open_bus: OpenBus,
    files: FilesArgument = None,
    *,
    vehicle: VehiclesOption = None,
    at: Annotated[str | None, typer.Option(metavar="TIME", help=_AT)] = None,
    details: Annotated[
        bool, typer.Option("--all", help="Show all faults with their evidence")
    ] = False,
    json_output: JsonOption = False,
) -> None:
    """Show the verdict on each vehicle, live or from a file: usable or not, since when, for how long, and why.

    --all shows start, duration and possible causes of each fault: events of the ten seconds before it, conditions that
    were already active, and missing topics that might explain it, with a hint. Live verdicts use the event history of
    the nedbus services. Exits with 0 even if there are faults.
    """
    names = vehicle or ()
    if files:
        history = _read(files)
        where = _name(files)
        advice = _ADVICE.get(files[0].suffix.lower(), _LIVE_ADVICE)
    else:
        with open_bus() as bus:
            history = _query(bus, names)
        where = "the history of the services"
        advice = _LIVE_ADVICE
    _require_vehicles(where, history.vehicles, names)
    verdicts = [_verdict(history, name, at) for name in names or history.vehicles]
    if json_output:
        for verdict in verdicts:
            write(verdict_json(verdict))
        return
    if details:
        paragraphs = []
        for verdict in verdicts:
            paragraphs += [describe_verdict(verdict), *describe_stories(verdict, advice)]
        if paragraphs:
            write("\n\n".join(paragraphs))
        return
    for verdict in verdicts:
        write(describe_verdict(verdict))
    faults = sum(len(verdict.stories) for verdict in verdicts)
    if faults:
        write_stderr(f"--all shows {counted(faults, 'fault')} in detail")


def _verdict(history: EventHistory, vehicle: str, at: str | None) -> Verdict:
    try:
        return history.why(vehicle, at=at)
    except ArgumentError as exc:
        raise ConfigError("--at", f"{at!r}: {exc.__cause__}: expected {_AT}") from exc


def _query(bus: "Bus", vehicles: Sequence[str]) -> EventHistory:
    """Return the history of the services; name published vehicles of which there is none."""
    from nedbus.cli.absence import explain_absence  # loads Zenoh, which files do not need

    history = bus.history()
    unreported = [name for name in bus.vehicles() if name not in history.vehicles]
    for name in vehicles:
        if name in unreported:
            _name_outdated(bus)
            hint = f"follow it with 'nedbus events --vehicle {name}'"
            raise NedbusError(
                f"vehicle {name} is published, but no nedbus service keeps its event history: {hint}"
            )
    if not history.vehicles:
        routers = " or ".join(bus.routers)
        reason = explain_absence(bus, ()).reason
        raise NedbusError(f"no nedbus service at {routers} has data on any vehicle: {reason}")
    if unreported and not vehicles:
        names = to_text(", ".join(unreported), limits.LINE_TEXT)
        write_stderr(
            f"no verdict on {names}: published, but no nedbus service keeps the event history"
        )
        _name_outdated(bus)
    return history


def _name_outdated(bus: "Bus") -> None:
    from nedbus.cli.absence import describe_outdated  # loads Zenoh, which files do not need

    for line in describe_outdated(bus.services()):
        write_stderr(line)


def _name(files: Sequence[Path]) -> str:
    return ", ".join(map(str, files))


def _read(files: Sequence[Path]) -> EventHistory:
    history = nedbus.events(files)
    for warning in history.warnings:
        write_stderr(warning)
    if history.dropped:
        total = history.dropped + len(history)
        write_stderr(f"{_name(files)}: showing the last {len(history)} of {total} events")
    return history


def _require_vehicles(where: str, names: Collection[str], vehicles: Sequence[str]) -> None:
    for vehicle in vehicles:
        if vehicle in names:
            continue
        check_vehicle(vehicle)
        reason = f"no vehicle {vehicle} in {where}"
        known = ", ".join(sorted(names)[: limits.SHOWN_NAMES])
        if known:
            reason = f"{reason}: choose one of {to_text(known, limits.LINE_TEXT)}"
        raise ConfigError("--vehicle", reason)
