"""nedbus: tuples in, named tuples out, every sample, loss detection on."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import nedbus

from .fields import FIELDS


@contextmanager
def publish(endpoint: str) -> Iterator[Callable[[int], None]]:
    """Send tuples."""
    _, *rest = FIELDS.values()
    with nedbus.connect(endpoint) as bus:
        publisher = bus.publisher("vehicle_local_position", vehicle="1", lossless=True)
        yield lambda stamp: publisher.publish_row((stamp, *rest))


def receive(endpoint: str, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    """Take named tuples."""
    with nedbus.connect(endpoint) as bus, bus.subscribe("vehicle_local_position", mode="every") as subscription:
        ready()
        for sample in subscription.rows():
            row = sample.message
            if not seen(row.timestamp if row.x else 0):
                break
