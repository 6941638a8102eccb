"""State of an exporter while samples arrive."""

from __future__ import annotations

from dataclasses import replace

import pytest

import nedbus
from nedbus.client import Sample
from nedbus.monitoring import Exporter
from nedbus_msgs import Address, Provenance, Selection
from tests.flights.messages import VALID, VLP, message

WING = Address("wing", VLP)


def test_stream_that_begins_during_a_poll_keeps_its_source(bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stream whose first message arrives while vehicles are polled has the label of its source.

    A topic that is sent on change may not have another message for the rest of the flight.
    """
    exporter = Exporter(bus, Selection(), version="0")
    sample = Sample(message(1_000_000, **VALID), WING, 0, provenance=Provenance("sim"))
    count = bus.publishers

    def add_and_count(*, timeout: float) -> object:
        exporter.add(sample)
        return count(timeout=timeout)

    monkeypatch.setattr(bus, "publishers", add_and_count)
    exporter.poll()
    assert 'source="sim"' in exporter.pages["/metrics"]().content.decode()


def test_labels_of_retained_and_forgotten_streams_are_removed(bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only streams that are measured keep the label of their source."""
    exporter = Exporter(bus, Selection(), version="0")
    sample = Sample(message(1_000_000, **VALID), WING, 0, provenance=Provenance("sim"))
    for stream in (sample, replace(sample, address=Address("quad", VLP), retained=True)):
        exporter.add(stream)
    exporter.poll()
    assert [*exporter._sources] == [WING]
    exporter.monitor.forget(WING)
    exporter.poll()
    assert not exporter._sources
