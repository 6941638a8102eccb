"""nedbus: model instances at both ends, every sample, loss detection on."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import nedbus
from benchmarks.compare.case import Case
from benchmarks.compare.fields import PROVIDED
from benchmarks.compare.nedbus_ends import open_publishers, open_subscription

Send = Callable[[int], None]


@contextmanager
def publish(case: Case) -> Iterator[list[Send]]:
    def make_send(publisher: nedbus.Publisher) -> Send:
        return lambda stamp: publisher.publish(nedbus.VehicleLocalPosition(**{**PROVIDED, "timestamp": stamp}))

    with open_publishers(case) as publishers:
        yield list(map(make_send, publishers))


def receive(case: Case, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    with open_subscription(case) as subscription:
        ready()
        for sample in subscription:
            message = sample.message
            if not seen(message.timestamp if message.x else 0):
                break
