"""A PX4 that speaks Zenoh itself, and every other publisher of this message over rmw_zenoh, as they come."""

from __future__ import annotations

import logging
import math
import queue
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import zenoh

from nedbus.errors import AddressError, ConnectError, DecodeError, SourceError
from nedbus.rmw_zenoh import NO_HASH, Attachment, TopicKey, is_ours, split_topic
from nedbus.session import Session, check_endpoints, open_client, while_open
from nedbus_msgs import ROS2_TYPES, Address, dds_type, decode_cdr, layout_of_type_hash

from .record import Home, Record, Refusal
from .spec import Px4ZenohOptions

_log = logging.getLogger(__name__)

_WAITING: Final = 4096  # samples that wait to be read
_TICK: Final = 0.25  # s
_KEYS: Final = 1000  # keys that are listened to; a vehicle has a handful
_PAYLOAD_LIMIT: Final = 1024  # bytes that are looked at
_GAP: Final = 1_000_000  # messages that can have been lost at once; more is no gap
_APART: Final = "give each a namespace or a domain of its own"
_LEFT: Final = 3.0  # s of silence after which another key may speak for the same vehicle and topic


@dataclass(slots=True, eq=False)
class _Stream:
    """One key: where its messages belong, how they are laid out, and how far its sequence is."""

    key: str
    address: Address
    layout: str
    gid: bytes | None = None
    sequence: int | None = None
    heard: float = -math.inf
    stepped_back: float = -math.inf
    ours: bool = False


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
        """Listen; raise SourceError when no router answers, or the connection is closed."""
        self._streams.clear()
        self._speakers.clear()
        waiting: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        dropped = told = 0

        def hand_over(sample: zenoh.Sample) -> None:
            nonlocal dropped
            if waiting.qsize() >= _WAITING:
                with suppress(queue.Empty):
                    waiting.get_nowait()
                dropped += 1
            waiting.put(sample)

        session = self._open()
        try:
            with while_open(session):
                domain = "*" if self._options.domain is None else self._options.domain
                for name in ROS2_TYPES:
                    callback = zenoh.handlers.Callback(hand_over, indirect=False)
                    session.declare_subscriber(f"{domain}/**/{dds_type(name)}/*", callback)
            yield None
            while not session.is_closed():
                if dropped > told:
                    yield Refusal("reader", "messages came faster than they can be read", count=dropped - told)
                    told = dropped
                try:
                    sample = waiting.get(timeout=_TICK)
                except queue.Empty:
                    yield None
                else:
                    yield self._read(sample)
            raise SourceError(self._name, "the connection was closed")
        finally:
            session.close()

    @property
    def _name(self) -> str:
        return f"px4-zenoh:{' or '.join(self._endpoints)}"

    def _open(self) -> Session:
        try:
            return open_client(self._endpoints, timeout=0.5, tls=self._tls)
        except ConnectError as exc:
            reason = "no Zenoh router answers there: start one, or name another as px4-zenoh:tcp/HOST:7447"
            raise SourceError(self._name, reason) from exc

    def _read(self, sample: zenoh.Sample) -> Record | Refusal | None:
        key = str(sample.key_expr)
        stream = self._streams.get(key)
        try:
            if sample.kind != zenoh.SampleKind.PUT:
                return None
            if stream is None:
                stream = self._learn(key)
            attachment = None if sample.attachment is None else Attachment.parse(sample.attachment.to_bytes())
            if attachment is not None and is_ours(attachment.gid):
                self._tell_of_loop(stream)
                return None
            self._let_speak(stream, attachment)
            if len(sample.payload) > _PAYLOAD_LIMIT:
                raise DecodeError(f"{len(sample.payload)} bytes")
            fields = decode_cdr(sample.payload.to_bytes(), layout=stream.layout)
            lost, restarted = self._follow(stream, attachment)
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
        vehicles = self._options.vehicles
        if namespace in vehicles:
            return vehicles[namespace]
        expected = domain == (self._options.domain or 0)
        of_domain = vehicles.get(str(domain), "" if expected else f"domain{domain}")
        return "-".join(filter(None, [of_domain, namespace.replace("/", "-")])) or self._vehicle

    def _tell_of_loop(self, stream: _Stream) -> None:
        if not stream.ours:
            stream.ours = True
            _log.info("%s is what nedbus ros2 gave to ROS 2: it is left out, as it would loop", stream.key)

    def _let_speak(self, stream: _Stream, attachment: Attachment | None) -> None:
        """Raise DecodeError while somebody else speaks for the same address: another key, or another publisher."""
        now = time.monotonic()
        speaker = self._speakers.setdefault(stream.address, stream)
        if speaker is not stream:
            if now - speaker.heard < _LEFT:
                raise DecodeError(f"{speaker.key} is {stream.address} already: name one of them with vehicles=")
            self._speakers[stream.address] = stream
        if attachment is not None and attachment.gid != stream.gid:
            if stream.gid is not None and now - stream.heard < _LEFT:
                raise DecodeError(f"two publishers share this key: {_APART}")
            stream.gid, stream.sequence = attachment.gid, None

    def _follow(self, stream: _Stream, attachment: Attachment | None) -> tuple[int, bool]:
        """Return how many messages were lost just before this one, and whether its vehicle started again.

        Raises DecodeError for a message that came twice, and for a second vehicle that has the first one's id.
        """
        now = time.monotonic()
        lost, restarted = 0, False
        if attachment is not None:
            step = 1 if stream.sequence is None else attachment.sequence - stream.sequence
            if step == 0:
                raise DecodeError(f"number {attachment.sequence} came twice")
            if step < 0:
                again = now - stream.stepped_back < _LEFT
                stream.stepped_back = now
                if again:
                    raise DecodeError(f"its sequence goes back and forth, as if two vehicles shared this key: {_APART}")
                restarted = True
                _log.warning("%s: its sequence goes back: the vehicle started again", stream.key)
            elif step <= _GAP:
                lost = step - 1
            stream.sequence = attachment.sequence
        stream.heard = now
        return lost, restarted
