"""A publisher of one address: validate, encode, put."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import suppress
from typing import TYPE_CHECKING, Final, Self

import zenoh

from nedbus.errors import ClosedError, NedbusError
from nedbus.transport import Session, entity_name, require_unforked, translate_error, while_open
from nedbus_msgs import (
    FIELD_TYPES,
    PAYLOAD_SIZE,
    Address,
    Provenance,
    Row,
    VehicleLocalPosition,
    encode,
    encode_fields,
    encode_row,
    encoding_of,
)

from .acknowledgement import KEPT, Acknowledgement, SharedWindow
from .demand import Demand
from .qos import TOPIC_QOS
from .thinned_streams import ThinnedStreams

if TYPE_CHECKING:
    from nedbus_msgs.arrays import MessageArray

HEARTBEAT: Final = 0.5  # s: how soon a reader learns that it missed the newest message
FLUSH_TIMEOUT: Final = 600.0  # s that readers have to take what was sent to them
_ALL: Final = frozenset(FIELD_TYPES)


class Publisher:
    """Publish the messages of one address; get one from `bus.publisher(...)`.

    Messages are kept for about 20 s for readers that missed some, and the last one for readers that ask.
    `publish` never waits for a slow reader, unless the publisher is lossless: it then waits while a reader of mode
    "every" has more than 2,000 messages to read, but sends 10 a second to all others.
    Usable from one thread at a time; as a context manager it closes itself.
    """

    def __init__(
        self,
        session: Session,
        address: Address,
        *,
        prefix: str,
        lossless: bool,
        source: str | None,
        thinned_demand: Demand,
        shared_window: SharedWindow,
        needs_router: bool,
        on_close: Callable[[], object],
        owner: object,
    ) -> None:
        self.address = address
        self.key = address.key(prefix=prefix)
        self.published = 0
        self.source = Provenance(source).source
        self.lossless = lossless
        self.last: tuple[bytes, zenoh.Timestamp, str] | None = None
        self._session = session
        self._on_close = on_close
        self._owner = owner  # the bus stays open for as long as somebody may publish
        self._provided: Set[str] = frozenset()
        self._partial_encoding = ""
        self._encoding = encoding_of(source)
        qos = TOPIC_QOS[address.topic]
        misses = zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT, sporadic_heartbeat=None)
        with while_open():
            self._token = session.liveliness().declare_token(address.alive_key(prefix=prefix))
            # A router remembers where to send what comes on a key that it knows as such; of any other it finds out for
            # each message, which is most of what one costs where several routers are joined.
            self._key_token = session.liveliness().declare_token(self.key)
            publisher = zenoh.ext.declare_advanced_publisher(
                session,
                self.key,
                encoding=self._encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=qos.priority,
                cache=zenoh.ext.CacheConfig(KEPT if lossless else qos.cache),
                sample_miss_detection=misses,
            )
        self._publisher: zenoh.ext.AdvancedPublisher | None = publisher
        self._acknowledgement = Acknowledgement(
            session,
            self.key,
            entity_name(publisher.id),
            priority=qos.priority,
            shared=shared_window,
            needs_router=needs_router,
        )
        self._thinned = ThinnedStreams(session, address, prefix=prefix, vehicle=thinned_demand)

    def publish(self, message: VehicleLocalPosition | Mapping[str, object]) -> None:
        """Validate a message, or the fields of one by name, and publish it.

        A message that exists was validated when it was made; it is not validated again.
        Readers see which fields it was made without: `sample.missing`.

        Raises InvalidMessageError for invalid fields, EncodeError for a message whose validation was bypassed,
        ClosedError once the publisher or its bus is closed.
        """
        if isinstance(message, VehicleLocalPosition):
            self._put(encode(message), message.__pydantic_fields_set__)
        else:
            self._put(encode_fields(message), message.keys())

    def publish_row(self, values: Sequence[object] | Row) -> None:
        """Validate the values of all fields in PX4's order, `delta_xy` and `delta_vxy` as tuples, and publish them.

        The same as `publish` with these fields, and faster: no message is made of them.
        """
        self._put(encode_row(values), _ALL)

    def publish_many(self, messages: MessageArray) -> None:
        """Validate messages in a structured array of shape (n,) and dtype DTYPE, and publish them; all or none.

        Raises TypeError for another dtype, InvalidMessageError for the first message that is invalid, with its `index`.
        """
        from nedbus_msgs.arrays import DTYPE, encode_array, require_valid

        if messages.dtype != DTYPE:
            raise TypeError("the array must have the dtype nedbus.DTYPE: convert it with astype")
        require_valid(messages)
        if self._publisher is None:
            raise ClosedError
        require_unforked()
        payloads = encode_array(messages)
        put, new_timestamp = self._publisher.put, self._session.new_timestamp
        lossless, pace, thinned = self.lossless, self._acknowledgement.pace, self._thinned
        with while_open():
            for start in range(0, len(payloads), PAYLOAD_SIZE):
                payload, stamp = payloads[start : start + PAYLOAD_SIZE], new_timestamp()
                put(payload, timestamp=stamp)
                if thinned.opened or thinned.vehicle.is_wanted():
                    thinned.put(payload, stamp, self._encoding)
                self.last = payload, stamp, self._encoding
                self.published += 1
                if lossless:
                    pace(self.published)

    def flush(self, timeout: float = FLUSH_TIMEOUT) -> bool:
        """Wait until all readers of mode "every" have what was published; return False if one has not in time.

        What is still in transit to a slow reader when a publisher's process ends is lost, and not counted anywhere.
        A reader that was disconnected learns how much it missed, and is sent again what is still kept.

        Raises ClosedError once the bus is closed.
        """
        return self._acknowledgement.wait(self.published, timeout=timeout)

    def close(self) -> None:
        """Stop publishing this address: it is no longer listed, and free for another publisher.

        A lossless publisher flushes before.
        """
        if self._publisher is None:
            return
        # Dropped, as nothing else refers to it: undeclare() would wait for Zenoh while it holds the interpreter's lock.
        publisher, self._publisher = self._publisher, None
        if self.lossless:
            with suppress(NedbusError):
                self.flush()
        del publisher
        self._on_close()
        self._thinned.close()
        with suppress(zenoh.ZError):  # closed already with the session
            self._token.undeclare()
            self._key_token.undeclare()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _put(self, payload: bytes, provided: Set[str]) -> None:
        publisher = self._publisher
        if publisher is None:
            raise ClosedError
        require_unforked()
        encoding = self._encoding
        try:
            stamp = self._session.new_timestamp()
            if len(provided) == len(_ALL):
                publisher.put(payload, timestamp=stamp)
            else:
                if provided != self._provided:  # almost always the same fields are missing
                    self._provided = frozenset(provided)
                    self._partial_encoding = encoding_of(self.source, self._provided)
                encoding = self._partial_encoding
                publisher.put(payload, timestamp=stamp, encoding=encoding)
            if self._thinned.opened or self._thinned.vehicle.is_wanted():
                self._thinned.put(payload, stamp, encoding)
        except zenoh.ZError as exc:
            raise translate_error(exc) from exc
        self.last = payload, stamp, encoding
        self.published += 1
        if self.lossless:
            self._acknowledgement.pace(self.published)
