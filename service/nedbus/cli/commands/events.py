"""Commands for vehicle events and their causes: events, why."""

import json
import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from nedbus import clock
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
from nedbus.cli.output.streams import csv_line, to_text, write, write_stderr
from nedbus.cli.output.table import fold
from nedbus.errors import ConfigError, NedbusError
from nedbus.flights import FileEvents, read_file_events
from nedbus.vehicle_events import (
    SEVERITIES,
    WINDOW,
    Event,
    Story,
    Times,
    Verdict,
    by_vehicle,
    events_outside,
    format_duration,
    once_per_service,
    report_of,
    verdict_of,
)
from nedbus_msgs import ANY, Selection, check_vehicle

if TYPE_CHECKING:
    from nedbus.client import Bus

_HEAD: Final = (
    "time", "clock", "boot", "vehicle", "severity", "kind", "change", "text", "topic", "lasted", "evidence", "numbers",
    "author",
)  # fmt: skip
_MAX_TEXT: Final = 400  # characters of a peer's text
_WITHIN: Final = "First show the events of the last SECONDS"
_ORIGIN: Final = "PX4's own log messages, or events derived by nedbus"
_AT: Final = "14:05:12 (UTC), 123.4 (s since boot) or +12.3 (s since the start of the recording)"
_LOSS_KINDS: Final = frozenset({"lost", "dropout"})
_LOSS_QUERY: Final = 5.0  # s between queries of the services for losses
_LOSS_TIMEOUT: Final = 1.0  # s
_LOSS_WINDOW: Final = 60.0  # s; a loss is reported up to 25 s after it began
_DAY: Final = 86_400.0


