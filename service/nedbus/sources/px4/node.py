"""The ROS 2 node of a source: receives messages, and declares a subscription to each published topic."""

from __future__ import annotations

import logging
import os
import queue
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.errors import AddressError, DecodeError
from nedbus.log_event import about
from nedbus.sources.source import Absence, Rejection, SourceMessage
from nedbus.transport import (
    BRIDGED_ENCODING,
    LONGEST_TOKEN,
    PX4_TYPES,
    AliveTokens,
    Attachment,
    PublisherToken,
    Session,
    TopicKey,
    node_token,
    px4_publishers_key_expr,
    while_open,
)
from nedbus_msgs import Address, decode_with

from .streams import Form, NotAcceptedError, Px4Stream, StreamRegistry

_log = logging.getLogger(__name__)

_TICK: Final = 0.25  # s
_REPORT_INTERVAL: Final = 1.0  # s between reports of absent topics
_MAX_PENDING: Final = 4096  # samples waiting to be decoded
_MAX_PENDING_BYTES: Final = 4096  # per payload
_RING_SIZE: Final = 16_384  # samples waiting for the thread
_MAX_SUBSCRIPTIONS: Final = 1000  # topics; a vehicle has a handful
_JOIN_TIMEOUT: Final = 3.0  # s
_INPUT: Final = "px4-zenoh-input"  # `sample.source` of messages to a vehicle
_TOO_FAST: Final = "queue", "messages arrive faster than they are decoded"
_TOO_LARGE: Final = "size", f"a payload of more than {_MAX_PENDING_BYTES} bytes, or a key that is too long"


