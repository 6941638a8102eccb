"""Commands for vehicle events and their causes: events, why."""

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
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
from nedbus.cli.output.streams import csv_line, to_text, write, write_stderr
from nedbus.cli.output.table import fold
from nedbus.clock import format_duration
from nedbus.errors import ArgumentError, ConfigError, NedbusError
from nedbus.health import SEVERITIES, Event, EventHistory, Story, Times, Verdict
from nedbus_msgs import ANY, Selection, check_vehicle
from nedbus_msgs.text import counted

if TYPE_CHECKING:
    from nedbus import Bus
    from nedbus.health import LiveEvents

_HEAD: Final = (
    "time", "clock", "boot", "vehicle", "severity", "kind", "change", "text", "topic", "lasted", "evidence", "numbers",
    "author",
)  # fmt: skip
_WITHIN: Final = "First show the events of the last SECONDS"
_ORIGIN: Final = "PX4's own log messages, or events derived by nedbus"
_AT: Final = "14:05:12 (UTC), 123.4 (s since boot) or +12.3 (s since the start of the recording)"


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
    selection = Selection(ANY, vehicle or ANY)
    for option, value, choices in (
        ("--severity", severity, SEVERITIES),
        ("--origin", origin, ("px4", "nedbus", ANY)),
    ):
        if value not in choices:
            raise ConfigError(option, f"{value!r}: expected {' or '.join(choices)}")
    severities = SEVERITIES[: SEVERITIES.index(severity) + 1]
    form = (
        (lambda *each: json.dumps(_to_fields(*each)))
        if json_output
        else _to_csv
        if csv_output
        else to_line
    )

    def begin(times: Times, clocks: set[str]) -> None:
        if csv_output:
            write(csv_line(_HEAD))
        elif clocks and not json_output:
            write_stderr(f"times: {times.describe(clocks)}")

    def select(found: Iterable[Event]) -> list[Event]:
        chosen = [
            event
            for event in found
            if event.severity in severities and origin in (ANY, event.origin)
        ]
        return [
            event
            for event in chosen
            if event.vehicle == ANY or selection.matches_vehicle(event.vehicle)
        ]

    def show(found: Iterable[Event], times: Times) -> None:
        for event in select(found):
            write(form(event, times))

    if not files:
        with open_bus() as bus, nedbus.events(bus, vehicle=vehicle or ANY, within=within) as live:
            begin(times := live.times, {"host"})
            if within is not None:
                show(live.poll(), times)  # before the first message arrives
            _follow(bus, live, lambda new: show(new, times), duration)
        return
    if within is not None or duration is not None:
        raise ConfigError(
            "--within" if within is not None else "--duration", "needs live vehicles, not a file"
        )
    history = _read(files)
    _require_vehicles(_name(files), history.vehicles, vehicle or ())
    selected = select(history)
    times = history.times
    unknown = {"boot"} if times.remarks.keys() - times.offsets.keys() else set()
    begin(times, {times.clock(event) for event in selected} or unknown)
    show(selected, times)
    initial = {
        name: text for name, text in history.from_start.items() if selection.matches_vehicle(name)
    }
    if initial:
        write_stderr(
            "\n".join(f"{name}: {text}, throughout the file" for name, text in initial.items())
        )
    elif not selected:
        limit = "" if severity == SEVERITIES[-1] else f" of severity {severity}"
        write_stderr(f"{_name(files)}: no events{limit} in {history.end:.0f} s")


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
    if files:
        history = _read(files)
        where, advice = _name(files), _ADVICE.get(files[0].suffix.lower(), _LIVE_ADVICE)
    else:
        with open_bus() as bus:
            history = bus.history()
            published = bus.vehicles()
            _require_history(bus, history, published, vehicle or ())
            if not vehicle:
                _name_unreported(bus, [name for name in published if name not in history.vehicles])
        where, advice = "the history of the services", _LIVE_ADVICE
    _require_vehicles(where, history.vehicles, vehicle or ())
    faults, texts = 0, list[str]()
    for name in vehicle or history.vehicles:
        verdict = _verdict(history, name, at)
        if json_output:
            write(json.dumps({"vehicle": name} | _verdict_fields(verdict)))
            continue
        faults += len(verdict.stories)
        texts.append(fold(f"{name}: ", to_text(verdict.text, limits.LINE_TEXT)))
        if details:
            texts += ["\n".join(_describe(verdict, story, advice)) for story in verdict.stories]
            if verdict.others:
                lines = [_timed(event, verdict.times) for event in verdict.others]
                texts.append("\n".join([f"{name}: other texts", *lines]))
    if texts:
        write(("\n\n" if details else "\n").join(texts))
    if faults and not details:
        write_stderr(f"--all shows {counted(faults, 'fault')} in detail")


def _verdict(history: EventHistory, vehicle: str, at: str | None) -> Verdict:
    try:
        return history.why(vehicle, at=at)
    except ArgumentError as exc:
        raise ConfigError("--at", f"{at!r}: {exc.__cause__}: expected {_AT}") from exc


def _require_history(
    bus: "Bus", history: EventHistory, published: Collection[str], vehicles: Collection[str]
) -> None:
    for name in vehicles:
        if name in published and name not in history.vehicles:
            _name_outdated(bus)
            hint = f"follow it with 'nedbus events --vehicle {name}'"
            raise NedbusError(
                f"vehicle {name} is published, but no nedbus service keeps its event history: {hint}"
            )
    if not history.vehicles:
        from nedbus.cli.absence import explain_absence  # loads Zenoh, which files do not need

        routers = " or ".join(bus.routers)
        reason = explain_absence(bus, ()).reason
        raise NedbusError(f"no nedbus service at {routers} has data on any vehicle: {reason}")


