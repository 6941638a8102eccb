"""nedbus: model instances at both ends, every sample, loss detection on."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import nedbus
from benchmarks.compare.case import TOPIC, Case
from benchmarks.compare.fields import PROVIDED

Send = Callable[[int], None]


@contextmanager
def open_publishers(case: Case) -> Iterator[list[nedbus.Publisher]]:
    """Open one publisher for each vehicle."""
    with nedbus.connect(case.endpoint) as bus:
        yield [
            bus.publisher(TOPIC, vehicle=vehicle, lossless=case.lossless)
            for vehicle in case.vehicles
        ]


@contextmanager
def open_subscription(case: Case) -> Iterator[nedbus.Subscription]:
    """Subscribe to every sample."""
    with (
        nedbus.connect(case.endpoint) as bus,
        bus.subscribe(TOPIC, vehicle=case.vehicle, mode="every") as subscription,
    ):
        yield subscription


@contextmanager
def publish(case: Case) -> Iterator[list[Send]]:
    def make_send(publisher: nedbus.Publisher) -> Send:
        return lambda stamp: publisher.publish(
            nedbus.VehicleLocalPosition(**{**PROVIDED, "timestamp": stamp})
        )

    with open_publishers(case) as publishers:
        yield list(map(make_send, publishers))


def receive(case: Case, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    with open_subscription(case) as subscription:
        ready()
        for sample in subscription:
            message = sample.message
            if not seen(message.timestamp if message.x else 0):
                break
