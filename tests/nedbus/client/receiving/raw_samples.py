"""Fake samples with the attributes of Zenoh's samples, which cannot be created in Python."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import cast

import zenoh

import nedbus
from nedbus import Mode
from nedbus.client.receiving import Decoder, Inbox, LayoutLookup
from nedbus.transport import RawSample
from tests.flights.local_position import encode, encoding_of
from tests.flights.messages import message

KEY = "nedbus/1/vehicle_local_position"
OTHER_KEY = "nedbus/2/vehicle_local_position"
SOURCE = encoding_of("sim")


class Payload(bytes):
    """A fake zenoh.ZBytes."""

    def to_bytes(self) -> bytes:
        return bytes(self)


VALID = Payload(encode(message(1)))
INVALID = Payload(bytes(len(VALID)))  # of the right size: detected only when it is decoded


class Raw(SimpleNamespace):
    """A fake sample that supports weak references, unlike SimpleNamespace."""


def source_info(number: int, publisher: str) -> zenoh.SourceInfo:
    """Return source info with a sequence number, from the first publisher of the session `publisher`."""
    entity = SimpleNamespace(zid=publisher, eid=1)
    return cast("zenoh.SourceInfo", SimpleNamespace(source_sn=number, source_id=entity))


def name_of(publisher: str) -> str:
    """Return the name that a reader derives for a publisher."""
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
    congestion_control: zenoh.CongestionControl = zenoh.CongestionControl.DROP,
) -> RawSample:
    """Return a sample of a publisher; `number`: the sequence number, or None to omit it."""
    info = None if number is None else source_info(number, publisher)
    if payload is None:
        payload = VALID if timestamp == 1 else Payload(encode(message(timestamp)))
    read = {
        "payload": payload,
        "key_expr": key,
        "source_info": info,
        "encoding": encoding,
        "timestamp": stamp,
    }
    return cast(
        "RawSample", Raw(**read, kind=zenoh.SampleKind.PUT, congestion_control=congestion_control)
    )


def junk(payload: bytes, key: str = KEY) -> RawSample:
    """Return a sample with this payload and without a sequence number."""
    return raw(None, payload=Payload(payload), key=key)


def make_queue(
    mode: Mode, *, limit: int | None = None, clock: Callable[[], float] = time.monotonic
) -> Inbox:
    """Return an empty queue."""
    decoder = Decoder(LayoutLookup(lambda _: {}), prefix="nedbus")
    return Inbox(mode, decoder, key_exprs=("queue",), limit=limit, clock=clock)


def put(inbox: Inbox, samples: Sequence[RawSample], *, overflowed: bool = False) -> None:
    """Put samples into a queue, and count all gaps as lost, because no publisher replies."""
    inbox.put(samples, overflowed=overflowed)
    inbox.give_up()


def drain(inbox: Inbox) -> list[nedbus.Sample]:
    """Remove and return all queued samples."""
    return list(iter(partial(inbox.pop, rows=False), None))


def timestamps(inbox: Inbox) -> list[int]:
    """Remove all queued samples and return their timestamps."""
    return [sample.message.timestamp for sample in drain(inbox)]
