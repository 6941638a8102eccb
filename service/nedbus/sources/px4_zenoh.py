"""A PX4 that speaks Zenoh itself, and every other publisher of this message over rmw_zenoh, as they come."""

from __future__ import annotations

import logging
import queue
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import zenoh

from nedbus.errors import AddressError, DecodeError, SourceError
from nedbus.rmw_zenoh import NO_HASH, Attachment, TopicKey, is_ours, split_topic
from nedbus.session import check_endpoints, open_client, while_open
from nedbus_msgs import ROS2_TYPES, Address, dds_type, decode_cdr, layout_of_type_hash

from .record import Home, Record, Refusal
from .spec import Px4ZenohOptions

_log = logging.getLogger(__name__)

_WAITING: Final = 4096  # samples that wait to be read
_TICK: Final = 0.25  # s
_KEYS: Final = 1000  # keys that are listened to; a vehicle has a handful
_PAYLOAD_LIMIT: Final = 1024  # bytes that are looked at
_LEFT: Final = 3.0  # s of silence after which another key may speak for the same vehicle and topic


@dataclass(slots=True, eq=False)
class _Stream:
    """One key: where its messages belong, how they are laid out, and how far its sequence is."""

    key: str
    address: Address
    layout: str
    sequence: int | None = None
    heard: float = 0.0


class Px4ZenohSource:
    """Everything of type px4_msgs/VehicleLocalPosition at a router: that of the service, or another one."""

    def __init__(self, endpoint: str, options: Px4ZenohOptions, home: Home) -> None:
        if endpoint:
            check_endpoints([endpoint], where="px4-zenoh")
        self._endpoints = (endpoint,) if endpoint else home.routers
        self._tls = home.tls
        self._options = options
        self._vehicle = options.vehicle or home.vehicle
        self._streams: dict[str, _Stream] = {}
        self._speakers: dict[Address, _Stream] = {}

    def listen(self) -> Iterator[Record | Refusal | None]:
        """Listen; raise ConnectError when no router answers, SourceError when it goes away for good."""
        self._streams.clear()
        self._speakers.clear()
        waiting: queue.Queue[zenoh.Sample] = queue.Queue(_WAITING)
        dropped = 0

        def hand_over(sample: zenoh.Sample) -> None:
            nonlocal dropped
            try:
                waiting.put_nowait(sample)
            except queue.Full:  # the sequence numbers tell the same where there are any
                dropped += 1

        session = open_client(self._endpoints, timeout=1.0, tls=self._tls)
        try:
            with while_open(session):
                domain = "*" if self._options.domain is None else self._options.domain
                for name in ROS2_TYPES:
                    callback = zenoh.handlers.Callback(hand_over, indirect=False)
                    session.declare_subscriber(f"{domain}/**/{dds_type(name)}/*", callback)
            while not session.is_closed():
                if dropped:
                    yield Refusal("reader", f"{dropped} messages came faster than they can be read")
                    dropped = 0
                try:
                    sample = waiting.get(timeout=_TICK)
                except queue.Empty:
                    yield None
                else:
                    yield self._read(sample)
            raise SourceError(" or ".join(self._endpoints), "the connection was closed")
        finally:
            session.close()

    def _read(self, sample: zenoh.Sample) -> Record | Refusal | None:
        key = str(sample.key_expr)
        stream = self._streams.get(key)
        try:
            if sample.kind != zenoh.SampleKind.PUT:
                return None
            if stream is None:
                stream = self._learn(key)
            lost, restarted = self._follow(stream, sample.attachment)
            if len(sample.payload) > _PAYLOAD_LIMIT:
                raise DecodeError(f"{len(sample.payload)} bytes")
            fields = decode_cdr(sample.payload.to_bytes(), layout=stream.layout)
        except (AddressError, DecodeError) as exc:
            return Refusal(key, str(exc), stream.address if stream else None)
        return Record(0.0, stream.address, fields, lost, restarted)

    def _learn(self, text: str) -> _Stream:
        key = TopicKey.parse(text)
        address = self._address(key)
        layout = layout_of_type_hash(key.type_hash)
        if key.type_hash == NO_HASH:
            layout = self._options.layout
            if layout is None:
                raise DecodeError(f"the key says {NO_HASH}: name the layout, as in px4-zenoh:?layout=1.14")
        if layout is None:
            raise DecodeError(f"no layout that is known here has the type hash {key.type_hash}: update nedbus")
        stream = _Stream(text, address, layout)
        if len(self._streams) >= _KEYS:
            raise DecodeError(f"more than {_KEYS} keys: name a domain, as in px4-zenoh:?domain=0")
        self._streams[text] = stream
        return stream

    def _address(self, key: TopicKey) -> Address:
        namespace, topic, instance = split_topic(key.topic)
        return Address(self._vehicle_of(key.domain, namespace), topic, instance)

    def _vehicle_of(self, domain: int, namespace: str) -> str:
        """Return the vehicle that is mapped, else one named by namespace and by any domain but the expected one."""
        for name in (namespace, str(domain)):
            if name in self._options.vehicles:
                return self._options.vehicles[name]
        names = [namespace.replace("/", "-")] if namespace else []
        if domain != (self._options.domain or 0):
            names.insert(0, f"domain{domain}")
        return "-".join(names) or self._vehicle

    def _follow(self, stream: _Stream, attachment: zenoh.ZBytes | None) -> tuple[int, bool]:
        """Return how many messages were lost just before this one, and whether its vehicle started again."""
        lost, restarted = 0, False
        now = time.monotonic()
        if attachment is not None:
            found = Attachment.parse(attachment.to_bytes())
            if is_ours(found.gid):
                raise DecodeError("nedbus itself published this to ROS 2 (nedbus ros2): taking it in again would loop")
            if stream.sequence is not None:
                if found.sequence == stream.sequence:
                    raise DecodeError(f"number {found.sequence} came twice")
                restarted = found.sequence < stream.sequence
                lost = max(0, found.sequence - stream.sequence - 1)
            stream.sequence = found.sequence
        speaker = self._speakers.get(stream.address)
        if speaker is not None and speaker is not stream and now - speaker.heard < _LEFT:
            raise DecodeError(f"{speaker.key} is {stream.address} already: name one of them with vehicles=")
        self._speakers[stream.address] = stream
        stream.heard = now
        if restarted:
            _log.warning("%s: its sequence goes back: the vehicle started again, or two share this key", stream.key)
        return lost, restarted
