"""Receive from PX4's Zenoh module, and from any other publisher of px4_msgs over rmw_zenoh."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from typing import Final

import zenoh

from nedbus.errors import AddressError, ConnectError, DecodeError, SourceError
from nedbus.log_event import about
from nedbus.transport import (
    BRIDGED_ENCODING,
    LONGEST_TOKEN,
    PX4_TYPES,
    Attachment,
    PublisherToken,
    Session,
    check_endpoints,
    open_client,
    px4_publishers_key_expr,
    while_open,
)
from nedbus_msgs import Address, decode_with

from .options import Px4ZenohOptions
from .px4_absences import Absences
from .px4_definitions import read_definitions
from .px4_node import Px4ZenohNode
from .px4_streams import NotAcceptedError, NotCarriedError, Stream, StreamRegistry, track_sequence
from .source import Absence, Rejection, SourceContext, SourceMessage

_log = logging.getLogger(__name__)

_MAX_PENDING: Final = 4096  # samples that wait to be decoded
_CHANNEL: Final = 16_384  # samples that arrive until a thread of ours takes them
_MAX_PENDING_TOKENS: Final = 65536  # of publishers that come and go; none of these may be left out
_JOIN: Final = 3.0  # s
_TICK: Final = 0.25  # s
_LOOK: Final = 1.0  # s between two looks at what does not arrive
_CONNECT_TIMEOUT: Final = 0.5  # s; the service ends within 1 s, and tries again until then
_LARGEST_PENDING: Final = 4096  # bytes of a payload that waits
_TOO_FAST: Final = "queue", "messages arrive faster than they are decoded"
_TOO_LARGE: Final = "size", f"a payload of more than {_LARGEST_PENDING} bytes, or a key that is too long"


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

    def listen(self, router: Session | None) -> Iterator[SourceMessage | Rejection | Absence | None]:
        """Receive; raise SourceError when no router answers."""
        with ExitStack() as closing:
            if router is not None and self._is_own:
                # A link between the router and a client of its own would drop what does not fit its queue.
                session = router
            else:
                session = self._open_session()
                closing.callback(session.close)
            node = Px4ZenohNode(session)
            decoder = _Decoder(StreamRegistry(self._options, vehicle=self._vehicle, given=self._given), node)
            with while_open():
                inbox = _Inbox(self._name, session, domain=self._options.domain)
            closing.callback(inbox.close)
            closing.callback(node.close)
            yield None
            last: Absence | None = None
            next_look = 0.0
            while True:  # until this iterator is closed: a session that lost its router connects again by itself
                yield from inbox.overflow()
                sample: zenoh.Sample | None = None
                with suppress(queue.Empty):
                    sample = inbox.pending.get(timeout=_TICK)
                for token in inbox.tokens():  # those that came before the message are here by now
                    decoder.follow(token)
                yield None if sample is None else decoder.decode(sample)
                if (now := time.monotonic()) >= next_look:
                    next_look = now + _LOOK
                    if (absence := decoder.absences.report(now)) != last:
                        yield (last := absence)

    @property
    def _name(self) -> str:
        return f"px4-zenoh:{' or '.join(self._endpoints)}"

    def _open_session(self) -> Session:
        try:
            return open_client(self._endpoints, timeout=_CONNECT_TIMEOUT, tls=self._tls)
        except ConnectError as exc:
            reason = "no Zenoh router answers there: start one, or name another as px4-zenoh:tcp/HOST:7447"
            raise SourceError(self._name, reason) from exc


class _Inbox:
    """The messages that arrived and wait to be decoded, in order, and the tokens of those who publish them.

    Zenoh puts it into channels in Rust, which threads of ours empty: a callback would wait for the interpreter's lock.
    """

    def __init__(self, name: str, session: Session, *, domain: int | None) -> None:
        self.pending: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        self._name = name
        self._dropped = Counter({_TOO_FAST: 0, _TOO_LARGE: 0})
        self._reported = Counter[tuple[str, str]]()
        publishers = px4_publishers_key_expr(domain)
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_MAX_PENDING_TOKENS)
        tokens = session.liveliness().declare_subscriber(publishers, ring, history=True)
        key_expr = f"{'*' if domain is None else domain}/**/{PX4_TYPES}/*"
        messages = session.declare_subscriber(key_expr, zenoh.handlers.RingChannel(_CHANNEL))
        self._subscribers = tokens, messages
        self._tokens: zenoh.Handler[zenoh.Sample] = tokens.handler
        self._thread = threading.Thread(target=self._receive, args=[messages.handler], name="nedbus-px4", daemon=True)
        self._thread.start()

    def tokens(self) -> Iterator[zenoh.Sample]:
        """Yield the liveliness tokens that changed; raise SourceError if some were dropped."""
        with while_open():
            for _ in range(_MAX_PENDING_TOKENS):
                token = self._tokens.try_recv()
                if token is None:
                    return
                yield token
        raise SourceError(self._name, "publishers come and go faster than they can be followed")

    def overflow(self) -> Iterator[Rejection]:
        """Yield how many messages were dropped since the last call."""
        new = self._dropped - self._reported
        for (where, reason), count in new.items():
            yield Rejection(where, reason, count=count)
        self._reported += new

    def close(self) -> None:
        """Receive no more."""
        for subscriber in self._subscribers:
            with suppress(zenoh.ZError):  # its session may be closed already
                subscriber.undeclare()
        self._thread.join(_JOIN)

    def _receive(self, handler: zenoh.Handler[zenoh.Sample]) -> None:
        with suppress(zenoh.ZError):  # undeclared
            while True:
                self._put(handler.recv())

    def _put(self, sample: zenoh.Sample) -> None:
        if self.pending.qsize() >= _MAX_PENDING:
            self._dropped[_TOO_FAST] += 1
        elif len(sample.payload) > _LARGEST_PENDING or len(str(sample.key_expr)) > LONGEST_TOKEN:
            self._dropped[_TOO_LARGE] += 1
        else:
            self.pending.put(sample)


class _Decoder:
    """Turn samples into messages and rejections, and log what vehicles do."""

    def __init__(self, streams: StreamRegistry, node: Px4ZenohNode) -> None:
        self.absences = Absences()
        self._streams = streams
        self._node = node
        self._bridged: set[str] = set()  # keys on which messages of `nedbus ros2` arrived

    def decode(self, sample: zenoh.Sample) -> SourceMessage | Rejection | None:
        key = str(sample.key_expr)
        now = time.monotonic()
        if sample.kind != zenoh.SampleKind.PUT or self.absences.hear(key, now):
            return None
        stream = self._streams.find(key)
        try:
            if stream is None:
                stream = self._streams.register(key)
                self._log_unknown(stream)
            attachment = None if sample.attachment is None else Attachment.parse(sample.attachment.to_bytes())
            if str(sample.encoding) == BRIDGED_ENCODING:
                self._log_bridged(key)
                return None
            self._streams.claim(stream, attachment, now)
            fields = decode_with(stream.definition, sample.payload.to_bytes(), stream.layout)
            for name in stream.unknown:
                del fields[name]
            lost, restarted = track_sequence(stream, attachment, now)
        except NotCarriedError as exc:
            if not str(exc) or str(sample.encoding) == BRIDGED_ENCODING:
                return None
            return Rejection(key, f"{exc}: not asked for by topics= or msg=")
        except (AddressError, DecodeError, NotAcceptedError) as exc:
            reason = exc.reason if isinstance(exc, DecodeError) else str(exc)
            return Rejection(key, reason, stream.address if stream else None)
        rebooted = restarted and self._streams.is_reboot(stream)
        if rebooted:
            extra = about("rebooted", stream.address, source="px4-zenoh")
            _log.warning("%s: its publisher restarted: the vehicle rebooted", key, extra=extra)
        return SourceMessage(0.0, stream.address, fields, lost, rebooted, definition=stream.definition)

    def follow(self, sample: zenoh.Sample) -> None:
        """Note that a publisher appeared, or is gone, by its liveliness token."""
        now = time.monotonic()
        try:
            token = PublisherToken.parse(str(sample.key_expr))
            what: Address | str = self._streams.address_of(token.key)
        except (AddressError, DecodeError):
            return  # what it publishes is rejected
        except NotCarriedError as exc:
            what = str(exc)
        if sample.kind == zenoh.SampleKind.PUT:
            if not token.node.startswith("nedbus_"):  # a bridge of several vehicles
                self.absences.announce(token, what, now)
            self._streams.add_publisher(token, now)
            self._node.subscribe(token)
        else:
            self.absences.withdraw(token)
            self._streams.remove_publisher(token, now)
            self._node.unsubscribe(token)

    def _log_unknown(self, stream: Stream) -> None:
        if stream.unknown:
            extra = about("newer-layout", stream.address, source="px4-zenoh")
            _log.warning("%s: unknown here, and left out: %s", stream.key, ", ".join(stream.unknown), extra=extra)

    def _log_bridged(self, key: str) -> None:
        if key not in self._bridged:
            self._bridged.add(key)
            extra = about("looped", source="px4-zenoh")
            _log.info("%s comes from nedbus ros2: ignored, as it would loop", key, extra=extra)
