"""Commands about files: record, convert, plot."""

from __future__ import annotations

import math
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from nedbus import recording
from nedbus.cli.follow import SILENCE_TIMEOUT, write_notice
from nedbus.cli.options import ALL, DurationOption, InstanceOption, VehicleOption, command
from nedbus.cli.output.progress import show_progress
from nedbus.cli.output.streams import write, write_stderr
from nedbus.cli.run import run_until_stopped
from nedbus.client import Bus
from nedbus.errors import ConfigError, NoDataError, SourceError
from nedbus.events import Event
from nedbus.sources import LiveSource, parse_source, read_account, source_text_of_file
from nedbus.sources import convert as convert_messages
from nedbus_msgs import ANY, DEFAULT, DEFAULT_TOPIC, Selection

FlightArgument = Annotated[Path, typer.Argument(metavar="FLIGHT", help="A .ulg or .mcap file", show_default=False)]


@command
def record(
    bus: Bus,
    selection: Selection = ALL,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE.mcap", help="The recording to write")],
    duration: DurationOption = None,
) -> None:
    """Record every message to an MCAP file, until Ctrl-C; a power cut costs at most the last second."""
    notice = time.monotonic() + SILENCE_TIMEOUT
    with bus.subscribe_to(selection, mode="every") as subscription:
        recorder = recording.Recorder(subscription, output)

        def tick() -> None:
            nonlocal notice
            show(recorder.status, None, None)
            if not recorder.messages and time.monotonic() > notice:
                notice = math.inf
                write_notice(subscription)

        try:
            with show_progress() as show, suppress(typer.Exit):  # Ctrl-C ends a recording as it is meant to end
                run_until_stopped(lambda stop: recorder.run(stop, duration=duration), on_tick=tick)
        except NoDataError:
            write_stderr(f"{output}: {recorder.status}: the empty file is removed")
            raise
    write_stderr(f"{output}: {recorder.status}")


@command
def convert(
    source: FlightArgument,
    output: Annotated[Path, typer.Argument(metavar="FILE.mcap", help="The recording to write", show_default=False)],
    *,
    vehicle: Annotated[str | None, typer.Option("--vehicle", "-v", help="Vehicle of a log of one vehicle")] = None,
    topics: Annotated[str | None, typer.Option("--topics", "-t", help='Separated by commas; "*" for all')] = None,
) -> None:
    """Convert a flight log to a recording, validated, with all topics whose messages nedbus knows."""
    spec = parse_source(source_text_of_file(source, vehicle=vehicle, topics=topics))
    replay = spec.open_source(vehicle="1")
    if isinstance(replay, LiveSource):
        raise ConfigError(str(source), "not a file")
    run = replay.open()
    for warning in run.warnings:
        write_stderr(f"{source}: {warning}")
    with show_progress() as show:
        report = convert_messages(
            run.messages,
            output,
            source=spec.kind,
            on_progress=lambda done: show(f"{output}", done, run.total),
        )
    write_stderr(f"{output}: {report}")
    if run.damage:
        raise SourceError(str(source), "damage cost messages: what could be read is written")


@command
def plot(
    source: FlightArgument,
    *,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE.png", help="The picture (default: beside the flight)")
    ] = None,
    topic: Annotated[str, typer.Option("--topic", "-t", help='Topic, "*" for all positions')] = DEFAULT_TOPIC,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
) -> None:
    """Draw a flight: track, altitude, speed, flags, resets of the estimator, and events."""
    draw, limit = recording.draw, recording.MAX_STREAMS
    selection = Selection(topic, vehicle, instance)
    if topic not in (ANY, *DEFAULT.topics):
        table = f'nedbus.read("{source}", "{topic}", dataframe="pandas")'
        raise ConfigError("--topic", f"{topic} has no track to draw, {', '.join(DEFAULT.topics)} have: see {table}")
    with recording.Flight(source) as flight:
        found = recording.matching(source, flight.addresses, selection)
        selected = [address for address in found if address.topic in DEFAULT.topics]
        if len(selected) > limit:
            hint = f"of which the first {limit} are drawn: choose with -v, -t, -i"
            write_stderr(f"{source}: {len(selected)} streams, {hint}")
        streams = [(address, messages) for address, (messages, _) in flight.read(selected[:limit]).items()]
        for warning in flight.warnings:
            write_stderr(f"{source}: {warning}")
        streams = [(address, messages) for address, messages in streams if len(messages)]
        if not streams:
            raise SourceError(str(source), "nothing to draw: no message of what is selected is valid")
        target = output or source.with_suffix(".png")
        draw(streams, target, title=source.name, events=_read_events(source))
        write(str(target))
        if flight.damaged:
            raise SourceError(str(source), "damage cost messages: what could be read is drawn")


def _read_events(path: Path) -> list[Event]:
    """Return the events of a file, and the begin of conditions that held from the first message to the end."""
    account = read_account(path).account
    held = (each for vehicle in account.vehicles.values() for each in vehicle.conditions.values() if each.initial)
    return [*dict.fromkeys(each.begin for each in held), *account.take(0)[0]]
