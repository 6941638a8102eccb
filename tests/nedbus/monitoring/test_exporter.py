"""State of an exporter while samples arrive."""

from __future__ import annotations

from dataclasses import replace

import pytest

import nedbus
from nedbus.client import Publishers, Sample
from nedbus.monitoring import Exporter
from nedbus_msgs import Address, Provenance, Selection
from tests.flights.messages import VALID, VLP, message

WING = Address("wing", VLP)


def test_stream_that_begins_during_a_poll_keeps_its_source(
    bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_retained_and_forgotten_streams_have_no_metrics(bus: nedbus.Bus) -> None:
    """Only streams that are measured are exported, labelled with the source of their newest message."""
    exporter = Exporter(bus, Selection(), version="0")
    sample = Sample(message(1_000_000, **VALID), WING, 0, provenance=Provenance("sim"))

    def labels() -> list[str]:
        page = exporter.pages["/metrics"]().content.decode()
        return [
            line for line in page.splitlines() if line.startswith("nedbus_messages_received_total{")
        ]

    for source in ("ulog", "sim"):
        exporter.add(replace(sample, provenance=Provenance(source)))
    exporter.add(replace(sample, address=Address("quad", VLP), retained=True))
    assert len(exporter.monitor) == 2
    assert labels() == [
        f'nedbus_messages_received_total{{source="sim",topic="{VLP}",vehicle="wing"}} 2.0'
    ]
    exporter.monitor.forget(WING)
    assert labels() == []


def test_retained_message_is_kept_until_all_publishers_are_listed(
    bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A retained message comes only once, so it is not forgotten because the list of publishers is incomplete."""
    exporter, publishers = Exporter(bus, Selection(), version="0"), Publishers()
    monkeypatch.setattr(bus, "publishers", lambda **_: publishers)
    exporter.add(Sample(message(1_000_000, **VALID), WING, 0, retained=True))
    for publishers.complete in (False, True):
        assert WING in exporter.monitor
        exporter.poll()
    assert WING not in exporter.monitor
