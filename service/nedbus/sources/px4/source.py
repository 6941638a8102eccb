"""Receive from PX4's Zenoh module, and from any other publisher of px4_msgs over rmw_zenoh."""

from __future__ import annotations

import logging
import queue
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from typing import Final

import zenoh

from nedbus.errors import AddressError, ConnectError, DecodeError, SourceError
from nedbus.log_event import about
from nedbus.sources.options import Px4ZenohOptions
from nedbus.sources.source import Absence, Rejection, SourceContext, SourceMessage
from nedbus.transport import (
    BRIDGED_ENCODING,
    Attachment,
    PublisherToken,
    Session,
    check_endpoints,
    open_client,
)
from nedbus_msgs import Address, decode_with

from .definitions import read_definitions
from .node import Px4ZenohNode
from .streams import Form, NotAcceptedError, NotCarriedError, Px4Stream, StreamRegistry

_log = logging.getLogger(__name__)

_TICK: Final = 0.25  # s
_REPORT_INTERVAL: Final = 1.0  # s between two reports of absent topics
_TOKENS_TIMEOUT: Final = 3.0  # s that a router has to list the publishers again, where too many changed at once
_CONNECT_TIMEOUT: Final = 0.5  # s; the service ends within 1 s, and tries again until then


class Px4ZenohSource:
    """Everything of px4_msgs at a router: that of the service, or another one."""

    def __init__(self, endpoint: str, options: Px4ZenohOptions, context: SourceContext) -> None:
        if endpoint:
            check_endpoints([endpoint], where="px4-zenoh")
        self._endpoints = (endpoint,) if endpoint else context.routers
        self._is_own = not endpoint or endpoint in context.routers
        self._tls = context.tls
        self._options = options
        self._given = read_definitions(options.msg)
        self._vehicle = options.vehicle or context.vehicle
        self._name = f"px4-zenoh:{' or '.join(self._endpoints)}"

    def listen(self, router: Session | None) -> Iterator[SourceMessage | Rejection | Absence | None]:
        """Receive; raise SourceError when no router answers."""
        with ExitStack() as closing:
            if router is not None and self._is_own:
                # A link between the router and a client of its own would drop messages beyond its queue.
                session = router
            else:
                session = self._open_session()
                closing.callback(session.close)
            streams = StreamRegistry(self._options, vehicle=self._vehicle, given=self._given)
            node = closing.enter_context(Px4ZenohNode(session, domain=self._options.domain))
            decoder = _Decoder(streams, node)
            yield None
            last: Absence | None = None
            next_report = 0.0
            while True:  # until this iterator is closed: a session that lost its router connects again by itself
                yield from node.dropped()
                sample: zenoh.Sample | None = None
                with suppress(queue.Empty):
                    sample = node.pending.get(timeout=_TICK)
                for token, alive in node.tokens.take(timeout=_TOKENS_TIMEOUT):  # those before the message are here
                    decoder.on_token(token, alive=alive)
                yield None if sample is None else decoder.decode(sample)
                if (now := time.monotonic()) >= next_report:
                    next_report = now + _REPORT_INTERVAL
                    if (absence := streams.report(now)) != last:
                        yield (last := absence)

    def _open_session(self) -> Session:
        try:
            return open_client(self._endpoints, timeout=_CONNECT_TIMEOUT, tls=self._tls)
        except ConnectError as exc:
            reason = "no Zenoh router answers there: start one, or name another as px4-zenoh:tcp/HOST:7447"
            raise SourceError(self._name, reason) from exc


class _Decoder:
    """Turn samples into messages and rejections, and log reboots and loops."""

    def __init__(self, streams: StreamRegistry, node: Px4ZenohNode) -> None:
        self._streams = streams
        self._node = node
        self._bridged: set[str] = set()  # keys on which messages of `nedbus ros2` arrived

    def decode(self, sample: zenoh.Sample) -> SourceMessage | Rejection | None:
        if sample.kind != zenoh.SampleKind.PUT:
            return None
        key, now = str(sample.key_expr), time.monotonic()
        is_bridged = str(sample.encoding) == BRIDGED_ENCODING
        address: Address | None = None
        try:
            stream = self._streams.hear(key, now)
            if stream.not_carried is not None:
                return None
            definition, layout, unknown = stream.form or self._find_form(stream)
            address = stream.address
            attachment = None if sample.attachment is None else Attachment.parse(sample.attachment.to_bytes())
            if is_bridged:
                self._log_bridged(key)
                return None
            fields = decode_with(definition, sample.payload.to_bytes(), layout)
            lost, rebooted = self._streams.accept(stream, attachment, now)
        except NotCarriedError as exc:
            return Rejection(key, f"{exc}: not asked for by topics= or msg=") if str(exc) and not is_bridged else None
        except (AddressError, DecodeError, NotAcceptedError) as exc:
            return Rejection(key, exc.reason if isinstance(exc, DecodeError) else str(exc), address)
        for name in unknown:
            del fields[name]
        if rebooted:
            extra = about("rebooted", address, source="px4-zenoh")
            _log.warning("%s: its publisher restarted: the vehicle rebooted", key, extra=extra)
        return SourceMessage(0.0, stream.address, fields, lost, rebooted, definition=definition)

    def _find_form(self, stream: Px4Stream) -> Form:
        form = self._streams.form_of(stream)
        if form.unknown:
            extra = about("newer-layout", stream.address, source="px4-zenoh")
            _log.warning("%s: unknown here, and left out: %s", stream.key, ", ".join(form.unknown), extra=extra)
        return form

    def on_token(self, text: str, *, alive: bool) -> None:
        """Add the publisher of a liveliness token, or remove it."""
        now = time.monotonic()
        try:
            token = PublisherToken.parse(text)
            if alive:
                self._streams.add_publisher(token, now)
        except (AddressError, DecodeError, NotAcceptedError):
            return  # its messages are rejected
        if alive and not token.node.startswith("nedbus_"):
            self._node.subscribe(token.key)
        elif not alive and self._streams.remove_publisher(token, now):
            self._node.unsubscribe(token.key)

    def _log_bridged(self, key: str) -> None:
        if key not in self._bridged:
            self._bridged.add(key)
            extra = about("looped", source="px4-zenoh")
            _log.info("%s comes from nedbus ros2: ignored, as it would loop", key, extra=extra)
