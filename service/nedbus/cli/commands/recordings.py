"""Commands for files: record, convert, plot."""

import math
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Final

import typer

from nedbus import recording
from nedbus.cli.follow import write_notice
from nedbus.cli.options import ALL, DurationOption, InstanceOption, VehicleOption, command
from nedbus.cli.output.progress import show_progress
from nedbus.cli.output.streams import write, write_stderr
from nedbus.cli.run import run_until_stopped
from nedbus.client import Bus
from nedbus.errors import ConfigError, NoDataError, SourceError
from nedbus.sources import LiveSource, parse_source, read_file_events, source_text_of_file
from nedbus.sources import convert as convert_messages
from nedbus.timings import TIMINGS
from nedbus_msgs import ANY, DEFAULT, DEFAULT_TOPIC, Selection

_FLIGHT: Final = "A .ulg, .mcap or .tlog file"
_IMAGE: Final = "Image to write (default: next to the flight)"
FlightArgument = Annotated[Path, typer.Argument(metavar="FLIGHT", help=_FLIGHT, show_default=False)]


@command
def record(
    bus: Bus,
    selection: Selection = ALL,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE.mcap", help="Recording to write")],
    duration: DurationOption = None,
) -> None:
    """Record messages to an MCAP file until Ctrl-C.

    A crash loses about the last second.
    """
    notice = time.monotonic() + TIMINGS.first_sample
    with bus.subscribe_to(selection, mode="every") as subscription:
        recorder = recording.Recorder(subscription, output)

        def tick() -> None:
            nonlocal notice
            show(recorder.status, None, None)
            if not recorder.messages and time.monotonic() > notice:
                notice = math.inf
                write_notice(subscription)

        try:
            with show_progress() as show, suppress(typer.Exit):  # Ctrl-C is the normal end of a recording
                run_until_stopped(lambda stop: recorder.run(stop, duration=duration), on_tick=tick)
        except NoDataError:
            write_stderr(f"{output}: {recorder.status}, removed the empty file")
            raise
    write_stderr(f"{output}: {recorder.status}")


@command
def convert(
    source: FlightArgument,
    output: Annotated[Path, typer.Argument(metavar="FILE.mcap", help="Recording to write", show_default=False)],
    *,
    vehicle: Annotated[str | None, typer.Option("--vehicle", "-v", help="Vehicle id, for a log of one vehicle")] = None,
    topics: Annotated[str | None, typer.Option("--topics", "-t", help='Topics, separated by commas, or "*"')] = None,
) -> None:
    """Convert a flight log to an MCAP recording.

    Validates every message, and converts the topics of all built-in messages unless --topics selects others.
    """
    spec = parse_source(source_text_of_file(source, vehicle=vehicle, topics=topics))
    replay = spec.open_source(vehicle="1")
    if isinstance(replay, LiveSource):
        raise ConfigError(str(source), "not a file")
    run = replay.open()
    with show_progress() as show:
        on_progress = lambda done: show(f"{output}", run.done(done), run.total)  # noqa: E731
        report = convert_messages(run, output, source=spec.kind, on_progress=on_progress)
    for warning in run.warnings:
        write_stderr(f"{source}: {warning}")
    write_stderr(f"{output}: {report}")
    if run.damage:
        raise SourceError(str(source), "the file is damaged: only the readable messages were converted")


@command
def plot(
    source: FlightArgument,
    *,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE.png", help=_IMAGE)] = None,
    topic: Annotated[str, typer.Option("--topic", "-t", help='Topic, "*" for all positions')] = DEFAULT_TOPIC,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
) -> None:
    """Plot a flight: track, altitude, speed, flags, resets and events."""
    draw, limit = recording.draw, recording.MAX_STREAMS
    selection = Selection(topic, vehicle, instance)
    if topic not in (ANY, *DEFAULT.topics):
        table = f'nedbus.read("{source}", "{topic}", dataframe="pandas")'
        raise ConfigError("--topic", f"{topic} has no track; plot {' or '.join(DEFAULT.topics)}, or read it: {table}")
    with recording.Flight(source) as flight:
        found = recording.matching(source, flight.addresses, selection)
        selected = [address for address in found if address.topic in DEFAULT.topics]
        if len(selected) > limit:
            write_stderr(f"{source}: plotting {limit} of {len(selected)} streams; choose others with -v, -t or -i")
        streams = [(address, messages) for address, (messages, _) in flight.read(selected[:limit]).items()]
        for warning in flight.warnings:
            write_stderr(f"{source}: {warning}")
        streams = [(address, messages) for address, messages in streams if len(messages)]
        if not streams:
            raise SourceError(str(source), "nothing to plot: the selected streams have no valid message")
        target = output or source.with_suffix(".png")
        read = read_file_events(source)
        known = (each for vehicle in read.event_log.vehicles.values() for each in vehicle.conditions.values())
        events = [*dict.fromkeys(each.begin for each in known if each.initial), *read.event_log.events_since(0)[0]]
        draw(streams, target, title=source.name, events=events, times=read.times)
        write(str(target))
        if flight.damaged:
            raise SourceError(str(source), "the file is damaged: only the readable messages were plotted")
