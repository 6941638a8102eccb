"""Receive from PX4's Zenoh module, and from any other publisher of VehicleLocalPosition over rmw_zenoh."""

from __future__ import annotations

import logging
import queue
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.errors import AddressError, ConnectError, DecodeError, SourceError
from nedbus.transport import Attachment, Session, check_endpoints, is_nedbus_gid, open_client, while_open
from nedbus_msgs import ROS2_TYPES, dds_type, decode_cdr

from .options import Px4ZenohOptions
from .px4_streams import Stream, StreamRegistry, track_sequence
from .source import Rejection, SourceContext, SourceMessage

_log = logging.getLogger(__name__)

_MAX_PENDING: Final = 4096  # samples that wait to be decoded
_TICK: Final = 0.25  # s
_MAX_PAYLOAD: Final = 1024  # bytes


class Px4ZenohSource:
    """Everything of type px4_msgs/VehicleLocalPosition at a router: that of the service, or another one."""

    def __init__(self, endpoint: str, options: Px4ZenohOptions, context: SourceContext) -> None:
        if endpoint:
            check_endpoints([endpoint], where="px4-zenoh")
        self._endpoints = (endpoint,) if endpoint else context.routers
        self._tls = context.tls
        self._options = options
        self._vehicle = options.vehicle or context.vehicle

    def listen(self) -> Iterator[SourceMessage | Rejection | None]:
        """Receive; raise SourceError when no router answers, or the connection is closed."""
        decoder = _Decoder(StreamRegistry(self._options, vehicle=self._vehicle))
        pending: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        dropped = reported = 0

        def enqueue(sample: zenoh.Sample) -> None:
            nonlocal dropped
            if pending.qsize() >= _MAX_PENDING:
                with suppress(queue.Empty):
                    pending.get_nowait()
                dropped += 1
            pending.put(sample)

        session = self._open_session()
        try:
            with while_open(session):
                domain = "*" if self._options.domain is None else self._options.domain
                for name in ROS2_TYPES:
                    callback = zenoh.handlers.Callback(enqueue, indirect=False)
                    session.declare_subscriber(f"{domain}/**/{dds_type(name)}/*", callback)
            yield None
            while not session.is_closed():
                if dropped > reported:
                    yield Rejection("queue", "messages arrive faster than they are decoded", count=dropped - reported)
                    reported = dropped
                try:
                    sample = pending.get(timeout=_TICK)
                except queue.Empty:
                    yield None
                else:
                    yield decoder.decode(sample)
            raise SourceError(self._name, "the connection was closed")
        finally:
            session.close()

    @property
    def _name(self) -> str:
        return f"px4-zenoh:{' or '.join(self._endpoints)}"

    def _open_session(self) -> Session:
        try:
            return open_client(self._endpoints, timeout=0.5, tls=self._tls)
        except ConnectError as exc:
            reason = "no Zenoh router answers there: start one, or name another as px4-zenoh:tcp/HOST:7447"
            raise SourceError(self._name, reason) from exc


class _Decoder:
    """Turn samples into messages and rejections, and log what vehicles do."""

    def __init__(self, streams: StreamRegistry) -> None:
        self._streams = streams
        self._bridged: set[str] = set()  # keys on which messages of `nedbus ros2` arrived

    def decode(self, sample: zenoh.Sample) -> SourceMessage | Rejection | None:
        if sample.kind != zenoh.SampleKind.PUT:
            return None
        key = str(sample.key_expr)
        stream = self._streams.find(key)
        now = time.monotonic()
        try:
            if stream is None:
                stream = self._streams.register(key)
            attachment = None if sample.attachment is None else Attachment.parse(sample.attachment.to_bytes())
            if attachment is not None and is_nedbus_gid(attachment.gid):
                self._log_bridged(stream)
                return None
            self._streams.claim(stream, attachment, now)
            if len(sample.payload) > _MAX_PAYLOAD:
                raise DecodeError(f"{len(sample.payload)} bytes")
            fields = decode_cdr(sample.payload.to_bytes(), layout=stream.layout)
            lost, rebooted = track_sequence(stream, attachment, now)
        except (AddressError, DecodeError) as exc:
            return Rejection(key, str(exc), stream.address if stream else None)
        if rebooted:
            _log.warning("%s: its sequence restarts: the vehicle rebooted", key)
        return SourceMessage(0.0, stream.address, fields, lost, rebooted)

    def _log_bridged(self, stream: Stream) -> None:
        if stream.key not in self._bridged:
            self._bridged.add(stream.key)
            _log.info("%s comes from nedbus ros2: ignored, as it would loop", stream.key)
