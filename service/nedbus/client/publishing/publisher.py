"""A publisher of one address: validate, encode, put."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Self, cast

import zenoh

from nedbus.errors import NedbusError
from nedbus.transport import require_unforked, translate_error, while_open
from nedbus_msgs import Address, Definition, Message, Provenance, codec_of, encoding_of, get_topic

from .downsampler import Downsampler, MatchingListener
from .flow_control import CACHE, FlowControl
from .writer import Writer, priority_of

if TYPE_CHECKING:
    from nedbus_msgs.arrays import MessageArray

    from .publisher_registry import PublisherRegistry

FLUSH_TIMEOUT: Final = 600.0  # s that readers have to receive the messages sent to them


class Publisher:
    """Publish the messages of one address; get one from `bus.publisher(...)`.

    Messages are kept for about 20 s for readers that missed some, and the last one for readers that ask.
    `publish` never waits for a slow reader, unless the publisher is lossless: it then waits while a reader of mode
    "every" has more than 2,000 messages to read, but sends 10 a second to all others.
    Usable from one thread at a time; as a context manager it closes itself.
    """

    def __init__(
        self,
        address: Address,
        definition: Definition[Any],
        *,
        registry: PublisherRegistry,
        matched: MatchingListener,
        lossless: bool,
        source: str | None,
        owner: object,
    ) -> None:
        prefix, heartbeats = registry.prefix, registry.heartbeats
        self.address = address
        self.key = address.key(prefix=prefix)
        self.source = Provenance(source).source
        self.lossless = lossless
        self.last: tuple[bytes, zenoh.Timestamp, str] | None = None
        self._new_timestamp = heartbeats.session.new_timestamp
        self._on_close = partial(registry.forget, address)
        self._owner = owner  # keeps the bus open as long as a script may publish
        self.definition = definition
        self._codec = codec_of(definition)
        self._all = definition.all_fields
        self._encoding = encoding_of(definition, source)
        self._partial: tuple[Set[str], str] = self._all, self._encoding  # the fields of messages, and their encoding
        topic = get_topic(address.topic)
        with while_open():
            self._token = heartbeats.session.liveliness().declare_token(address.alive_key(prefix=prefix))
        cache = CACHE if lossless else topic.kept
        self._writer = Writer(heartbeats, self.key, priority=priority_of(topic), cache=cache, encoding=self._encoding)
        self._flow_control = FlowControl(self._writer, registry.window, needs_router=registry.is_client)
        self._downsampler = Downsampler(heartbeats, address, prefix=prefix, vehicle=matched)

    @property
    def published(self) -> int:
        """Messages published so far."""
        return self._writer.published

    def publish(self, message: Message | Mapping[str, object]) -> None:
        """Validate a message, or the fields of one by name, and publish it.

        A message that exists was validated when it was made; it is not validated again.
        Readers see which fields it was made without: `sample.missing`.

        Raises InvalidMessageError for invalid fields, EncodeError for a message whose validation was bypassed,
        ClosedError once the publisher or its bus is closed.
        """
        if isinstance(message, Message):
            if not isinstance(message, self.definition.model):
                raise TypeError(f"{self.address} carries {self.definition.name}, not {type(message).__name__}")
            self._put(self._codec.encode(message), message.__pydantic_fields_set__)
        else:
            try:
                payload = self._codec.encode_fields(message)
            except (TypeError, ValueError):
                if isinstance(message, Mapping):
                    raise
                reason = f"expected a {self.definition.name}, or a dict of its fields, not {type(message).__name__}"
                raise TypeError(reason) from None
            self._put(payload, message.keys())

    def publish_row(self, values: Sequence[object] | Message) -> None:
        """Validate the values of all fields in PX4's order, `delta_xy` and `delta_vxy` as tuples, and publish them.

        The same as `publish` with these fields, and faster: no message is made of them.
        """
        self._put(self._codec.encode_row(cast("Sequence[object]", values)), self._all)

    def publish_many(self, messages: MessageArray) -> None:
        """Validate all messages in a structured array of shape (n,) and dtype DTYPE, then publish them in order.

        None is published if one is invalid. Where the bus is closed meanwhile, `published` is their number.

        Raises TypeError for another dtype, InvalidMessageError for the first message that is invalid, with its `index`,
        ClosedError once the publisher or its bus is closed.
        """
        from nedbus_msgs.arrays import arrays_of

        arrays, size = arrays_of(self.definition), self._codec.size
        if getattr(messages, "dtype", None) != arrays.dtype:
            hint = "nedbus.to_array makes it of messages, and astype of an array with its fields"
            raise TypeError(f"{self.address} needs an array with the dtype of {self.definition.name}: {hint}")
        arrays.require_valid(messages)
        payloads = arrays.encode(messages)
        for start in range(0, len(payloads), size):
            self._put(payloads[start : start + size], self._all)

    def flush(self, timeout: float = FLUSH_TIMEOUT) -> bool:
        """Wait until all readers of mode "every" have all messages; return False if one has not in time.

        Messages in transit to a slow reader when a publisher's process ends are lost, and not counted anywhere.
        A reader that was disconnected learns the number of missed messages, and recovers those still kept.

        Raises ClosedError once the bus is closed.
        """
        return self._flow_control.wait(self.published, timeout=timeout)

    def close(self) -> None:
        """Stop publishing this address: it is no longer listed, and free for another publisher.

        A lossless publisher flushes before.
        """
        if self._writer.closed:
            return
        if self.lossless:
            with suppress(NedbusError):
                self.flush()
        self._writer.close()
        self._on_close()
        self._downsampler.close()
        with suppress(zenoh.ZError):  # closed already with the session
            self._token.undeclare()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _put(self, payload: bytes, provided: Set[str]) -> None:
        """Put the payload of a message that was made with these fields."""
        require_unforked()
        encoding, is_whole = self._encoding, len(provided) == len(self._all)
        if not is_whole:
            if provided != self._partial[0]:  # almost always the same fields are missing
                self._partial = frozenset(provided), encoding_of(self.definition, self.source, frozenset(provided))
            encoding = self._partial[1]
        try:
            stamp = self._new_timestamp()
            self._writer.put(payload, stamp, None if is_whole else encoding)
            self.last = payload, stamp, encoding
            self._downsampler.put(payload, stamp, encoding)
        except zenoh.ZError as exc:
            raise translate_error(exc) from exc
        if self.lossless:
            self._flow_control.wait_for_credit(self.published)
