"""Replay of files with their events, and the events of any recorded source as one object."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import nedbus
from nedbus.errors import ArgumentError
from nedbus.flights import EventReplay, detect_events
from nedbus.vehicle_events import Event
from nedbus_msgs import DEFAULT, codec_of
from tests.flights.messages import VALID, VLP, message
from tests.flights.ulogs import UlogWriter


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Write a log of 12 s with an invalid position from 4 s on, and one message with a wild longitude."""
    writer = UlogWriter()
    writer.define([VLP])
    for tenth in range(120):
        fields: dict[str, object] = VALID | {"xy_valid": tenth < 40, "v_xy_valid": tenth < 40}
        raw: dict[str, Any] = {}
        if tenth == 20:
            raw["ref_lon"] = 4000.0
        writer.add(VLP, message(1_000_000 + tenth * 100_000, **fields), **raw)
    return writer.write(tmp_path / "flight.ulg")


def texts_of(events: list[Event] | tuple[Event, ...]) -> list[tuple[float, str]]:
    return sorted((event.time, event.text) for event in events)


def test_replay_yields_each_message_after_its_events(log: Path) -> None:
    """A replay yields every message with its payload, or why it is invalid; its log then has the events so far."""
    replay = EventReplay([log])
    messages = []
    fault_at = None
    for replayed in replay:
        messages.append(replayed)
        events, _ = replay.event_log.events_since(0)
        if fault_at is None and any(event.severity == "bad" for event in events):
            fault_at = replayed.at
    assert [replayed.timestamp for replayed in messages] == [
        1_000_000 + tenth * 100_000 for tenth in range(120)
    ]
    rejected = [replayed for replayed in messages if replayed.rejected is not None]
    assert [(replayed.at, replayed.payload) for replayed in rejected] == [(2.0, None)]
    assert "ref_lon" in str(rejected[0].rejected)
    payload = messages[0].payload
    assert payload is not None
    assert codec_of(DEFAULT).decode_row(payload).timestamp == 1_000_000
    assert fault_at is not None
    assert 4.0 <= fault_at < 12.0
    assert replay.times.offsets == {}
    assert replay.warnings == ()


def test_events_are_the_same_from_path_paths_flight_and_samples(log: Path) -> None:
    """The events of a source do not depend on how it is given, and are those of `nedbus.events`."""
    expected = texts_of(nedbus.events(log).events)
    assert any("position" in text for _, text in expected)
    with nedbus.open(log) as flight:
        samples = list(flight("*"))
        assert texts_of(detect_events(flight).events) == expected
    assert texts_of(detect_events(str(log)).events) == expected
    assert texts_of(detect_events([log]).events) == expected
    without_rejections = [event for event in expected if "reject" not in event[1]]
    from_samples = texts_of(detect_events(samples).events)
    assert [text for _, text in from_samples] == [text for _, text in without_rejections]
    with pytest.raises(ArgumentError, match="a file, several files"):
        detect_events(3)  # type: ignore[arg-type] # a mistake of a script
