"""Replays, opened without a service."""

from __future__ import annotations

from nedbus.sources import Flight, Live, parse_source


def open_replay(text: str) -> Flight:
    """Return the flight of a source that is a replay."""
    source = parse_source(text).open_source(vehicle="1")
    assert not isinstance(source, Live)
    return source.open()
