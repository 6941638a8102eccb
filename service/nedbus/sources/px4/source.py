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
from nedbus.errors import AddressError, ConfigError, ConnectError, DecodeError, SourceError
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

from .streams import Definitions, NotAcceptedError, StreamRegistry

_log = logging.getLogger(__name__)

_CONNECT_TIMEOUT: Final = 0.5  # s; short, because the service must stop within 1 s, and it retries
_REPORT_INTERVAL: Final = 1.0  # s between reports of unavailable topics
_RING_SIZE: Final = 16_384  # samples waiting for the receiving thread
_JOIN_TIMEOUT: Final = 3.0  # s
_INPUT: Final = "px4-zenoh-input"  # `sample.source` of messages to a vehicle
_TOO_FAST: Final = "queue", "messages arrive faster than they are decoded"
_TOO_LARGE: Final = (
    "size",
    f"a payload of more than {limits.PX4_PAYLOAD} bytes, or a key that is too long",
)


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
        self._options, self._tls = options, tls
        self._supplied, self._vehicle = _read_definitions(options.msg), options.vehicle or vehicle

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
        self._zid, self._node = str(session.info.zid()), f"nedbus_px4_zenoh_{os.getpid()}"
        self._nodes: dict[int, zenoh.LivelinessToken] = {}  # by domain
        self._subscriptions: dict[TopicKey, zenoh.LivelinessToken] = {}
        self._entities = 0
        self._dropped = Counter({_TOO_FAST: 0, _TOO_LARGE: 0})
        self._reported = Counter[tuple[str, str]]()
        key_expr = f"{'*' if domain is None else domain}/**/{transport.PX4_TYPES}/*"
        with transport.translate_zenoh_errors():
            self._subscriber = session.declare_subscriber(
                key_expr, zenoh.handlers.RingChannel(_RING_SIZE)
            )
        handler = self._subscriber.handler
        self._thread = threading.Thread(
            target=self._receive, args=[handler], name="nedbus-px4", daemon=True
        )
        self._thread.start()

    def run(self) -> Iterator[SourceMessage | Rejection | UnavailableTopics | None]:
        """Yield events until the iterator is closed; raise SourceError if the receiving thread has ended."""
        yield None
        last: UnavailableTopics | None = None
        next_report = 0.0
        while True:
            new = self._dropped - self._reported
            for (where, reason), count in new.items():
                yield Rejection(where, reason, count=count)
            self._reported += new
            sample: zenoh.Sample | BaseException | None = None
            with suppress(queue.Empty):
                sample = self._pending.get(timeout=TIMINGS.source_tick)
            if isinstance(sample, BaseException):
                raise sample
            # tokens are declared before the sample is sent
            for token, alive in self._tokens.poll():
                self._on_token(token, alive=alive)
            yield None if sample is None else self._decode(sample)
            if (now := time.monotonic()) >= next_report:
                next_report = now + _REPORT_INTERVAL
                if (unavailable := self._streams.report(now)) != last:
                    yield (last := unavailable)

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
        key, now = str(sample.key_expr), time.monotonic()
        is_bridged = str(sample.encoding) == transport.BRIDGED_ENCODING
        address: Address | None = None
        try:
            stream = self._streams.on_message(key, now)
            if stream.unsupported is not None:
                # announced streams are in the report
                is_unannounced = stream.unsupported and not stream.tokens
                reason = f"{stream.unsupported} is not selected by topics= or msg="
                return Rejection(key, reason) if is_unannounced and not is_bridged else None
            if (form := stream.wire_format) is None:
                form = self._streams.wire_format_of(stream)
                if form.unknown:
                    names = ", ".join(form.unknown)
                    extra = about("newer_layout", stream.address, source="px4-zenoh")
                    _log.warning(
                        "%s: left out unknown fields %s; update nedbus",
                        stream.key,
                        names,
                        extra=extra,
                    )
                if form.is_literal:
                    text = "%s: hashed with a literal char, unlike in ROS 2"
                    extra = about("notice", stream.address)
                    _log.warning(text, stream.key, extra=extra)
            definition, layout, unknown, _ = form
            address = stream.address
            attachment = (
                None
                if sample.attachment is None
                else transport.Attachment.parse(sample.attachment.to_bytes())
            )
            if is_bridged:
                if not stream.is_bridged:
                    extra = about("bridge_loop", source="px4-zenoh")
                    _log.info(
                        "%s is published by nedbus ros2; ignored to avoid a loop", key, extra=extra
                    )
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
            _log.warning(
                "%s: the publisher restarted; counted as a reboot of the vehicle", key, extra=extra
            )
        source = _INPUT if stream.is_input else None
        return SourceMessage(
            0.0, stream.address, fields, lost, rebooted, definition=definition, source=source
        )

    def _on_token(self, text: str, *, alive: bool) -> None:
        now = time.monotonic()
        try:
            token = transport.PublisherToken.parse(text)
            if alive:
                self._streams.add_publisher(token, now)
        except (AddressError, DecodeError, NotAcceptedError):
            return  # messages on its key are rejected
        if alive and not token.node.startswith("nedbus_"):
            key = token.key
            if key in self._subscriptions or len(self._subscriptions) >= limits.PX4_SUBSCRIPTIONS:
                return
            if key.domain not in self._nodes:
                self._nodes[key.domain] = self._declare(
                    transport.node_token(key.domain, self._zid, self._node)
                )
            self._entities += 1
            self._subscriptions[key] = self._declare(
                key.token("MS", self._zid, self._node, self._entities)
            )
        elif (
            not alive
            and self._streams.remove_publisher(token, now)
            and token.key in self._subscriptions
        ):
            with suppress(zenoh.ZError):  # the session may be closed already
                self._subscriptions.pop(token.key).undeclare()
                if all(key.domain != token.key.domain for key in self._subscriptions):
                    self._nodes.pop(token.key.domain).undeclare()

    def _declare(self, text: str) -> zenoh.LivelinessToken:
        with transport.translate_zenoh_errors():
            return self._session.liveliness().declare_token(text)

    def _receive(self, handler: zenoh.Handler[zenoh.Sample]) -> None:
        try:
            while True:
                sample = handler.recv()
                if self._pending.qsize() >= limits.PX4_PENDING:
                    self._dropped[_TOO_FAST] += 1
                elif (
                    len(sample.payload) > limits.PX4_PAYLOAD
                    or len(str(sample.key_expr)) > transport.LONGEST_TOKEN
                ):
                    self._dropped[_TOO_LARGE] += 1
                else:
                    self._pending.put(sample)
        except BaseException as exc:  # noqa: BLE001 - re-raised by `run`, on the thread of the source
            # the subscriber is undeclared
            ended = SourceError("px4-zenoh", "receiving has stopped unexpectedly")
            self._pending.put(ended if isinstance(exc, zenoh.ZError) else exc)


