"""ZRM: protobuf over Zenoh, the type's name attached to each message; the session's settings make publishers wait."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import zrm
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message

from benchmarks.compare.case import Case
from benchmarks.compare.fields import FIELDS, TYPES
from benchmarks.compare.zenoh_session import KEY, client_config

PACKAGES = ["zrm==3.1.2"]


_PROTO = descriptor_pb2.FieldDescriptorProto
PROTOBUF_TYPES = {  # smallest types that can hold PX4's
    "bool": _PROTO.TYPE_BOOL, "uint64": _PROTO.TYPE_UINT64, "uint8": _PROTO.TYPE_UINT32,
    "float32": _PROTO.TYPE_FLOAT, "float64": _PROTO.TYPE_DOUBLE,
}  # fmt: skip


def message_class() -> type[Message]:
    """Build the class that protoc would generate, from a file descriptor."""
    file = descriptor_pb2.FileDescriptorProto(name="bench/msgs/position.proto", package="bench", syntax="proto3")
    position = file.message_type.add(name="Position")
    for number, (name, type_name) in enumerate(TYPES.items(), start=1):
        kind, is_array, _ = type_name.partition("[")
        field = position.field.add(name=name, number=number, type=PROTOBUF_TYPES[kind])
        field.label = field.LABEL_REPEATED if is_array else field.LABEL_OPTIONAL
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("bench.Position"))


Position = message_class()


def open_session(endpoint: str) -> zrm.Session:
    """Open a client whose publishers wait instead of dropping messages."""
    waits = [{"key_exprs": [KEY], "config": {"congestion_control": "block"}}]
    return zrm.open(client_config(endpoint, {"qos/publication": waits}))


@contextmanager
def publish(case: Case) -> Iterator[list[Callable[[int], None]]]:
    with open_session(case.endpoint) as session:
        publisher = zrm.Publisher(session, KEY, Position)
        yield [lambda stamp: publisher.publish(Position(**{**FIELDS, "timestamp": stamp}))]
        publisher.close()


def receive(case: Case, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    done = threading.Event()

    def take(message: Message) -> None:
        if not seen(message.timestamp if message.x else 0):
            done.set()

    with open_session(case.endpoint) as session:
        subscriber = zrm.Subscriber(session, KEY, Position, take)
        ready()
        done.wait()
        subscriber.close()