@command
def events(
    open_bus: OpenBus,
    files: FilesArgument = None,
    *,
    vehicle: VehiclesOption = None,
    within: Annotated[float | None, typer.Option(metavar="SECONDS", min=0.0, help=_WITHIN)] = None,
    severity: Annotated[str, typer.Option(metavar="bad|watch|info", help="Lowest severity to show")] = "info",
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
    selection = Selection(ANY, vehicle or ANY)
    for option, value, choices in (("--severity", severity, SEVERITIES), ("--origin", origin, ("px4", "nedbus", ANY))):
        if value not in choices:
            raise ConfigError(option, f"{value!r}: expected {' or '.join(choices)}")
    severities = SEVERITIES[: SEVERITIES.index(severity) + 1]
    form = (lambda *each: json.dumps(_to_fields(*each))) if json_output else _to_csv if csv_output else to_line

    def begin(times: Times, clocks: set[str]) -> None:
        if csv_output:
            write(csv_line(_HEAD))
        elif clocks and not json_output:
            write_stderr(f"times: {times.describe(clocks)}")

    def select(found: Iterable[Event]) -> list[Event]:
        chosen = [event for event in found if event.severity in severities and origin in (ANY, event.origin)]
        return [event for event in chosen if event.vehicle == ANY or selection.matches_vehicle(event.vehicle)]

    def show(found: Iterable[Event], times: Times) -> None:
        for event in select(found):
            write(form(event, times))

    if not files:
        begin(times := Times(is_live=True), {"host"})
        with open_bus() as bus:
            if within is not None:
                reports = [
                    report
                    for report in bus.accounts(within=within)
                    if not report.vehicles or any(map(selection.matches_vehicle, report.vehicles))
                ]
                show([event for _, event in once_per_service(reports)], times)
            _follow(bus, selection, lambda found: show(found, times), duration)
        return
    if within is not None or duration is not None:
        raise ConfigError("--within" if within is not None else "--duration", "needs live vehicles, not a file")
    read, found = _read(files)
    _require_vehicles(_name(files), read.event_log.vehicles, vehicle or ())
    found = select(found)
    unknown = {"boot"} if read.times.remarks.keys() - read.times.offsets.keys() else set()
    begin(read.times, {read.times.clock(event) for event in found} or unknown)
    show(found, read.times)
    vehicles = sorted(each for each in read.event_log.vehicles.items() if selection.matches_vehicle(each[0]))
    if texts := [f"{name}: {held}, throughout the file" for name, each in vehicles if (held := each.held_from_start)]:
        write_stderr("\n".join(texts))
    elif not found:
        limit = "" if severity == SEVERITIES[-1] else f" of severity {severity}"
        write_stderr(f"{_name(files)}: no events{limit} in {read.end:.0f} s")


@command
def why(
    open_bus: OpenBus,
    files: FilesArgument = None,
    *,
    vehicle: VehiclesOption = None,
    at: Annotated[str | None, typer.Option(metavar="TIME", help=_AT)] = None,
    details: Annotated[bool, typer.Option("--all", help="Show all faults with their evidence")] = False,
    json_output: JsonOption = False,
) -> None:
    """Show the verdict on each vehicle, live or from a file: usable or not, since when, for how long, and why.

    --all shows start, duration and possible causes of each fault: events of the ten seconds before it, conditions that
    were already active, and missing topics that might explain it, with a hint. Live verdicts use the event history of
    the nedbus services. Exits with 0 even if there are faults.
    """
    if files:
        read, found = _read(files)
        reports, times = [report_of(read.event_log, "", "", read.end, within=math.inf)], read.times
        where, advice = _name(files), _ADVICE.get(files[0].suffix.lower(), _LIVE_ADVICE)
    else:
        with open_bus() as bus:
            reports = bus.accounts(within=_DAY)
            published = bus.vehicles()
            routers = " or ".join(bus.routers)
            absence = "" if by_vehicle(reports) else _explain_absence(bus)
        found = _in_order(event for report in reports for event in report.events)
        times, where, advice = Times(is_live=True), "the history of the services", _LIVE_ADVICE
    reporting, faults, texts = by_vehicle(reports), 0, list[str]()
    for name in vehicle or ():
        if not files and name in published and name not in reporting:
            hint = f"follow it with 'nedbus events --vehicle {name}'"
            raise NedbusError(f"vehicle {name} is published, but no nedbus service keeps its event history: {hint}")
    if not files and not reporting:
        raise NedbusError(f"no nedbus service at {routers} has data on any vehicle: {absence}")
    _require_vehicles(where, reporting, vehicle or ())
    for name in vehicle or reporting:
        events = [event for event in found if event.vehicle in (name, ANY)]
        known, end = reporting[name].vehicles[name], reporting[name].now
        try:
            moment = None if at is None or not events else times.find(at, events[-1])
        except ValueError as exc:
            raise ConfigError("--at", f"{at!r}: {exc}: expected {_AT}") from exc
        verdict = verdict_of(
            name, events, known.held, topics=known.topics, unknown=known.unknown, times=times, end=end, at=moment,
            since=known.first,
        )  # fmt: skip
        if json_output:
            write(json.dumps({"vehicle": name} | _verdict_fields(verdict, times)))
            continue
        faults += len(verdict.stories)
        texts.append(fold(f"{name}: ", to_text(verdict.text, _MAX_TEXT)))
        if details:
            texts += ["\n".join(_describe(name, story, times, end, advice)) for story in verdict.stories]
            if other := events_outside(verdict.stories, events):
                texts.append("\n".join([f"{name}: other texts", *(_timed(event, times) for event in other)]))
    if texts:
        write(("\n\n" if details else "\n").join(texts))
    if faults and not details:
        write_stderr(f"--all shows {faults} fault{'s' * (faults > 1)} in detail")


def _explain_absence(bus: "Bus") -> str:
    from nedbus.cli.absence import explain_absence  # loads Zenoh, which files do not need

    return explain_absence(bus, ()).reason


def _describe(vehicle: str, story: Story, times: Times, end: float, advice: str) -> Iterator[str]:
    yield fold(f"{vehicle}: ", f"{to_text(story.what, _MAX_TEXT)} {story.when(times, end)}")
    sections = {"evidence": story.before, "meanwhile": story.meanwhile}
    if story.end is not None:
        sections[f"ended at {times.text(story.end)}{' with' * bool(story.after)}"] = story.after
    for title, shown in sections.items():
        if shown or title.startswith("ended"):
            yield f"  {title}"
        for each in shown:
            yield _timed(each, times, story.since if title == "evidence" else None)
    if not (story.before or story.meanwhile) and story.begin is not None:
        yield f"  no evidence in the {WINDOW:.0f} s before it"
    if story.lacking:
        yield fold("  ", f"missing topics that may explain it: {', '.join(story.lacking)}; {advice}")


_LIVE_ADVICE: Final = (
    "to publish them, add them to PX4's dds_topics.yaml or pub.csv, and to topics= of the source if it is set"
)
_ADVICE: Final = {
    ".ulg": "PX4 1.14 and later log them by default (SDLOG_PROFILE, bit 0)",
    ".mcap": "to record them, run 'nedbus record' without --topic while a source publishes them",
}


def to_line(event: Event, times: Times) -> str:
    """Format an event as one line: time, vehicle, severity, text and evidence."""
    evidence = ", ".join(_before(each, event.time) for each in event.evidence)
    because = f"  <- {evidence}" if event.evidence and event.severity != "info" else ""
    severity = "" if event.severity == "info" else event.severity.upper()
    return fold(f"{times.text(event):>10}  {to_text(event.vehicle):<8} {severity:<5}  ", f"{_shown(event)}{because}")


def _shown(event: Event) -> str:
    return to_text(event.words, _MAX_TEXT)


def _timed(event: Event, times: Times, since: float | None = None) -> str:
    return fold(f"    {times.text(event)}  ", _shown(event) if since is None else _before(event, since))


def _before(event: Event, time: float) -> str:
    """Format an event with its distance from a time, which it may explain."""
    distance = format_duration(abs(time - event.time))
    return f"{_shown(event)} ({distance} {'before' if event.time <= time else 'after'})"


def _follow(
    bus: "Bus", selection: Selection, show: Callable[[Iterable[Event]], object], duration: float | None
) -> None:
    from nedbus.cli.follow import follow
    from nedbus.monitoring import Observer

    observer, seen = Observer(bus, selection), 0
    known: set[str] = set()
    losses = _LinkLosses(bus)

    def show_new() -> None:
        nonlocal seen
        observer.poll()
        new, seen = observer.event_log.events_since(seen)
        show(event.later(clock.to_utc()) for event in new)
        show(losses.poll())
        known.intersection_update(observer.event_log.vehicles)
        for name, each in list(observer.event_log.vehicles.items()):
            if name not in known and each.main is not None:
                known.add(name)
                if initial := each.held_from_start:
                    write_stderr(f"{name}: {initial}, from the start")

    with observer.subscription as subscription:
        follow(bus, subscription, observer.add, count=None, duration=duration, each_second=show_new)


class _LinkLosses:
    """Losses on the links of vehicles and logging dropouts: only the services that receive the vehicles know them."""

    def __init__(self, bus: "Bus") -> None:
        self._bus = bus
        self._shown: set[tuple[object, ...]] = set()
        self._next_query = 0.0
        self.poll()  # earlier ones are shown by --within

    def poll(self) -> list[Event]:
        """Return what the services have reported since the last call; ask them at most every 5 s."""
        now = time.monotonic()
        if now < self._next_query:
            return []
        self._next_query = now + _LOSS_QUERY
        found = {
            (report.service, event.vehicle, *event.identity): _on_link(event, report.service)
            for report in self._bus.accounts(within=_LOSS_WINDOW, timeout=_LOSS_TIMEOUT)
            for event in report.events
            if event.kind in _LOSS_KINDS
        }
        new = [event for key, event in found.items() if key not in self._shown]
        self._shown |= found.keys()
        return _in_order(new)


def _on_link(event: Event, service: str) -> Event:
    return replace(event, text=f"{event.text}, on the link to the service {service}")


def _name(files: Sequence[Path]) -> str:
    return ", ".join(map(str, files))


def _read(files: Sequence[Path]) -> tuple[FileEvents, list[Event]]:
    read = read_file_events(*files)
    found, total = read.event_log.events_since(0)
    for warning in read.warnings:
        write_stderr(warning)
    if total > len(found):
        write_stderr(f"{_name(files)}: showing the last {len(found)} of {total} events")
    return read, _in_order(found)


def _in_order(events: Iterable[Event]) -> list[Event]:
    return sorted(events, key=lambda event: event.time)


def _to_fields(event: Event, times: Times) -> dict[str, object]:
    utc = times.utc(event)
    time = None if utc is None else datetime.fromtimestamp(utc, UTC).isoformat(timespec="milliseconds")
    evidence = [
        {"kind": each.kind, "change": each.change, "text": each.text, "topic": each.topic,
         "before": round(event.time - each.time, 3)}
        for each in event.evidence
    ]  # fmt: skip
    return {"time": time, "clock": times.clock(event)} | asdict(event) | {"time": time, "evidence": evidence}


def _to_csv(event: Event, times: Times) -> str:
    fields = _to_fields(event, times)
    fields["evidence"] = "; ".join(f"{each.kind} {event.time - each.time:.1f} s" for each in event.evidence)
    fields["numbers"] = json.dumps(dict(event.numbers)) if event.numbers else ""
    return csv_line([fields[name] for name in _HEAD])


def _verdict_fields(verdict: Verdict, times: Times) -> dict[str, object]:
    def fields(events: Iterable[Event | None]) -> list[dict[str, object] | None]:
        return [None if event is None else _to_fields(event, times) for event in events]

    faults = [
        {
            "what": each.what, "begin": fields([each.begin])[0], "end": fields([each.end])[0],
            "lasted": None if each.until is None else each.until - each.since, "before": fields(each.before),
            "meanwhile": fields(each.meanwhile), "after": fields(each.after), "lacking": each.lacking,
        }
        for each in verdict.stories
    ]  # fmt: skip
    begin, end = fields([verdict.begin, verdict.end])
    head = {"text": verdict.text, "usable": verdict.usable, "begin": begin, "end": end, "cause": fields(verdict.cause)}
    return {"verdict": head, "faults": faults}


def _require_vehicles(where: object, names: Collection[str], vehicles: Collection[str]) -> None:
    for vehicle in vehicles:
        if vehicle in names:
            continue
        check_vehicle(vehicle)
        known = to_text(", ".join(sorted(names)[:20]), _MAX_TEXT)
        raise ConfigError("--vehicle", f"no vehicle {vehicle} in {where}{known and f': choose one of {known}'}")