def _name_unreported(bus: "Bus", vehicles: Sequence[str]) -> None:
    """Name vehicles that are published, but about which no service reports, and older services."""
    if vehicles:
        names = to_text(", ".join(vehicles), limits.LINE_TEXT)
        write_stderr(
            f"no verdict on {names}: published, but no nedbus service keeps the event history"
        )
        _name_outdated(bus)


def _name_outdated(bus: "Bus") -> None:
    from nedbus.cli.absence import describe_outdated  # loads Zenoh, which files do not need

    for line in describe_outdated(bus.services()):
        write_stderr(line)


def _describe(verdict: Verdict, story: Story, advice: str) -> Iterator[str]:
    times = verdict.times
    yield fold(
        f"{verdict.vehicle}: ", f"{to_text(story.what, limits.LINE_TEXT)} {verdict.period(story)}"
    )
    sections = {"evidence": story.before, "meanwhile": story.meanwhile}
    if story.end is not None:
        with_events = " with" if story.after else ""
        sections[f"ended at {times.text(story.end)}{with_events}"] = story.after
    for title, shown in sections.items():
        if shown or title.startswith("ended"):
            yield f"  {title}"
        for event in shown:
            yield _timed(event, times, story.since if title == "evidence" else None)
    if story.remark:
        yield f"  {story.remark}"
    if story.lacking:
        yield fold(
            "  ", f"missing topics that may explain it: {', '.join(story.lacking)}; {advice}"
        )


_LIVE_ADVICE: Final = (
    "to publish them, add them to PX4's dds_topics.yaml or pub.csv, "
    "and to topics= of the source if it is set"
)
_ADVICE: Final = {
    ".ulg": "PX4 1.14 and later log them by default (SDLOG_PROFILE, bit 0)",
    ".mcap": "to record them, run 'nedbus record' without --topic while a source publishes them",
}


def to_line(event: Event, times: Times) -> str:
    """Format an event as one line: time, vehicle, severity, text and evidence."""
    evidence = ", ".join(_before(cause, event.time) for cause in event.evidence)
    because = f"  <- {evidence}" if event.evidence and event.severity != "info" else ""
    severity = "" if event.severity == "info" else event.severity.upper()
    return fold(
        f"{times.text(event):>10}  {to_text(event.vehicle):<8} {severity:<5}  ",
        f"{_shown(event)}{because}",
    )


def _shown(event: Event) -> str:
    return to_text(event.words, limits.LINE_TEXT)


def _timed(event: Event, times: Times, since: float | None = None) -> str:
    return fold(
        f"    {times.text(event)}  ", _shown(event) if since is None else _before(event, since)
    )


def _before(event: Event, time: float) -> str:
    """Format an event with its distance from a time, which it may explain."""
    distance = format_duration(abs(time - event.time))
    return f"{_shown(event)} ({distance} {'before' if event.time <= time else 'after'})"


def _follow(
    bus: "Bus",
    live: "LiveEvents",
    show: Callable[[Iterable[Event]], object],
    duration: float | None,
) -> None:
    from nedbus.cli.follow import follow

    known: set[str] = set()

    def show_new() -> None:
        show(live.poll())
        from_start = live.from_start
        known.intersection_update(from_start)
        for name, text in from_start.items():
            if name not in known and text:
                write_stderr(f"{name}: {text}, from the start")
        known.update(from_start)

    follow(bus, live.subscription, live.add, count=None, duration=duration, each_second=show_new)


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


def _to_fields(event: Event, times: Times) -> dict[str, object]:
    utc = times.utc(event)
    time = (
        None if utc is None else datetime.fromtimestamp(utc, UTC).isoformat(timespec="milliseconds")
    )
    evidence = [
        {"kind": cause.kind, "change": cause.change, "text": cause.text, "topic": cause.topic,
         "before": round(event.time - cause.time, 3)}
        for cause in event.evidence
    ]  # fmt: skip
    return (
        {"time": time, "clock": times.clock(event)}
        | asdict(event)
        | {"time": time, "evidence": evidence}
    )


def _to_csv(event: Event, times: Times) -> str:
    fields = _to_fields(event, times)
    fields["evidence"] = "; ".join(
        f"{cause.kind} {event.time - cause.time:.1f} s" for cause in event.evidence
    )
    fields["numbers"] = json.dumps(dict(event.numbers)) if event.numbers else ""
    return csv_line([fields[name] for name in _HEAD])


def _verdict_fields(verdict: Verdict) -> dict[str, object]:
    def fields(events: Iterable[Event | None]) -> list[dict[str, object] | None]:
        return [None if event is None else _to_fields(event, verdict.times) for event in events]

    faults = [
        {
            "what": story.what, "begin": fields([story.begin])[0], "end": fields([story.end])[0],
            "lasted": None if story.until is None else story.until - story.since, "before": fields(story.before),
            "meanwhile": fields(story.meanwhile), "after": fields(story.after), "lacking": story.lacking,
        }
        for story in verdict.stories
    ]  # fmt: skip
    begin, end = fields([verdict.begin, verdict.end])
    head = {
        "text": verdict.text,
        "usable": verdict.usable,
        "begin": begin,
        "end": end,
        "cause": fields(verdict.cause),
    }
    return {"verdict": head, "faults": faults}


def _require_vehicles(where: object, names: Collection[str], vehicles: Collection[str]) -> None:
    for vehicle in vehicles:
        if vehicle in names:
            continue
        check_vehicle(vehicle)
        known = to_text(", ".join(sorted(names)[:20]), limits.LINE_TEXT)
        raise ConfigError(
            "--vehicle", f"no vehicle {vehicle} in {where}{known and f': choose one of {known}'}"
        )
