"""Open replays without a service, and convert them to recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nedbus.flights import ReadOptions, convert
from nedbus.flights.readers.mcap import McapReader
from nedbus.sources import LiveSource, ReplayRun, parse_source


def open_replay(text: str) -> ReplayRun:
    """Open one run of a replay source."""
    source = parse_source(text).open_source(vehicle="1")
    assert not isinstance(source, LiveSource)
    return source.open()


def convert_replay(text: str, path: Path) -> str:
    """Convert a replay source to a recording, as `nedbus convert` does; return its summary."""
    run = open_replay(text)
    source = text.partition(":")[0]
    return convert(
        run.messages, path, source=source, boot_utc=run.boot_utc, on_progress=lambda _: None
    )


def open_recording(path: str | Path, **options: Any) -> McapReader:
    """Open the reader of a recording, with the messages of all topics."""
    return McapReader(Path(path), ReadOptions(topics=None, **options))
