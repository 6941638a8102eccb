"""nedbus: arrays in, arrays out, every sample, loss detection on."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt

import nedbus
from benchmarks.compare.case import Case
from benchmarks.compare.fields import FIELDS
from nedbus_msgs.arrays import to_array

from . import rows
from .models import open_publishers, open_subscription

BATCH = 1000  # messages sent at once, unless paced

Send = Callable[[Sequence[int]], None]
Stamps = npt.NDArray[np.uint64]


@contextmanager
def publish(case: Case) -> Iterator[list[Send]] | Iterator[list[rows.Send]]:
    """Send arrays, which have all fields; if paced, send single messages like `rows`."""
    if case.paced:
        with rows.publish(case) as senders:
            yield senders
        return
    message = nedbus.VehicleLocalPosition.model_validate({**FIELDS, "timestamp": 1})

    def make_send(publisher: nedbus.Publisher) -> Send:
        def send(stamps: Sequence[int]) -> None:
            messages = np.repeat(to_array([message]), len(stamps))
            messages["timestamp"] = stamps
            publisher.publish_many(messages)

        return send

    with open_publishers(case) as publishers:
        yield list(map(make_send, publishers))


def receive(case: Case, ready: Callable[[], None], seen: Callable[[Stamps], bool]) -> None:
    """Receive arrays."""
    with open_subscription(case) as subscription:
        ready()
        for batch in subscription.batches():
            stamps = batch.messages["timestamp"]
            if not np.count_nonzero(batch.messages["x"]):
                stamps = stamps[:0]
            if not seen(stamps):
                break
