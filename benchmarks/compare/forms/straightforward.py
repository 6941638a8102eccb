"""The straightforward way: a Pydantic model, a msgpack map of its fields, validated again on arrival."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import msgpack
import zenoh
from pydantic import BaseModel, ConfigDict, create_model

from benchmarks.compare.case import Case
from benchmarks.compare.fields import FIELDS
from benchmarks.compare.zenoh_session import declare_publishers, key, open_session

Position = create_model(
    "Position",
    __config__=ConfigDict(frozen=True, strict=True, extra="forbid"),
    **{name: (tuple[float, float] if type(value) is tuple else type(value), ...) for name, value in FIELDS.items()},
)

Send = Callable[[int], None]


@contextmanager
def publish(case: Case) -> Iterator[list[Send]]:
    def make_send(publisher: zenoh.Publisher) -> Send:
        def send(stamp: int) -> None:
            message = Position(**{**FIELDS, "timestamp": stamp})
            publisher.put(msgpack.packb(message.model_dump()))

        return send

    with open_session(case.endpoint) as session:
        yield [make_send(publisher) for publisher in declare_publishers(session, case)]


def receive(case: Case, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    with open_session(case.endpoint) as session:
        subscriber = session.declare_subscriber(key(case.vehicle), zenoh.handlers.FifoChannel(1024))
        ready()
        for sample in subscriber:
            message: BaseModel = Position.model_validate(msgpack.unpackb(sample.payload.to_bytes(), use_list=False))
            if not seen(message.timestamp if message.x else 0):
                break
        subscriber.undeclare()
