"""The exact keys that a reader declares to Zenoh, so that the route of a message is not computed each time."""

from __future__ import annotations

import pytest

import nedbus
from nedbus_msgs import VehicleLocalPosition
from tests.flights.messages import VLP, message
from tests.waits import DEADLINE, wait_for

KEYS = [f"nedbus/{vehicle}/{VLP}" for vehicle in "12345"]


@pytest.fixture
def fleet(bus: nedbus.Bus) -> list[nedbus.Publisher]:
    """Return publishers of five vehicles."""
    return [bus.publisher(VehicleLocalPosition, vehicle=vehicle) for vehicle in "12345"]


def test_keys_of_received_streams_are_declared(
    fleet: list[nedbus.Publisher], endpoint: str
) -> None:
    """A reader declares the key of each stream that it has received, and receives its messages as before."""
    with nedbus.connect(endpoint) as bus, bus.subscribe(VLP, mode="every") as subscription:
        for number in (1, 2):
            for publisher in fleet:
                publisher.publish(message(number))
            received = [subscription.receive(DEADLINE) for _ in fleet]
            assert sorted((sample.vehicle, sample.message.timestamp) for sample in received) == [
                (vehicle, number) for vehicle in "12345"
            ]
            wait_for(
                lambda: sorted(subscription._receiver._declared) == KEYS, what="the declarations"
            )
        subscription.close()
        assert not subscription._receiver._declared


def test_number_of_declared_keys_is_bounded(
    fleet: list[nedbus.Publisher], endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reader declares a limited number of keys, and undeclares those that it evicts."""
    monkeypatch.setattr("nedbus.limits.DECLARED_KEYS", 2)
    monkeypatch.setattr("nedbus.limits.KEYS", 3)
    with nedbus.connect(endpoint) as bus, bus.subscribe(VLP, mode="every") as subscription:
        known = subscription._receiver
        for publisher in fleet:
            publisher.publish(message(1))
            subscription.receive(DEADLINE)
            wait_for(lambda: not known._inbox.streams.opened, what="the declaration")
            assert len(known._declared) <= 2
        wait_for(
            lambda: not set(known._declared) & set(KEYS[:2]),
            what="the evicted keys to be undeclared",
        )
