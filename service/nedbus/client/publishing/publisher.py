"""The publisher of one address: validate, encode, put."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence, Set
from contextlib import AbstractContextManager, suppress
from typing import TYPE_CHECKING, Any, Final, cast

import zenoh

from nedbus import limits
from nedbus.errors import NedbusError
from nedbus.transport import require_unforked, translate_error, translate_zenoh_errors
from nedbus_msgs import Address, Definition, Message, Provenance, codec_of, encoding_of, get_topic

from .downsampler import Downsampler, MatchingListener
from .flow_control import CACHE, FlowControl
from .group import Group, Outgoing
from .writer import Writer

if TYPE_CHECKING:
    from nedbus_msgs.arrays import MessageArray

    from .publisher_registry import PublisherRegistry

FLUSH_TIMEOUT: Final = 600.0  # s for readers to receive all published messages


class Publisher(AbstractContextManager["Publisher"]):
    """Publisher of the messages of one address; get one from `bus.publisher(...)`.

    A history cache keeps messages for readers that missed some: 20 s at the topic's nominal rate, at least 400
    messages. The last message answers queries.
    `publish` does not wait for readers: Zenoh drops what a link does not accept within 1 ms. A lossless publisher slows
    down to 10 messages per second while a reader in mode "every" has more than 2,000 unread messages.
    Not thread-safe. A context manager.
    """

    def __init__(
        self,
        address: Address,
        definition: Definition[Any],
        *,
        registry: PublisherRegistry,
        listener: MatchingListener,
        lossless: bool,
        short_history: bool,
        source: str | None,
        owner: object,
    ) -> None:
        prefix, heartbeats = registry.prefix, registry.heartbeats
        self.address = address
        self.key = address.key(prefix=prefix)
        self.source = Provenance(source).source
        self.lossless = lossless
        self.last: Outgoing | None = None
        self._new_timestamp = heartbeats.session.new_timestamp
        self._registry, self._owner = registry, owner  # the owner keeps the bus open
        self.definition = definition
        self._codec, self._all = codec_of(definition), definition.all_fields
        # Objects, not texts: Zenoh would copy a text into each message of the history cache, and objects are shared.
        self._encoding = zenoh.Encoding(encoding_of(definition, source))
        # Of the last message with missing fields.
        self._partial: tuple[Set[str], zenoh.Encoding] = self._all, self._encoding
        topic = get_topic(address.topic)
        cache = topic.kept_for_source(self._codec.size) if short_history else topic.kept
        if lossless:
            cache = CACHE
        self._writer = Writer(heartbeats, self.key, topic, cache=cache, encoding=self._encoding)
        # Not beside a router in this process: its session hands messages over without waking a thread.
        groups = lossless and registry.is_client
        self._group = Group(self._writer, self._put, heartbeats) if groups else None
        self._listener: MatchingListener | None = None
        try:
            if lossless and not registry.is_client:
                self._listener = MatchingListener(heartbeats.session, self.key)
            self._flow_control = FlowControl(
                self._writer,
                registry.window,
                needs_router=registry.is_client,
                listener=self._listener,
            )
            self._downsampler = Downsampler(heartbeats, address, prefix=prefix, listener=listener)
            # last: readers may use all of the above once they see the token
            with translate_zenoh_errors():
                token = address.alive_key(str(heartbeats.session.zid()), prefix=prefix)
                self._token = heartbeats.session.liveliness().declare_token(token)
        except BaseException:
            self._writer.close()
            if self._listener is not None:
                self._listener.close()
            raise

    @property
    def published(self) -> int:
        """The number of messages published."""
        return self._writer.published if self._group is None else self._group.published

    @property
    def closed(self) -> bool:
        """True once the publisher or its bus is closed."""
        return self._writer.closed or self._writer.session.is_closed()

    def relabel(self, source: str) -> None:
        """Set the source of all subsequent messages, which readers see in `sample.source`."""
        if source != self.source:
            self.source, self._encoding = (
                source,
                zenoh.Encoding(encoding_of(self.definition, source)),
            )
            self._partial = self._all, self._encoding

    def publish(self, message: Message | Mapping[str, object]) -> None:
        """Publish a message, or validate a dict of fields and publish them as a message.

        A Message was validated when it was created, and is not validated again.
        A dict without `timestamp` gets the time since boot of this host, like PX4's time since boot.
        Fields that were not provided are listed in the readers' `sample.missing`.

        Raises TypeError for another type of message, InvalidMessageError for invalid fields, EncodeError for a message
        that bypassed validation, ClosedError once the publisher or its bus is closed.
        """
        if isinstance(message, self.definition.model):
            self.publish_encoded(self._codec.encode(message), message.__pydantic_fields_set__)
        elif isinstance(message, (dict, Mapping)):  # dict first, which is faster
            if "timestamp" not in message:
                message = {"timestamp": time.monotonic_ns() // 1000, **message}
            self.publish_encoded(self._codec.encode_fields(message), message.keys())
        else:
            name, given = self.definition.name, type(message).__name__
            raise TypeError(
                f"{self.address} carries {name}: publish a {name} or a dict of its fields, not {given}"
            )

    def publish_row(self, values: Sequence[object] | Message) -> None:
        """Validate and publish the values of all fields in PX4's order, with arrays such as `delta_xy` as tuples.

        Equivalent to `publish` with these fields, but faster: no message object is created. Raises the same errors.
        """
        self.publish_encoded(self._codec.encode_row(cast("Sequence[object]", values)), self._all)

    def publish_many(self, messages: MessageArray) -> None:
        """Validate a structured array of shape (n,) and dtype DTYPE, then publish its messages in order.

        Publishes nothing if a message is invalid. If the bus closes meanwhile, `published` counts the messages sent.

        Raises TypeError for another dtype, InvalidMessageError for the first invalid message, with its `index`,
        ClosedError once the publisher or its bus is closed.
        """
        from nedbus_msgs.arrays import arrays_of

        arrays, size = arrays_of(self.definition), self._codec.size
        if getattr(messages, "dtype", None) != arrays.dtype:
            hint = "convert messages with nedbus.to_array, or an array with the same fields with astype"
            raise TypeError(
                f"{self.address} needs an array with the dtype of {self.definition.name}: {hint}"
            )
        arrays.require_valid(messages)
        payloads = arrays.encode(messages)
        encoded = [payloads[start : start + size] for start in range(0, len(payloads), size)]
        if self._group is not None:
            self._group.hand_over()
        sent = 0
        while sent < len(encoded):
            room = (
                self._flow_control.check_at - self._writer.published
                if self.lossless
                else limits.GROUP_MESSAGES
            )
            group = encoded[sent : sent + max(1, min(limits.GROUP_MESSAGES, room))]
            self._put([(payload, self._new_timestamp(), self._encoding) for payload in group])
            self._wait_for_credit()
            sent += len(group)

    def flush(self, timeout: float = FLUSH_TIMEOUT) -> bool:
        """Wait until all readers in mode "every" have received all messages; return False on timeout.

        If the process ends without a flush, messages in transit to a slow reader are lost, but not counted as lost.
        A disconnected reader detects the messages it missed, and recovers those still in the history cache.

        Raises ClosedError once the bus is closed, RefusedError if the access rules of the router drop the messages.
        """
        if self._group is not None:
            self._group.hand_over()
        if self._registry.permission is not None:
            self._registry.permission.require(self.address.vehicle)
        return self._flow_control.wait_for_reception(self._writer.published, timeout=timeout)

    def close(self, timeout: float = FLUSH_TIMEOUT) -> None:
        """Withdraw the address and free it for another publisher. Idempotent.

        A lossless publisher is flushed first, for at most `timeout` seconds, unless a `with` block ends with an
        exception. Ctrl-C ends the wait and closes the publisher.
        """
        if self._writer.closed:
            return
        try:
            if self.lossless and timeout > 0:
                with suppress(NedbusError):
                    self.flush(timeout)
        finally:
            if self._group is not None:
                with suppress(NedbusError):
                    self._group.hand_over()
            self._writer.close()
            self._registry.forget(self.address)
            self._downsampler.close()
            if self._listener is not None:
                self._listener.close()
            with suppress(zenoh.ZError):  # the session is already closed
                self._token.undeclare()

    def __exit__(self, exc: object, *_: object) -> None:
        self.close(FLUSH_TIMEOUT if exc is None else 0.0)

    def publish_encoded(self, payload: bytes, provided: Set[str]) -> None:
        """Publish a payload that a codec has validated and encoded; `provided`: the fields that its source provides."""
        encoding = self._encoding
        if len(provided) != len(self._all):
            known = self._partial[0]
            # rare: usually the same fields are missing
            if provided is not known and provided != known:
                text = encoding_of(self.definition, self.source, frozenset(provided))
                self._partial = frozenset(provided), zenoh.Encoding(text)
            encoding = self._partial[1]
        message = payload, self._new_timestamp(), encoding
        if (group := self._group) is None:
            self._put((message,))
            self._wait_for_credit()
        elif group.add(message):
            group.hand_over()
            self._wait_for_credit()
            group.begin(self._flow_control.check_at - self._writer.published)

    def _put(self, messages: Sequence[Outgoing]) -> None:
        """Put messages in order; the last one answers queries from now on."""
        require_unforked()
        writer, downsampler = self._writer, self._downsampler
        try:
            writer.put(messages)
            self.last = messages[-1]
            listener = downsampler.vehicle_listener
            is_open = downsampler.address_listener is not None
            if is_open or listener.matched or writer.last_put >= listener.next_check:
                for message in messages:
                    downsampler.put(message)
        except zenoh.ZError as exc:
            raise translate_error(exc) from exc

    def _wait_for_credit(self) -> None:
        if self.lossless and self._writer.published >= self._flow_control.check_at:
            self._flow_control.wait_for_credit(self._writer.published)
