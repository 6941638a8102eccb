"""Receive from PX4's Zenoh module, or any other publisher of px4_msgs over rmw_zenoh, as a ROS 2 node."""

import logging
import os
import queue
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Final

import zenoh

from nedbus import limits, transport
from nedbus.endpoints import check_endpoints
from nedbus.errors import (
    AddressError,
    ConfigError,
    ConnectError,
    DecodeError,
    SourceError,
    system_reason,
)
from nedbus.log_event import about
from nedbus.sources.options import Px4ZenohOptions
from nedbus.sources.source import Rejection, SourceMessage, UnavailableTopics
from nedbus.timings import TIMINGS
from nedbus.transport import Session, Tls, TopicKey
from nedbus_msgs import (
    Address,
    Definition,
    bases_of_msg,
    dds_type,
    decode_with,
    define_msg,
    hash_of_msg,
    ros2_type,
)

from .streams import (
    Definitions,
    NotAcceptedError,
    Px4Stream,
    StreamRegistry,
    TypeHashes,
    WireFormat,
)

_log = logging.getLogger(__name__)

_CONNECT_TIMEOUT: Final = 0.5  # s; short, because the service must stop within 1 s, and it retries
_REPORT_INTERVAL: Final = 1.0  # s between reports of unavailable topics
_RING_SIZE: Final = 16_384  # samples waiting for the receiving thread
_JOIN_TIMEOUT: Final = 3.0  # s
_INPUT: Final = "px4-zenoh-input"  # `sample.source` of messages to a vehicle
_DROP_REASONS: Final = {
    "queue": "messages arrive faster than they are decoded",
    "size": f"a payload of more than {limits.PX4_PAYLOAD} bytes, or a key that is too long",
}


class Px4ZenohSource:
    """All publishers of px4_msgs on the router at `endpoint`, by default the service's own router at `routers`."""

    def __init__(
        self,
        endpoint: str,
        options: Px4ZenohOptions,
        vehicle: str,
        routers: tuple[str, ...],
        tls: Tls | None,
        *_: str,
    ) -> None:
        if endpoint:
            check_endpoints([endpoint], where="px4-zenoh")
        self._endpoints = (endpoint,) if endpoint else routers
        self._is_own = not endpoint or endpoint in routers
        self._options = options
        self._tls = tls
        self._supplied = _read_definitions(options.msg)
        self._vehicle = options.vehicle or vehicle

    def listen(
        self, router: Session | None
    ) -> Iterator[SourceMessage | Rejection | UnavailableTopics | None]:
        """Receive; raise SourceError if no router answers."""
        with ExitStack() as closing:
            if router is not None and self._is_own:
                # A separate client would lose messages whenever the queue of its link is full.
                session = router
            else:
                try:
                    session = transport.open_client(
                        self._endpoints, timeout=_CONNECT_TIMEOUT, tls=self._tls
                    )
                except ConnectError as exc:
                    reason = "no Zenoh router answers; start one, or set another one with px4-zenoh:tcp/HOST:7447"
                    raise SourceError(f"px4-zenoh:{' or '.join(self._endpoints)}", reason) from exc
                closing.callback(session.close)
            streams = StreamRegistry(self._options, vehicle=self._vehicle, supplied=self._supplied)
            node = Px4ZenohNode(session, streams, domain=self._options.domain)
            closing.callback(node.close)
            yield from node.run()  # the session reconnects automatically