class Px4ZenohNode:
    """Receive from all publishers, convert samples to messages or rejections, and appear in ROS 2; a context manager.

    Samples wait in a channel in Rust, which a thread of this node drains: a callback would make Zenoh wait for the
    GIL. Its liveliness tokens make ROS 2 list this source, and publishers in ROS 2 see a subscriber.
    """

    def __init__(self, session: Session, streams: StreamRegistry, *, domain: int | None) -> None:
        self._session, self._streams = session, streams
        self._pending: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        self._tokens = AliveTokens(session, px4_publishers_key_expr(domain))
        self._zid, self._node = str(session.info.zid()), f"nedbus_px4_zenoh_{os.getpid()}"
        self._nodes: dict[int, zenoh.LivelinessToken] = {}  # by domain
        self._subscriptions: dict[TopicKey, zenoh.LivelinessToken] = {}
        self._entities = 0
        self._dropped = Counter({_TOO_FAST: 0, _TOO_LARGE: 0})
        self._reported = Counter[tuple[str, str]]()
        key_expr = f"{'*' if domain is None else domain}/**/{PX4_TYPES}/*"
        with while_open():
            self._subscriber = session.declare_subscriber(key_expr, zenoh.handlers.RingChannel(_RING_SIZE))
        handler = self._subscriber.handler
        self._thread = threading.Thread(target=self._receive, args=[handler], name="nedbus-px4", daemon=True)
        self._thread.start()

    def run(self) -> Iterator[SourceMessage | Rejection | Absence | None]:
        """Yield events until the iterator is closed."""
        yield None
        last: Absence | None = None
        next_report = 0.0
        while True:
            yield from self._dropped_messages()
            sample: zenoh.Sample | None = None
            with suppress(queue.Empty):
                sample = self._pending.get(timeout=_TICK)
            for token, alive in self._tokens.take():  # older than the sample
                self._on_token(token, alive=alive)
            yield None if sample is None else self._decode(sample)
            if (now := time.monotonic()) >= next_report:
                next_report = now + _REPORT_INTERVAL
                if (absence := self._streams.report(now)) != last:
                    yield (last := absence)

    def __enter__(self) -> Px4ZenohNode:
        return self

    def __exit__(self, *exc: object) -> None:
        with suppress(zenoh.ZError):  # the session may be closed already
            for token in (*self._subscriptions.values(), *self._nodes.values()):
                token.undeclare()
            self._tokens.undeclare()
            self._subscriber.undeclare()
        self._thread.join(_JOIN_TIMEOUT)

    def _decode(self, sample: zenoh.Sample) -> SourceMessage | Rejection | None:
        if sample.kind != zenoh.SampleKind.PUT:
            return None
        key, now = str(sample.key_expr), time.monotonic()
        is_bridged = str(sample.encoding) == BRIDGED_ENCODING
        address: Address | None = None
        try:
            stream = self._streams.hear(key, now)
            if stream.not_carried is not None:
                is_unexpected = stream.not_carried and not stream.tokens and not is_bridged  # else an absence, or none
                reason = f"{stream.not_carried}: not selected by topics= or msg="
                return Rejection(key, reason) if is_unexpected else None
            definition, layout, unknown = stream.form or self._find_form(stream)
            address = stream.address
            attachment = None if sample.attachment is None else Attachment.parse(sample.attachment.to_bytes())
            if is_bridged:
                if not stream.is_bridged:
                    extra = about("looped", source="px4-zenoh")
                    _log.info("%s comes from nedbus ros2: ignored to avoid a loop", key, extra=extra)
                stream.is_bridged = True
                return None
            fields = decode_with(definition, sample.payload.to_bytes(), layout)
            lost, rebooted = self._streams.accept(stream, attachment, now)
        except (AddressError, DecodeError, NotAcceptedError) as exc:
            return Rejection(key, exc.reason if isinstance(exc, DecodeError) else str(exc), address)
        for name in unknown:
            del fields[name]
        if rebooted:
            extra = about("rebooted", address, source="px4-zenoh")
            _log.warning("%s: the publisher restarted, as the vehicle rebooted", key, extra=extra)
        source = _INPUT if stream.is_input else None
        return SourceMessage(0.0, stream.address, fields, lost, rebooted, definition=definition, source=source)

    def _find_form(self, stream: Px4Stream) -> Form:
        form = self._streams.form_of(stream)
        if form.unknown:
            extra = about("newer-layout", stream.address, source="px4-zenoh")
            _log.warning("%s: unknown fields left out: %s", stream.key, ", ".join(form.unknown), extra=extra)
        return form

    def _on_token(self, text: str, *, alive: bool) -> None:
        """Add or remove the publisher of a liveliness token."""
        now = time.monotonic()
        try:
            token = PublisherToken.parse(text)
            if alive:
                self._streams.add_publisher(token, now)
        except (AddressError, DecodeError, NotAcceptedError):
            return  # its messages are rejected
        if alive and not token.node.startswith("nedbus_"):
            self._subscribe(token.key)
        elif not alive and self._streams.remove_publisher(token, now) and token.key in self._subscriptions:
            with suppress(zenoh.ZError):  # the session may be closed already
                self._subscriptions.pop(token.key).undeclare()

    def _dropped_messages(self) -> Iterator[Rejection]:
        """Yield one rejection per reason for the messages dropped since the last call."""
        new = self._dropped - self._reported
        for (where, reason), count in new.items():
            yield Rejection(where, reason, count=count)
        self._reported += new

    def _subscribe(self, key: TopicKey) -> None:
        """Declare a subscription to a topic, for ROS 2 to list."""
        if key in self._subscriptions or len(self._subscriptions) >= _MAX_SUBSCRIPTIONS:
            return
        if key.domain not in self._nodes:
            self._nodes[key.domain] = self._declare(node_token(key.domain, self._zid, self._node))
        self._entities += 1
        self._subscriptions[key] = self._declare(key.token("MS", self._zid, self._node, self._entities))

    def _declare(self, text: str) -> zenoh.LivelinessToken:
        with while_open():
            return self._session.liveliness().declare_token(text)

    def _receive(self, handler: zenoh.Handler[zenoh.Sample]) -> None:
        with suppress(zenoh.ZError):  # undeclared
            while True:
                sample = handler.recv()
                if self._pending.qsize() >= _MAX_PENDING:
                    self._dropped[_TOO_FAST] += 1
                elif len(sample.payload) > _MAX_PENDING_BYTES or len(str(sample.key_expr)) > LONGEST_TOKEN:
                    self._dropped[_TOO_LARGE] += 1
                else:
                    self._pending.put(sample)
