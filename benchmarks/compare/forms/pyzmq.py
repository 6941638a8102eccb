"""ZeroMQ without a router: PUB and SUB, a msgpack map without types; a publisher that is too fast waits."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import msgpack
import zmq

from benchmarks.compare.case import Case
from benchmarks.compare.fields import FIELDS

PACKAGES = ["pyzmq==27.3.0", "msgpack==1.2.4"]


def address(endpoint: str) -> str:
    """Return an address with the port after the router's."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    return f"tcp://{host}:{int(port) + 1}"


@contextmanager
def publish(case: Case) -> Iterator[list[Callable[[int], None]]]:
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        socket.set(zmq.SNDHWM, 1024)
        socket.set(zmq.XPUB_NODROP, 1)
        socket.set(zmq.LINGER, 0)
        socket.bind(address(case.endpoint))
        yield [lambda stamp: socket.send(msgpack.packb({**FIELDS, "timestamp": stamp}))]


def receive(case: Case, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.set(zmq.RCVHWM, 1024)
        socket.set(zmq.SUBSCRIBE, b"")
        socket.connect(address(case.endpoint))
        ready()
        while True:
            message = msgpack.unpackb(socket.recv())
            if not seen(message["timestamp"] if message["x"] else 0):
                break
