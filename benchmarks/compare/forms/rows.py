"""nedbus: tuples in, named tuples out, every sample, loss detection on."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import nedbus
from benchmarks.compare.case import Case
from benchmarks.compare.fields import FIELDS, PROVIDED

from . import fields_in
from .models import open_publishers, open_subscription

Send = Callable[[int], None]


@contextmanager
def publish(case: Case) -> Iterator[list[Send]]:
    """Send tuples; send fields by name if some are missing, which a tuple cannot express."""
    if len(PROVIDED) < len(FIELDS):
        with fields_in.publish(case) as senders:
            yield senders
        return
    _, *rest = FIELDS.values()

    def make_send(publisher: nedbus.Publisher) -> Send:
        return lambda stamp: publisher.publish_row((stamp, *rest))

    with open_publishers(case) as publishers:
        yield list(map(make_send, publishers))


def receive(case: Case, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    """Receive named tuples."""
    with open_subscription(case) as subscription:
        ready()
        for sample in subscription.rows():
            row = sample.message
            if not seen(row.timestamp if row.x else 0):
                break
