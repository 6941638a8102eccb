"""nedbus: model instances at both ends, every sample, loss detection on."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import nedbus

from .fields import FIELDS


@contextmanager
def publish(endpoint: str) -> Iterator[Callable[[int], None]]:
    with nedbus.connect(endpoint) as bus:
        publisher = bus.publisher("vehicle_local_position", vehicle="1", lossless=True)
        yield lambda stamp: publisher.publish(nedbus.VehicleLocalPosition(**{**FIELDS, "timestamp": stamp}))


def receive(endpoint: str, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    with nedbus.connect(endpoint) as bus, bus.subscribe("vehicle_local_position", mode="every") as subscription:
        ready()
        for sample in subscription:
            message = sample.message
            if not seen(message.timestamp if message.x else 0):
                break
