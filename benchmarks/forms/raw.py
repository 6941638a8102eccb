"""Raw Zenoh: bytes of the same size, without any codec; the limit for everything that uses Zenoh from Python."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import zenoh

from .zenoh_session import KEY, open_session

SIZE = 244


@contextmanager
def publish(endpoint: str) -> Iterator[Callable[[int], None]]:
    with open_session(endpoint) as session:
        publisher = session.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
        rest = bytes(SIZE - 8)
        yield lambda stamp: publisher.put(stamp.to_bytes(8, "big") + rest)


def receive(endpoint: str, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    with open_session(endpoint) as session:
        subscriber = session.declare_subscriber(KEY, zenoh.handlers.FifoChannel(1024))
        ready()
        for sample in subscriber:
            if not seen(int.from_bytes(sample.payload.to_bytes()[:8], "big")):
                break
        subscriber.undeclare()
