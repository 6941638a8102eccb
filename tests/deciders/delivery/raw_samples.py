"""Samples and sequences made by hand: Python cannot make Zenoh's samples, these have the attributes that are read."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import cast

import zenoh

import nedbus
from nedbus import Mode
from nedbus.client.receiving import Decoder, LayoutLookup, PendingQueue
from nedbus.transport import RawSample
from nedbus_msgs import encode
from tests.flights.first_message import encoding_of
from tests.flights.messages import message

KEY = "nedbus/1/vehicle_local_position"
OTHER_KEY = "nedbus/2/vehicle_local_position"
SOURCE = encoding_of("sim")


class Payload(bytes):
    """Zenoh's bytes."""

    def to_bytes(self) -> bytes:
        return bytes(self)


VALID = Payload(encode(message(1)))
INVALID = Payload(bytes(len(VALID)))  # of the right size, so that only its reader notices


class Raw(SimpleNamespace):
    """The attributes of a Zenoh sample that are read; unlike its base, weak references to it are possible."""


def source_info(number: int, publisher: str) -> zenoh.SourceInfo:
    """Return the sequence number of a message, and its publisher: the first of the session with this name."""
    entity = SimpleNamespace(zid=publisher, eid=1)
    return cast("zenoh.SourceInfo", SimpleNamespace(source_sn=number, source_id=entity))


def name_of(publisher: str) -> str:
    """Return what a reader calls a publisher."""
    return f"{publisher}:1"


def raw(
    number: int | None,
    *,
    timestamp: int = 1,
    key: str = KEY,
    publisher: str = "a",
    payload: Payload | None = None,
    encoding: str = SOURCE,
    stamp: object = None,
) -> RawSample:
    """Return a sample with a publisher's sequence number, None for one without."""
    info = None if number is None else source_info(number, publisher)
    if payload is None:
        payload = VALID if timestamp == 1 else Payload(encode(message(timestamp)))
    read = {"payload": payload, "key_expr": key, "source_info": info, "encoding": encoding, "timestamp": stamp}
    return cast("RawSample", Raw(**read, kind=zenoh.SampleKind.PUT))


def junk(payload: bytes, key: str = KEY) -> RawSample:
    """Return a sample with this payload, and without a sequence number."""
    return raw(None, payload=Payload(payload), key=key)


def make_queue(mode: Mode, *, clock: Callable[[], float] = time.monotonic) -> PendingQueue:
    """Return an empty queue."""
    return PendingQueue(mode, Decoder(LayoutLookup(lambda _: {}), prefix="nedbus"), name="queue", clock=clock)


def put(pending_queue: PendingQueue, samples: Sequence[RawSample], *, overflowed: bool = False) -> None:
    """Put samples into a queue; what is missing is given up, as nobody has it."""
    pending_queue.put(samples, overflowed=overflowed)
    pending_queue.give_up()


def drain(pending_queue: PendingQueue) -> list[nedbus.Sample]:
    """Take all that is queued."""
    return list(iter(partial(pending_queue.pop, rows=False), None))


def timestamps(pending_queue: PendingQueue) -> list[int]:
    """Take all that is queued, and return the timestamp of each."""
    return [sample.message.timestamp for sample in drain(pending_queue)]
