"""Replay of .ulg logs, .mcap recordings and .tlog files, paced by their log times."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from nedbus.flights import FlightReader, ReadOptions, absent_topics, open_reader
from nedbus.samples import SourceMessage
from nedbus_msgs import DEFAULT

from .options import RecordedOptions, RecordingOptions
from .source import ReplayRun


def open_replay(file: str, options: RecordedOptions, default_vehicle: str) -> ReplayRun:
    """Read the start of a file; raise SourceError if it cannot be read, or has none of the requested topics."""
    path = Path(file).expanduser()
    layout = options.layout if isinstance(options, RecordingOptions) else None
    reader = open_reader(
        path, ReadOptions(options.chosen_topics, options.vehicle, default_vehicle, layout)
    )
    reader.begin()
    run = ReplayRun(
        iter(()),
        reader.definitions,
        reader.total,
        _summary(reader),
        position=lambda: reader.position,
    )
    run.messages = _read(reader, run, options)
    run.boot_utc = reader.boot_utc
    _update(run, reader, ())
    return run


def _read(
    reader: FlightReader, run: ReplayRun, options: RecordedOptions
) -> Iterator[SourceMessage]:
    """Yield the messages of a file, and update its run."""
    with reader:
        yield from reader.messages()
    absent = absent_topics(
        options.topics, {address.topic for address in reader.definitions}, "this file"
    )
    _update(run, reader, absent)


def _update(run: ReplayRun, reader: FlightReader, absent: Iterable[str]) -> None:
    run.warnings = (*reader.warnings, *reader.remarks, *absent)
    if reader.damaged:
        run.damage = (
            f"{reader.path}: some messages are lost to damage; {'; '.join(reader.warnings)}"
        )


def _summary(reader: FlightReader) -> str:
    vehicles = sorted({address.vehicle for address in reader.definitions})
    layouts = " and ".join(sorted(reader.layouts(DEFAULT)))
    layout = f", layout {layouts}" if layouts else ""
    return f"vehicle {', '.join(vehicles[:5])}{layout}, {reader.total / 1e6:.1f} MB"
