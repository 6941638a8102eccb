"""Commands for files: convert, plot."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Final

import typer

import nedbus
from nedbus import tables
from nedbus.cli.options import InstanceOption, VehiclesOption, command, parse_fields
from nedbus.cli.output.streams import write, write_stderr
from nedbus.cli.output.table import show_progress
from nedbus.errors import ConfigError, SourceError
from nedbus.health import Event, EventHistory
from nedbus.vehicle_events import KINDS
from nedbus_msgs import ANY, DEFAULT, DEFAULT_TOPIC, Selection

_FLIGHTS: Final = ".ulg, .mcap or .tlog files; several are merged by UTC"
_IMAGE: Final = "Image to write (default: next to the flight)"
_PLOTTED: Final = "Fields to plot over time, such as x or q[0], or height, speed, roll_deg, ..."
FlightsArgument = Annotated[
    list[Path], typer.Argument(metavar="FLIGHT", help=_FLIGHTS, show_default=False)
]


@command
def convert(
    sources: Annotated[
        list[Path],
        # of one argument alone, the error names the other one
        typer.Argument(metavar="FLIGHT", help=_FLIGHTS, show_default=False, default_factory=list),
    ],
    output: Annotated[
        Path, typer.Argument(metavar="FILE.mcap", help="Recording to write", show_default=False)
    ],
    *,
    vehicle: Annotated[
        str | None, typer.Option("--vehicle", "-v", help="Vehicle id, for a log of one vehicle")
    ] = None,
    topics: Annotated[
        str | None, typer.Option("--topics", "-t", help='Topics, separated by commas, or "*"')
    ] = None,
) -> None:
    """Convert flight logs to an MCAP recording.

    Validates every message, and converts the topics of all built-in messages unless --topics selects others.
    """
    if not sources:
        reason = f"name the recording to write, as in 'nedbus convert {output} converted.mcap'"
        raise ConfigError("FILE.mcap", reason)
    with show_progress() as show:
        done = nedbus.convert(
            sources,
            output,
            topics=topics or "",
            vehicle=vehicle,
            on_progress=lambda done, total: show(f"{output}", done, total),
        )
    for warning in done.warnings:
        write_stderr(warning)
    write_stderr(f"{output}: {done.summary}")
    _require_undamaged(done.damaged, sources, "converted")


@command
def plot(
    sources: FlightsArgument,
    *,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE.png", help=_IMAGE)
    ] = None,
    topic: Annotated[
        str, typer.Option("--topic", "-t", help='Topic, "*" for all positions')
    ] = DEFAULT_TOPIC,
    vehicle: VehiclesOption = None,
    instance: InstanceOption = None,
    field: Annotated[
        str | None, typer.Option("--field", metavar="NAME,NAME,...", help=_PLOTTED)
    ] = None,
) -> None:
    """Plot flights: track, height, speed, flags, resets and events; or fields over time."""
    draw = tables.draw  # names a missing package before the files are read
    name = ", ".join(map(str, sources))
    selection = Selection(topic, vehicle or ANY, instance)
    fields = parse_fields(field, selection, elements=True)
    is_position = topic in (ANY, *DEFAULT.topics)
    if not fields and not is_position:
        positions = " or ".join(DEFAULT.topics)
        problem = f"{topic} has no track; name fields with --field, or plot {positions}"
        raise ConfigError("--topic", problem)
    topics = DEFAULT.topics if is_position else [topic]
    flight, selected = tables.read_plotted(sources, selection, topics)
    limit = len(tables.STREAM_COLORS)
    if len(selected) > limit:
        write_stderr(
            f"{name}: plotting {limit} of {len(selected)} streams; choose others with -v, -t or -i"
        )
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
    history = nedbus.events(sources)
    events = [*_initial_events(history), *history.events]
    title = ", ".join(source.name for source in sources)
    if fields:
        tables.draw_fields(streams, fields, target, title=title, events=events, times=history.times)
    else:
        draw(streams, target, title=title, events=events, times=history.times)
    write(str(target))
    _require_undamaged(flight.damaged, sources, "plotted")


def _initial_events(history: EventHistory) -> Iterable[Event]:
    """Return the unusual conditions that were active before the first message, each once."""
    events: dict[Event, None] = {}
    for vehicle in history.vehicles.values():
        for condition in vehicle.held:
            if condition.initial and not KINDS[condition.kind].usual:
                events[condition.begin] = None
    return events


def _require_undamaged(is_damaged: bool, sources: list[Path], what: str) -> None:
    if is_damaged:
        name = ", ".join(map(str, sources))
        raise SourceError(name, f"the file is damaged: only the readable messages were {what}")
