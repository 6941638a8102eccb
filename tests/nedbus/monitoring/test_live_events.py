"""Live events: losses on the links of vehicles, which only the services know."""

from __future__ import annotations

import math
from contextlib import closing

import pytest

import nedbus
from nedbus import Address
from nedbus.client import QueryServer, reply_parts
from nedbus.monitoring import LinkLosses, live_events
from nedbus.transport import Session
from nedbus.vehicle_events import Event, EventLog, report_of
from nedbus_msgs import status_key
from tests.flights.messages import VLP, message
from tests.waits import wait_for


def test_losses_on_the_link_of_a_vehicle_are_live_events(
    bus: nedbus.Bus, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Live `events` shows losses that a service reports, once each: begin, duration, count and the service.

    It forgets them once no service would report them again.
    """
    event_log, address = EventLog(), Address("7", VLP)
    server = QueryServer(zenoh_session)
    server.answer_json(
        status_key("gcs", vehicle="7"),
        lambda _: reply_parts(
            report_of(event_log, "gcs", "host", 200.0, within=math.inf, to_utc=1.7e9)
        ),
    )

    def lose(start: int) -> None:
        for second in range(8):
            event_log.add(address, message(second), float(start + second), lost=100)
        event_log.settle(start + 20.0)

    with closing(server):
        lose(100)
        wait_for(bus.accounts, what="the router to know the service")
        losses = LinkLosses(bus)
        lose(150)

        shown = list[Event]()

        def poll() -> int:
            losses._next_query = 0.0
            shown.extend(losses.poll())
            return len(shown)

        wait_for(poll, what="the losses")
        poll()
        first = [*shown]
        monkeypatch.setattr(live_events, "_LOSS_MEMORY", 0.0)
        poll()
        # the queryable ignores `within`, so both losses come again
        assert len(shown) == len(first) + 2
    text = f"800 messages lost in 7.0 s ({VLP}), on the link to the service gcs"
    assert [(event.vehicle, event.text, event.time) for event in first] == [
        ("7", text, 1.7e9 + 150)
    ]


def test_logging_dropout_is_not_on_the_link() -> None:
    """A dropout is of the vehicle's logger; only losses name the link to the service."""
    event_log = EventLog()
    event_log.add(Address("7", VLP), message(1), 0.0)
    event_log.add_dropout("7", 5.0, 0.1)
    event_log.settle(20.0)
    [dropout] = event_log.events
    assert live_events._on_link(dropout, "gcs") == dropout
