"""Open replays without a service, and convert them to recordings."""

from __future__ import annotations

from pathlib import Path

from nedbus.sources import LiveSource, ReplayRun, convert, parse_source


def open_replay(text: str) -> ReplayRun:
    """Open one run of a replay source."""
    source = parse_source(text).open_source(vehicle="1")
    assert not isinstance(source, LiveSource)
    return source.open()


def convert_replay(text: str, path: Path) -> str:
    """Convert a replay source to a recording, as `nedbus convert` does; return its summary."""
    return convert(open_replay(text), path, source=text.partition(":")[0], on_progress=lambda _: None)
