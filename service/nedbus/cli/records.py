"""Commands about files: record, convert, plot."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from nedbus.bus import Bus
from nedbus.errors import AddressError, ConfigError
from nedbus.extras import needs
from nedbus.sources import Live, parse_source
from nedbus_msgs import ANY

from .options import (
    DurationOption,
    InstanceOption,
    TopicArgument,
    TopicOption,
    VehicleOption,
    choose,
    command,
    on_bus,
    tell,
    write,
)
from .serve import run_until_signal

if TYPE_CHECKING:
    from nedbus.recorder import Recorder

_SUFFIXES: Final = {".ulg": "ulog", ".mcap": "mcap"}
OutputOption = Annotated[Path, typer.Option("--output", "-o", metavar="FILE.mcap", help="The recording to write")]


@on_bus
def record(
    bus: Bus,
    topic: TopicArgument = None,
    *,
    output: OutputOption,
    topic_option: TopicOption = ANY,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
    duration: DurationOption = None,
) -> None:
    """Record every message to an MCAP file, until Ctrl-C; a power cut costs at most the last second."""
    recorder_module = needs("mcap", "nedbus.recorder")
    wanted = choose(topic, topic=topic_option, vehicle=vehicle, instance=instance)
    stop = threading.Event()
    with bus.subscribe(wanted.topic, vehicle=wanted.vehicle, instance=wanted.instance, mode="every") as subscription:
        recorder: Recorder = recorder_module.Recorder(subscription, output)

        def run() -> bool:
            recorder.run(stop, duration=duration)
            return True

        with _progress() as show:
            run_until_signal(run, stop.set, beside=lambda: show(recorder.status, None, None))
    tell(f"{output}: {recorder.status}")


@command
def convert(
    source: Annotated[Path, typer.Argument(metavar="FLIGHT", help="A .ulg or .mcap file", show_default=False)],
    output: Annotated[Path, typer.Argument(metavar="FILE.mcap", help="The recording to write", show_default=False)],
    *,
    vehicle: Annotated[str | None, typer.Option("--vehicle", "-v", help="Vehicle of a log of one vehicle")] = None,
) -> None:
    """Turn a flight log into a recording, validated, with all local position topics."""
    recorder = needs("mcap", "nedbus.recorder")
    kind = _SUFFIXES.get(source.suffix)
    if kind is None:
        raise ConfigError(str(source), f"a flight is one of {', '.join(_SUFFIXES)}")
    option = f"?vehicle={vehicle}" if vehicle else ""
    opened = parse_source(f"{kind}:{source}{option}").open_source(vehicle="1")
    if isinstance(opened, Live):
        raise ConfigError(str(source), "not a file")
    flight = opened.open()
    for warning in flight.warnings:
        tell(f"{source}: {warning}")
    with _progress() as show:
        report = recorder.convert(
            flight, output, source=kind, on_progress=lambda done: show(f"{output}", done, flight.total)
        )
    tell(f"{output}: {report}")


@contextmanager
def _progress() -> Iterator[Callable[[str, int | None, int | None], None]]:
    """Show how far something is, on a terminal."""
    if not sys.stderr.isatty():
        yield lambda text, done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}", markup=False), BarColumn(bar_width=24), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=None)
        yield lambda text, done, total: progress.update(task, description=text, completed=done or 0, total=total)


@command
def plot(
    source: Annotated[Path, typer.Argument(metavar="FLIGHT", help="A .ulg or .mcap file", show_default=False)],
    *,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE.png", help="The picture (default: beside the flight)")
    ] = None,
    topic: TopicOption = "vehicle_local_position",
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
) -> None:
    """Draw a flight: track, altitude, speed, what was valid when, and resets of the estimator."""
    picture = needs("plot", "nedbus.picture")
    reading = needs("mcap", "nedbus.reading")
    meant = [
        address
        for address in reading.addresses_of(source)
        if topic in (ANY, address.topic) and vehicle in (ANY, address.vehicle) and instance in (None, address.instance)
    ]
    if not meant:
        raise AddressError("topic", topic, f"one of {', '.join(map(str, reading.addresses_of(source)))}")
    if len(meant) > picture.STREAMS:
        tell(f"{source}: {len(meant)} streams, of which the first {picture.STREAMS} are drawn: choose with -v, -t, -i")
    streams = []
    for address in meant[: picture.STREAMS]:
        records = reading.read(source, address.topic, vehicle=address.vehicle, instance=address.instance)
        if len(records):
            streams.append((address, records))
    target = output or source.with_suffix(".png")
    picture.draw(streams, target, title=source.name)
    write(str(target))
