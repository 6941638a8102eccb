"""msgspec over plain Zenoh: a struct as a msgpack array, its types checked on arrival."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import msgspec
import zenoh

from benchmarks.compare.case import Case
from benchmarks.compare.fields import FIELDS
from benchmarks.compare.zenoh_session import KEY, open_session, receive_each

PACKAGES = ["msgspec==0.22.0", "eclipse-zenoh==1.10.2"]

Position = msgspec.defstruct(
    "Position",
    [
        (name, tuple[float, float] if type(value) is tuple else type(value))
        for name, value in FIELDS.items()
    ],
    array_like=True,
    frozen=True,
)


@contextmanager
def publish(case: Case) -> Iterator[list[Callable[[int], None]]]:
    encoder = msgspec.msgpack.Encoder()
    with open_session(case.endpoint) as session:
        publisher = session.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
        yield [
            lambda stamp: publisher.put(encoder.encode(Position(**{**FIELDS, "timestamp": stamp})))
        ]


def receive(case: Case, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    decoder = msgspec.msgpack.Decoder(Position)

    def stamp(payload: bytes) -> int:
        message = decoder.decode(payload)
        return message.timestamp if message.x else 0

    receive_each(case, ready, seen, stamp)
