"""Commands for files: convert, plot."""

from pathlib import Path
from typing import Annotated, Final

import typer

from nedbus import flights, tables
from nedbus.cli.options import InstanceOption, VehiclesOption, command, parse_fields
from nedbus.cli.output.streams import write, write_stderr
from nedbus.cli.output.table import show_progress
from nedbus.errors import ConfigError, SourceError
from nedbus_msgs import ANY, DEFAULT, DEFAULT_TOPIC, Selection, check_vehicle

_FLIGHTS: Final = ".ulg, .mcap or .tlog files; several are merged by UTC"
_IMAGE: Final = "Image to write (default: next to the flight)"
_PLOTTED: Final = "Fields to plot over time, or height, speed, roll_deg, ..."
FlightsArgument = Annotated[list[Path], typer.Argument(metavar="FLIGHT", help=_FLIGHTS, show_default=False)]


@command
def convert(
    sources: FlightsArgument,
    output: Annotated[Path, typer.Argument(metavar="FILE.mcap", help="Recording to write", show_default=False)],
    *,
    vehicle: Annotated[str | None, typer.Option("--vehicle", "-v", help="Vehicle id, for a log of one vehicle")] = None,
    topics: Annotated[str | None, typer.Option("--topics", "-t", help='Topics, separated by commas, or "*"')] = None,
) -> None:
    """Convert flight logs to an MCAP recording.

    Validates every message, and converts the topics of all built-in messages unless --topics selects others.
    """
    write_recording = flights.convert_flight  # raises ConfigError without the extra, before the files are read
    names = flights.parse_topics(topics or "")
    if vehicle is not None:
        check_vehicle(vehicle)
    options = flights.ReadOptions(flights.topics_of(names), vehicle)
    with flights.open_messages(sources, options) as flight, show_progress() as show:
        report = write_recording(flight, output, on_progress=lambda done, total: show(f"{output}", done, total))
        absent = flights.absent_topics(names, {address.topic for address in flight.definitions}, "this file")
    for warning in (*flight.warnings, *(f"{sources[0]}: {text}" for text in absent)):
        write_stderr(warning)
    write_stderr(f"{output}: {report}")
    _require_undamaged(flight.damaged, sources, "converted")


@command
def plot(
    sources: FlightsArgument,
    *,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE.png", help=_IMAGE)] = None,
    topic: Annotated[str, typer.Option("--topic", "-t", help='Topic, "*" for all positions')] = DEFAULT_TOPIC,
    vehicle: VehiclesOption = None,
    instance: InstanceOption = None,
    field: Annotated[str | None, typer.Option("--field", metavar="NAME,NAME,...", help=_PLOTTED)] = None,
) -> None:
    """Plot flights: track, height, speed, flags, resets and events; or fields over time."""
    draw, limit = tables.draw, tables.MAX_STREAMS
    selection, name = Selection(topic, vehicle or ANY, instance), ", ".join(map(str, sources))
    fields = parse_fields(field, selection)
    is_position = topic in (ANY, *DEFAULT.topics)
    if not fields and not is_position:
        positions = " or ".join(DEFAULT.topics)
        raise ConfigError("--topic", f"{topic} has no track; name fields with --field, or plot {positions}")
    flight, selected = tables.read_plotted(sources, selection, DEFAULT.topics if is_position else [topic])
    if len(selected) > limit:
        write_stderr(f"{name}: plotting {limit} of {len(selected)} streams; choose others with -v, -t or -i")
    streams = []
    for address in selected[:limit]:
        messages, _ = tables.array_of(flight, address, unix_times=len(sources) > 1)
        if len(messages):
            streams.append((address, messages))
    for path, text in tables.array_warnings(flight):
        write_stderr(f"{path}: {text}")
    if not streams:
        raise SourceError(name, "nothing to plot: the selected streams have no valid message")
    target = output or sources[0].with_suffix(".png")
    read = flights.read_file_events(*sources)
    known = (each for vehicle in read.event_log.vehicles.values() for each in vehicle.conditions.values())
    events = [*dict.fromkeys(each.begin for each in known if each.initial), *read.event_log.events_since(0)[0]]
    title = ", ".join(each.name for each in sources)
    if fields:
        tables.draw_fields(streams, fields, target, title=title, events=events, times=read.times)
    else:
        draw(streams, target, title=title, events=events, times=read.times)
    write(str(target))
    _require_undamaged(flight.damaged, sources, "plotted")


def _require_undamaged(is_damaged: bool, sources: list[Path], what: str) -> None:
    if is_damaged:
        name = ", ".join(map(str, sources))
        raise SourceError(name, f"the file is damaged: only the readable messages were {what}")