def _read_definitions(paths: str) -> Definitions:
    """Read a comma-separated list of .msg files, and folders of them such as PX4's `msg`.

    Unsupported messages in a folder are skipped and logged.

    Raises ConfigError for an unreadable file, or with line and column for an invalid one.
    """
    found: dict[str, dict[tuple[str, str], Definition[Any]]] = {}
    skipped: list[str] = []
    for path in (Path(text.strip()).expanduser() for text in paths.split(",") if text.strip()):
        files = sorted([*path.glob("*.msg"), *path.glob("*/*.msg")])
        if not files and path.is_dir():
            reason = "no .msg file in this folder or its subfolders; use PX4's msg folder"
            raise ConfigError(str(path), reason, key="msg")
        for file in files or [path]:
            try:
                text = _with_nested_messages(file)
                definition = define_msg(file.stem, text)
                hashes = (
                    hash_of_msg(file.stem, text),
                    hash_of_msg(file.stem, text, literal_char=True),
                )
            except OSError as exc:
                raise ConfigError(
                    str(file), (exc.strerror or str(exc)).lower(), key="msg"
                ) from None
            except ValueError as exc:  # such as MsgError
                if file == path:
                    raise ConfigError(str(file), str(exc), key="msg") from None
                skipped.append(f"{file.stem} ({exc})")
                continue
            found.setdefault(dds_type(ros2_type(definition)), {})[hashes] = definition
    if skipped:
        extra = about("damaged", source="px4-zenoh")
        _log.info(
            "px4-zenoh: skipped unsupported definitions in %s: %.2000s",
            paths,
            ", ".join(skipped),
            extra=extra,
        )
    return found


def _with_nested_messages(file: Path) -> str:
    """Return a .msg file followed by its nested messages from the same folder, in ROS 2's format."""
    text = new = _read_text(file)
    added = set[str]()
    while missing := {
        base for base in bases_of_msg(new) - added if file.with_name(f"{base}.msg").is_file()
    }:
        added |= missing
        files = {base: _read_text(file.with_name(f"{base}.msg")) for base in sorted(missing)}
        new = "".join(f"\n{'=' * 80}\nMSG: px4_msgs/{base}\n{each}" for base, each in files.items())
        text += new
    return text


def _read_text(file: Path) -> str:
    """Read a text file in UTF-8, with or without a byte order mark, or else in Latin-1."""
    content = file.read_bytes()
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")
