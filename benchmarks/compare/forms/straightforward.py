"""The straightforward way: a Pydantic model, a msgpack map of its fields, validated again on arrival."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import msgpack
import zenoh
from pydantic import ConfigDict, create_model

from benchmarks.compare.case import Case
from benchmarks.compare.fields import FIELDS
from benchmarks.compare.zenoh_session import declare_publishers, open_session, receive_each

Position = create_model(
    "Position",
    __config__=ConfigDict(frozen=True, strict=True, extra="forbid"),
    **{
        name: (tuple[float, float] if type(value) is tuple else type(value), ...)
        for name, value in FIELDS.items()
    },
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
    def stamp(payload: bytes) -> int:
        message = Position.model_validate(msgpack.unpackb(payload, use_list=False))
        return message.timestamp if message.x else 0

    receive_each(case, ready, seen, stamp)
