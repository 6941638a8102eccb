"""Ends that all forms of nedbus share: the publishers of all vehicles, and a subscription to every sample."""

from collections.abc import Iterator
from contextlib import contextmanager

import nedbus

from .case import Case

TOPIC = "vehicle_local_position"


@contextmanager
def open_publishers(case: Case) -> Iterator[list[nedbus.Publisher]]:
    """Open one publisher for each vehicle."""
    with nedbus.connect(case.endpoint) as bus:
        yield [bus.publisher(TOPIC, vehicle=vehicle, lossless=case.lossless) for vehicle in case.vehicles]


@contextmanager
def open_subscription(case: Case) -> Iterator[nedbus.Subscription]:
    """Subscribe to every sample."""
    with (
        nedbus.connect(case.endpoint) as bus,
        bus.subscribe(TOPIC, vehicle=case.vehicle, mode="every") as subscription,
    ):
        yield subscription