class Px4ZenohNode:
    """Receive from all publishers as a ROS 2 node, and convert samples to messages or rejections, until closed.

    Samples are queued in a Rust channel, which a dedicated thread drains: a callback would make Zenoh wait for the
    GIL. Liveliness tokens announce the node and its subscriptions to ROS 2.
    """

    def __init__(self, session: Session, streams: StreamRegistry, *, domain: int | None) -> None:
        self._session, self._streams = session, streams
        self._pending: queue.SimpleQueue[zenoh.Sample | BaseException] = queue.SimpleQueue()
        self._tokens = transport.LivelinessTokens(
            session, transport.px4_publishers_key_expr(domain)
        )
        self._zid = str(session.info.zid())
        self._node = f"nedbus_px4_zenoh_{os.getpid()}"
        self._nodes: dict[int, zenoh.LivelinessToken] = {}  # by domain
        self._subscriptions: dict[TopicKey, zenoh.LivelinessToken] = {}
        self._entities = 0
        self._dropped = Counter(dict.fromkeys(_DROP_REASONS, 0))
        self._reported = Counter[str]()
        chunk = "*" if domain is None else domain
        key_expr = f"{chunk}/**/{transport.PX4_TYPES}/*"
        with transport.translate_zenoh_errors():
            self._subscriber = session.declare_subscriber(
                key_expr, zenoh.handlers.RingChannel(_RING_SIZE)
            )
        arguments = [self._subscriber.handler]  # no reference to the subscriber on that thread
        self._thread = threading.Thread(
            target=self._receive, args=arguments, name="nedbus-px4", daemon=True
        )
        self._thread.start()

    def run(self) -> Iterator[SourceMessage | Rejection | UnavailableTopics | None]:
        """Yield events until the iterator is closed; raise SourceError if the receiving thread has ended."""
        yield None
        last: UnavailableTopics | None = None
        next_report = 0.0
        while True:
            dropped = self._dropped - self._reported
            self._reported += dropped
            for where, count in dropped.items():
                yield Rejection(where, _DROP_REASONS[where], count=count)
            sample: zenoh.Sample | BaseException | None = None
            with suppress(queue.Empty):
                sample = self._pending.get(timeout=TIMINGS.source_tick)
            if isinstance(sample, BaseException):
                raise sample
            # tokens are declared before the sample is sent
            for token, alive in self._tokens.poll():
                self._on_token(token, alive=alive)
            yield None if sample is None else self._decode(sample)
            now = time.monotonic()
            if now >= next_report:
                next_report = now + _REPORT_INTERVAL
                unavailable = self._streams.report(now)
                if unavailable != last:
                    last = unavailable
                    yield unavailable

    def close(self) -> None:
        """Undeclare the tokens and the subscriber, and end the thread."""
        with suppress(zenoh.ZError):  # the session may be closed already
            for token in (*self._subscriptions.values(), *self._nodes.values()):
                token.undeclare()
            self._tokens.undeclare()
            self._subscriber.undeclare()
        self._thread.join(_JOIN_TIMEOUT)

    def _decode(self, sample: zenoh.Sample) -> SourceMessage | Rejection | None:
        if sample.kind != zenoh.SampleKind.PUT:
            return None
        key = str(sample.key_expr)
        now = time.monotonic()
        address: Address | None = None
        try:
            stream = self._streams.on_message(key, now)
            is_bridged = str(sample.encoding) == transport.BRIDGED_ENCODING
            if stream.unsupported is not None:
                is_reported = is_bridged or stream.tokens  # announced streams are in the report
                return None if is_reported else _unsupported(stream)
            form = stream.wire_format or self._begin(stream)
            address = stream.address
            attachment = None
            if sample.attachment is not None:
                attachment = transport.Attachment.parse(sample.attachment.to_bytes())
            if is_bridged:
                _ignore_bridge(stream)
                return None
            fields = decode_with(form.definition, sample.payload.to_bytes(), form.layout)
            lost, rebooted = self._streams.accept(stream, attachment, now)
        except DecodeError as exc:
            return Rejection(key, exc.reason, address)
        except (AddressError, NotAcceptedError) as exc:
            return Rejection(key, str(exc), address)
        for name in form.unknown:
            del fields[name]
        if rebooted:
            extra = about("rebooted", address, source="px4-zenoh")
            text = "%s: the publisher restarted; counted as a reboot of the vehicle"
            _log.warning(text, key, extra=extra)
        source = _INPUT if stream.is_input else None
        return SourceMessage(
            0.0, address, fields, lost, rebooted, definition=form.definition, source=source
        )

    def _begin(self, stream: Px4Stream) -> WireFormat:
        """Return the format of a stream at its first message, and log what is unusual in it."""
        form = self._streams.wire_format_of(stream)
        if form.unknown:
            names = ", ".join(form.unknown)
            extra = about("newer_layout", stream.address, source="px4-zenoh")
            text = "%s: left out unknown fields %s; update nedbus"
            _log.warning(text, stream.key, names, extra=extra)
        if form.is_literal:
            extra = about("notice", stream.address)
            text = "%s: hashed with a literal char, unlike in ROS 2"
            _log.warning(text, stream.key, extra=extra)
        return form

    def _on_token(self, text: str, *, alive: bool) -> None:
        now = time.monotonic()
        try:
            token = transport.PublisherToken.parse(text)
            if alive:
                self._streams.add_publisher(token, now)
        except (AddressError, DecodeError, NotAcceptedError):
            return  # messages on its key are rejected
        if alive:
            if not token.node.startswith("nedbus_"):
                self._announce(token.key)
        elif self._streams.remove_publisher(token, now):
            self._withdraw(token.key)

    def _announce(self, key: TopicKey) -> None:
        """Declare to ROS 2 that this node subscribes to a key."""
        if key in self._subscriptions or len(self._subscriptions) >= limits.PX4_SUBSCRIPTIONS:
            return
        if key.domain not in self._nodes:
            node = transport.node_token(key.domain, self._zid, self._node)
            self._nodes[key.domain] = self._declare(node)
        self._entities += 1
        subscription = key.token("MS", self._zid, self._node, self._entities)
        self._subscriptions[key] = self._declare(subscription)

    def _withdraw(self, key: TopicKey) -> None:
        """Undeclare the subscription to a key, and the node after the last one of its domain."""
        if key not in self._subscriptions:
            return
        with suppress(zenoh.ZError):  # the session may be closed already
            self._subscriptions.pop(key).undeclare()
            if all(other.domain != key.domain for other in self._subscriptions):
                self._nodes.pop(key.domain).undeclare()

    def _declare(self, text: str) -> zenoh.LivelinessToken:
        with transport.translate_zenoh_errors():
            return self._session.liveliness().declare_token(text)

    def _receive(self, handler: zenoh.Handler[zenoh.Sample]) -> None:
        try:
            while True:
                sample = handler.recv()
                if self._pending.qsize() >= limits.PX4_PENDING:
                    self._dropped["queue"] += 1
                elif _is_too_large(sample):
                    self._dropped["size"] += 1
                else:
                    self._pending.put(sample)
        except BaseException as exc:  # noqa: BLE001 - re-raised by `run`, on the thread of the source
            # the subscriber is undeclared
            ended = SourceError("px4-zenoh", "receiving has stopped unexpectedly")
            self._pending.put(ended if isinstance(exc, zenoh.ZError) else exc)


