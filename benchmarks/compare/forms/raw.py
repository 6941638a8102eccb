"""Raw Zenoh: bytes of the same size, without any codec; the limit for everything that uses Zenoh from Python."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import zenoh

from benchmarks.compare.case import Case
from benchmarks.compare.zenoh_session import declare_publishers, open_session, receive_each

SIZE = 244

Send = Callable[[int], None]


@contextmanager
def publish(case: Case) -> Iterator[list[Send]]:
    rest = bytes(SIZE - 8)

    def make_send(publisher: zenoh.Publisher) -> Send:
        return lambda stamp: publisher.put(stamp.to_bytes(8, "big") + rest)

    with open_session(case.endpoint) as session:
        yield [make_send(publisher) for publisher in declare_publishers(session, case)]


def receive(case: Case, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    receive_each(case, ready, seen, lambda payload: int.from_bytes(payload[:8], "big"))
