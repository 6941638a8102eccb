"""Rose: a msgspec struct with a header, as a msgpack map over Zenoh; its publishers always drop under load."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import msgspec
from rose import Message
from rose.node import Publisher, Subscriber

from benchmarks.compare.case import Case
from benchmarks.compare.fields import FIELDS
from benchmarks.compare.zenoh_session import KEY, open_session

PACKAGES = ["rose-py==0.1.6"]

Position = msgspec.defstruct(
    "Position",
    [(name, tuple[float, float] if type(value) is tuple else type(value)) for name, value in FIELDS.items()],
    bases=(Message,),
    kw_only=True,
)


@contextmanager
def publish(case: Case) -> Iterator[list[Callable[[int], None]]]:
    """Publish without a rose.Node, which would not dial a router."""
    with open_session(case.endpoint) as session:
        publisher = Publisher(session, "publisher", KEY, Position)
        yield [lambda stamp: publisher.publish(Position(**{**FIELDS, "timestamp": stamp}))]


def receive(case: Case, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    """Receive messages by callback, because recv() keeps only the newest."""
    done = threading.Event()

    def take(message: Message, _key: str) -> None:
        if not seen(message.timestamp if message.x else 0):
            done.set()

    with open_session(case.endpoint) as session:
        _subscriber = Subscriber(session, "receiver", KEY, Position, take)
        ready()
        done.wait()
