"""Replay of .ulg logs, .mcap recordings and .tlog files, paced by their log times."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from nedbus.flights import FlightFile, FlightReader, ReadOptions, absent_topics
from nedbus.samples import SourceMessage
from nedbus_msgs import DEFAULT

from .options import RecordedOptions, RecordingOptions
from .source import ReplayRun


def open_replay(file: str, options: RecordedOptions, default_vehicle: str) -> ReplayRun:
    """Read the start of a file; raise SourceError if it cannot be read, or has none of the requested topics."""
    path, layout = Path(file).expanduser(), options.layout if isinstance(options, RecordingOptions) else None
    flight = FlightFile(path, ReadOptions(options.chosen_topics, options.vehicle, default_vehicle, layout))
    reader = flight.reader
    run = ReplayRun(iter(()), reader.definitions, reader.total, "", position=lambda: reader.position)
    run.messages = _read(flight, run, options)
    run.boot_utc, run.summary = reader.boot_utc, _summary(reader)
    _update(run, flight, ())
    return run


def _read(flight: FlightFile, run: ReplayRun, options: RecordedOptions) -> Iterator[SourceMessage]:
    """Yield the messages of a file, and update its run."""
    reader = flight.reader
    try:
        yield from flight.messages
    finally:
        reader.close()
    absent = absent_topics(options.topics, {address.topic for address in reader.definitions}, "this file")
    _update(run, flight, absent)


def _update(run: ReplayRun, flight: FlightFile, absent: Iterable[str]) -> None:
    run.warnings = (*flight.warnings, *absent)
    if flight.reader.damaged:
        run.damage = f"{flight.path}: some messages are lost to damage; {'; '.join(flight.reader.warnings)}"


def _summary(reader: FlightReader) -> str:
    vehicles = sorted({address.vehicle for address in reader.definitions})
    layouts = " and ".join(sorted(reader.layouts(DEFAULT)))
    layout = f", layout {layouts}" if layouts else ""
    return f"vehicle {', '.join(vehicles[:5])}{layout}, {reader.total / 1e6:.1f} MB"
