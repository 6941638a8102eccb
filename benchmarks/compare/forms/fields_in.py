"""nedbus: fields by name in, model instances out, every sample, loss detection on."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import nedbus
from benchmarks.compare.case import Case
from benchmarks.compare.fields import PROVIDED

from . import models

Send = Callable[[int], None]


@contextmanager
def publish(case: Case) -> Iterator[list[Send]]:
    def make_send(publisher: nedbus.Publisher) -> Send:
        return lambda stamp: publisher.publish({**PROVIDED, "timestamp": stamp})

    with models.open_publishers(case) as publishers:
        yield list(map(make_send, publishers))


receive = models.receive
