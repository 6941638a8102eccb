"""ZRM: protobuf over Zenoh, the type's name attached to each message; the session's settings make publishers wait."""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import zenoh
import zrm
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message

from benchmarks.compare.case import Case
from benchmarks.compare.fields import FIELDS
from benchmarks.compare.zenoh_session import KEY

PACKAGES = ["zrm==3.1.2"]


def message_class() -> type[Message]:
    """Make what protoc would, from a description of the file."""
    file = descriptor_pb2.FileDescriptorProto(name="bench/msgs/position.proto", package="bench", syntax="proto3")
    position = file.message_type.add(name="Position")
    for number, (name, value) in enumerate(FIELDS.items(), start=1):
        field = position.field.add(name=name, number=number, type=field_type(name, value))
        field.label = field.LABEL_REPEATED if type(value) is tuple else field.LABEL_OPTIONAL
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("bench.Position"))


def field_type(name: str, value: object) -> int:
    """Choose the type that PX4 has, or the smallest that holds it."""
    of = descriptor_pb2.FieldDescriptorProto
    if type(value) is bool:
        return of.TYPE_BOOL
    if type(value) is int:
        return of.TYPE_UINT64 if "timestamp" in name else of.TYPE_UINT32
    return of.TYPE_DOUBLE if name in {"ref_lat", "ref_lon"} else of.TYPE_FLOAT


Position = message_class()


def open_session(endpoint: str) -> zrm.Session:
    """Open a client of this router whose publishers wait instead of dropping."""
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "qos/publication": [{"key_exprs": [KEY], "config": {"congestion_control": "block"}}],
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zrm.open(config)


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