def _is_too_large(sample: zenoh.Sample) -> bool:
    if len(sample.payload) > limits.PX4_PAYLOAD:
        return True
    return len(str(sample.key_expr)) > transport.LONGEST_TOKEN


def _unsupported(stream: Px4Stream) -> Rejection | None:
    """Return the rejection of a message without a definition, or None if it was not asked for."""
    if not stream.unsupported:
        return None
    return Rejection(str(stream.key), f"{stream.unsupported} is not selected by topics= or msg=")


def _ignore_bridge(stream: Px4Stream) -> None:
    """Log once that `nedbus ros2` publishes on a key."""
    if not stream.is_bridged:
        stream.is_bridged = True
        text = "%s is published by nedbus ros2; ignored to avoid a loop"
        _log.info(text, stream.key, extra=about("bridge_loop", source="px4-zenoh"))


def _read_definitions(paths: str) -> Definitions:
    """Read a comma-separated list of .msg files, and folders of them such as PX4's `msg`.

    Unsupported messages in a folder are skipped and logged.

    Raises ConfigError for an unreadable file, or with line and column for an invalid one.
    """
    definitions: dict[str, dict[TypeHashes, Definition[Any]]] = {}
    skipped: list[str] = []
    for part in paths.split(","):
        if not part.strip():
            continue
        path = Path(part.strip()).expanduser()
        files = sorted([*path.glob("*.msg"), *path.glob("*/*.msg")])
        if not files and path.is_dir():
            reason = "no .msg file in this folder or its subfolders; use PX4's msg folder"
            raise ConfigError(str(path), reason, key="msg")
        for file in files or [path]:
            try:
                definition, hashes = _define(file)
            except OSError as exc:
                reason = system_reason(exc)
                raise ConfigError(str(file), reason, key="msg") from None
            except ValueError as exc:  # such as MsgError
                if file == path:
                    raise ConfigError(str(file), str(exc), key="msg") from None
                skipped.append(f"{file.stem} ({exc})")
                continue
            definitions.setdefault(dds_type(ros2_type(definition)), {})[hashes] = definition
    if skipped:
        text = "px4-zenoh: skipped unsupported definitions in %s: %.2000s"
        extra = about("damaged", source="px4-zenoh")
        _log.info(text, paths, ", ".join(skipped), extra=extra)
    return definitions


def _define(file: Path) -> tuple[Definition[Any], TypeHashes]:
    text = _with_nested_messages(file)
    definition = define_msg(file.stem, text)
    usual = hash_of_msg(file.stem, text)
    return definition, TypeHashes(usual, hash_of_msg(file.stem, text, literal_char=True))


def _with_nested_messages(file: Path) -> str:
    """Return a .msg file followed by its nested messages from the same folder, in ROS 2's format."""
    text = _read_text(file)
    names = set[str]()
    missing = bases_of_msg(text)
    while missing:
        names |= missing
        added = ""
        for name in sorted(missing):
            nested = file.with_name(f"{name}.msg")
            if nested.is_file():
                added += f"\n{'=' * 80}\nMSG: px4_msgs/{name}\n{_read_text(nested)}"
        text += added
        missing = bases_of_msg(added) - names
    return text


def _read_text(file: Path) -> str:
    """Read a text file in UTF-8, with or without a byte order mark, or else in Latin-1."""
    content = file.read_bytes()
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")
