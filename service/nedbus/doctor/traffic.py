"""What arrives while the doctor listens: how much on each key, from whom, how old, and whether it can be decoded."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Final

import zenoh

from nedbus.transport import RawSample, Session, entity_name, while_open
from nedbus_msgs import BY_TOPIC, Address, AddressError, DecodeError, codec_of

_RING: Final = 16_384  # samples that may arrive until they are looked at
_MAX_KEYS: Final = 2000
_LONGEST: Final = 1024  # characters of a key that is remembered
_MAX_PUBLISHERS: Final = 8  # that are told apart, for each key


@dataclass(slots=True)
class Stream:
    """What arrived on one key.

    `count`: messages; `delay`: the least time from sent to received, by the clocks of both hosts [s], None without
    timestamps; `clocks`: whose clocks stamped them; `publishers`: who sent them, where they say so.
    `error`: why the last one that cannot be decoded cannot.
    """

    address: Address | None
    count: int = 0
    delay: float | None = None
    clocks: set[str] = field(default_factory=set)
    publishers: set[str] = field(default_factory=set)
    error: str = ""


class Traffic:
    """Listen on a key expression until it is closed; nobody waits for a slow doctor."""

    def __init__(self, session: Session, key_expr: str, *, prefix: str) -> None:
        self.streams: dict[str, Stream] = {}
        self._prefix = prefix
        channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_RING)
        with while_open():
            self._subscriber = session.declare_subscriber(key_expr, channel)
        self._handler: zenoh.Handler[zenoh.Sample] = self._subscriber.handler

    def take(self) -> None:
        """Look at what has arrived by now, and at no more than the ring holds; its age is that of this moment."""
        for _ in range(_RING):
            sample = self._handler.try_recv()
            if sample is None:
                return
            self._add(sample, time.time())

    def close(self) -> None:
        """End the subscription."""
        self._subscriber.undeclare()

    def _add(self, sample: RawSample, now: float) -> None:
        key = str(sample.key_expr)
        stream = self.streams.get(key)
        if stream is None:
            if len(self.streams) >= _MAX_KEYS or len(key) > _LONGEST:
                return
            stream = self.streams[key] = Stream(_address_of(key, self._prefix))
        stream.count += 1
        stamp, info = sample.timestamp, sample.source_info
        if stamp is not None:
            delay = now - stamp.get_time_as_ntp64().as_nanos() / 1e9
            stream.delay = delay if stream.delay is None else min(delay, stream.delay)
            if len(stream.clocks) < _MAX_PUBLISHERS:
                stream.clocks.add(str(stamp.get_id()))
        if info is not None and len(stream.publishers) < _MAX_PUBLISHERS:
            stream.publishers.add(entity_name(info.source_id))
        if stream.address is not None and sample.kind == zenoh.SampleKind.PUT:
            stream.error = reason_against(sample, stream.address) or stream.error


def reason_against(sample: RawSample, address: Address) -> str:
    """Return why a payload cannot be decoded, "" if it can."""
    try:
        definition = BY_TOPIC.get(address.topic)
        if definition is not None:
            codec_of(definition).decode(sample.payload.to_bytes())
    except DecodeError as exc:
        return str(exc)
    return ""


def _address_of(key: str, prefix: str) -> Address | None:
    try:
        return Address.from_key(key, prefix=prefix)
    except AddressError:
        return None
