"""What one process publishes: one message in, one put out; and the answers to whoever asks for the last value."""

from __future__ import annotations

import json
import logging
import queue
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Final, Self, cast

import zenoh
from pydantic_core import to_json

from nedbus_msgs import (
    FIELD_TYPES,
    PAYLOAD_SIZE,
    Address,
    Origin,
    Row,
    VehicleLocalPosition,
    encode,
    encode_fields,
    encode_row,
    encoding_of,
    get_topic,
    json_schema,
    layout_table,
    schema_key,
    taken_key,
)

from .errors import AddressInUseError, ClosedError, NedbusError
from .session import alive_keys, ask_all, translate, while_open

if TYPE_CHECKING:
    from nedbus_msgs.arrays import Records

_log = logging.getLogger(__name__)

_QUESTIONS: Final = 1000  # queries that wait for an answer
HEARTBEAT: Final = 0.5  # s: how soon a reader learns that it missed the newest message
_FLUSH: Final = 600.0  # s that readers have to take what was sent to them
_PATIENCE: Final = 2.0  # s until they are asked again; three round trips over a radio link fit in
_FIELDS: Final = len(FIELD_TYPES)
_JSON: Final = "application/json"

Answer = tuple[str, bytes, str, "zenoh.Timestamp | None"]
"""Key, payload, encoding and time of one reply."""


class Publisher:
    """Publish the messages of one address; get one from `bus.publisher(...)`.

    Messages are kept for about 20 s for readers that missed some, and the last one for readers that ask.
    `publish` never waits for a slow reader, unless the publisher was made to lose nothing.
    Usable from one thread at a time, and from asyncio; as a context manager it closes itself.
    """

    def __init__(
        self,
        session: zenoh.Session,
        address: Address,
        *,
        prefix: str,
        lossless: bool,
        source: str | None,
        on_close: Callable[[], object],
        owner: object,
    ) -> None:
        self.address = address
        self.key = address.key(prefix=prefix)
        self.published = 0
        self.source = Origin(source).source
        self.lossless = lossless
        self.last: tuple[bytes, zenoh.Timestamp, str] | None = None
        self._session = session
        self._on_close = on_close
        self._owner = owner  # the bus stays open for as long as somebody may publish
        self._closed = False
        self._encoding = encoding_of(source)
        topic = get_topic(address.topic)
        self._priority = getattr(zenoh.Priority, topic.priority)
        control = zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP
        # A heartbeat together with BLOCK and recovering readers can stall a saturated link for 5 s.
        misses = zenoh.ext.MissDetectionConfig(heartbeat=None if lossless else HEARTBEAT, sporadic_heartbeat=None)
        with while_open(self._session):
            self._token = session.liveliness().declare_token(address.alive_key(prefix=prefix))
            self._publisher = zenoh.ext.declare_advanced_publisher(
                session,
                self.key,
                encoding=self._encoding,
                congestion_control=control,
                priority=self._priority,
                cache=zenoh.ext.CacheConfig(topic.cache),
                sample_miss_detection=misses,
                publisher_detection=True,
            )

    def publish(self, message: VehicleLocalPosition | Mapping[str, object]) -> None:
        """Validate a message, or the fields of one by name, and send it.

        A message that exists was validated when it was made; it is not validated again.
        Readers are told which fields it was made without: `sample.missing`.

        Raises pydantic.ValidationError for fields that are no message, EncodeError for a message whose validation was
        bypassed, ClosedError once the publisher or its bus is closed.
        """
        if isinstance(message, VehicleLocalPosition):
            self._put(encode(message), message.__pydantic_fields_set__)
        else:
            self._put(encode_fields(message), message.keys())

    def publish_row(self, values: Sequence[object] | Row) -> None:
        """Validate the values of all fields in PX4's order, `delta_xy` and `delta_vxy` as tuples, and send them.

        The same as `publish` with these fields, and faster: no message is made of them.
        """
        self._put(encode_row(values), FIELD_TYPES)

    def publish_many(self, records: Records) -> None:
        """Validate messages in an array with the dtype nedbus_msgs.arrays.DTYPE, and send them; all or none.

        Raises TypeError for another dtype, pydantic.ValidationError for the first message that the model refuses.
        """
        from nedbus_msgs.arrays import DTYPE, FEW, find_sound, to_message, to_row, write_records

        if records.dtype != DTYPE:
            raise TypeError("records have the dtype nedbus_msgs.arrays.DTYPE: convert with astype")
        if len(records) < FEW:
            for payload in [encode_row(to_row(record)) for record in records]:
                self._put(payload, FIELD_TYPES)
            return
        for record in records[~find_sound(records)]:
            to_message(record)  # says what is wrong
        if self._closed:
            raise ClosedError
        payloads = write_records(records)
        put, new_timestamp = self._publisher.put, self._session.new_timestamp
        with while_open(self._session):
            for start in range(0, len(payloads), PAYLOAD_SIZE):
                payload, stamp = payloads[start : start + PAYLOAD_SIZE], new_timestamp()
                put(payload, timestamp=stamp)
                self.last = payload, stamp, self._encoding
                self.published += 1

    def _put(self, payload: bytes, provided: Collection[str]) -> None:
        if self._closed:
            raise ClosedError
        encoding = self._encoding
        try:
            stamp = self._session.new_timestamp()
            if len(provided) == _FIELDS:
                self._publisher.put(payload, timestamp=stamp)
            else:
                encoding = encoding_of(self.source, frozenset(provided))
                self._publisher.put(payload, timestamp=stamp, encoding=encoding)
        except zenoh.ZError as exc:
            raise translate(exc, self._session) from exc
        self.last = payload, stamp, encoding
        self.published += 1

    def flush(self, timeout: float = _FLUSH) -> bool:
        """Wait until all readers of mode "every" have what was published; return False if one has not in time.

        What is still on its way to a slow reader when a publisher's process ends is gone, and nobody knows of it.
        A reader that was cut off learns how much it missed, and is sent again what is still kept.

        Raises ClosedError once the bus is closed.
        """
        end = time.monotonic() + timeout
        if not self._ask_readers(end):
            return False
        self._tell_last()
        # The first answer comes when a reader has looked for what it misses, the second when it has it.
        return self._ask_readers(end) and self._ask_readers(end)

    def _ask_readers(self, end: float) -> bool:
        left = end - time.monotonic()
        return ask_all(self._session, taken_key(self.key), timeout=left, priority=self._priority)

    def _tell_last(self) -> None:
        """Send one heartbeat of Zenoh's advanced publishers by hand: the number of the last message."""
        if self.published:
            me = self._publisher.id
            last = zenoh.ext.z_serialize(zenoh.ext.UInt32((self.published - 1) % 2**32))
            with while_open(self._session):
                self._session.put(f"{self.key}/@adv/pub/{me.zid}/{me.eid}/_", last)

    def close(self) -> None:
        """Stop publishing this address: it is no longer listed, and free for another publisher.

        A publisher that loses nothing flushes before.
        """
        if self._closed:
            return
        self._closed = True
        if self.lossless:
            with suppress(NedbusError):
                self.flush()
        self._on_close()
        with suppress(zenoh.ZError):  # closed already with the session
            self._publisher.undeclare()
            self._token.undeclare()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


class Outbox:
    """All publishers of a session, and its answers to queries; one thread of its own answers them.

    Whoever makes one closes it before the session.
    """

    def __init__(self, session: zenoh.Session, *, prefix: str) -> None:
        self.prefix = prefix
        self._session = session
        self._publishers: dict[Address, Publisher] = {}
        self._vehicles: set[str] = set()
        self._questions: queue.Queue[tuple[zenoh.Query, Callable[[zenoh.Query], Iterable[Answer]]] | None]
        self._questions = queue.Queue(_QUESTIONS)
        self._queryables: list[zenoh.Queryable[None]] = []
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    @property
    def publishers(self) -> list[Publisher]:
        """All publishers that are open."""
        return list(self._publishers.values())

    def publisher(
        self, address: Address, *, lossless: bool = False, source: str | None = None, owner: object = None
    ) -> Publisher:
        """Return a publisher for an address, which keeps its owner alive; raise AddressInUseError if there is one."""
        with self._lock:
            if address in self._publishers:
                raise AddressInUseError(address)
            publisher = Publisher(
                self._session,
                address,
                prefix=self.prefix,
                lossless=lossless,
                source=source,
                on_close=lambda: self._publishers.pop(address, None),
                owner=owner,
            )
            self._publishers[address] = publisher
            if not self._vehicles:
                self.answer(schema_key(prefix=self.prefix), self._answer_schema)
            if address.vehicle not in self._vehicles:
                self._vehicles.add(address.vehicle)
                self.answer(f"{self.prefix}/{address.vehicle}/**", partial(self._answer_last, address.vehicle))
        return publisher

    def reject(self, address: Address, report: Mapping[str, object]) -> None:
        """Publish why a message of this address was not published; what JSON cannot hold is written as text."""
        payload = to_json(report, inf_nan_mode="strings", fallback=repr)
        with while_open(self._session):
            self._session.put(address.rejected_key(prefix=self.prefix), payload, encoding=_JSON)

    def is_alive(self, address: Address) -> bool:
        """Return whether somebody publishes this address already, here or elsewhere."""
        return bool(alive_keys(self._session, address.alive_key(prefix=self.prefix), timeout=0.5))

    def is_read(self, addresses: Iterable[Address]) -> bool:
        """Return whether a subscriber is there for any of these addresses."""
        probes = [self._session.declare_publisher(address.key(prefix=self.prefix)) for address in addresses]
        try:
            # Zenoh's stubs call the status a bool; it is an object, always true.
            return any(cast("zenoh.MatchingStatus", probe.matching_status).matching for probe in probes)
        finally:
            for probe in probes:
                probe.undeclare()

    def answer_json(self, key: str, content: Callable[[], Mapping[str, object]]) -> None:
        """Answer queries on a key with a JSON document, made anew for each."""
        self.answer(key, lambda _: [(key, json.dumps(content()).encode(), _JSON, None)])

    def answer(self, key_expr: str, reply: Callable[[zenoh.Query], Iterable[Answer]]) -> None:
        """Answer queries on a key expression."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._serve, name="nedbus-answers", daemon=True)
            self._thread.start()

        def hand_over(query: zenoh.Query) -> None:
            # On Zenoh's own thread, where it must not linger; a flood of questions goes without answers.
            with suppress(queue.Full):
                self._questions.put_nowait((query, reply))

        # A Python thread of Zenoh's would keep the process from exiting: the callback is a direct one.
        callback = zenoh.handlers.Callback(hand_over, indirect=False)
        with while_open(self._session):
            self._queryables.append(self._session.declare_queryable(key_expr, callback))

    def flush(self, publishers: Iterable[Publisher], *, stop: threading.Event | None = None) -> None:
        """Wait until the readers of these have what was published, or `stop` is set; for 10 minutes at most."""
        end = time.monotonic() + _FLUSH
        for publisher in publishers:
            told = False
            while not publisher.flush(_PATIENCE):
                if (stop and stop.is_set()) or time.monotonic() > end:
                    _log.warning("%s: not all of it was read", publisher.address)
                    return
                if not told:
                    _log.info("%s: waiting for a slow reader", publisher.address)
                told = True

    def close(self) -> None:
        """Stop answering; the publishers end with the session."""
        for queryable in self._queryables:
            with suppress(zenoh.ZError):
                queryable.undeclare()
        if self._thread is not None:
            with suppress(queue.Full):
                self._questions.put(None, timeout=0.5)
            self._thread.join(0.5)

    def _serve(self) -> None:
        while (question := self._questions.get()) is not None:
            query, reply = question
            try:
                with query:
                    for key, payload, encoding, stamp in reply(query):
                        query.reply(key, payload, encoding=encoding, timestamp=stamp)
            except zenoh.ZError as exc:
                _log.debug("a query on %s could not be answered: %s", query.key_expr, exc)

    def _answer_last(self, vehicle: str, query: zenoh.Query) -> Iterable[Answer]:
        for publisher in self.publishers:
            if publisher.last is None or publisher.address.vehicle != vehicle:
                continue
            if query.key_expr.intersects(publisher.key):
                payload, stamp, encoding = publisher.last
                yield publisher.key, payload, encoding, stamp

    def _answer_schema(self, _: zenoh.Query) -> Iterable[Answer]:
        content = {"json_schema": json_schema(), "layouts": layout_table()}
        return [(schema_key(prefix=self.prefix), json.dumps(content).encode(), _JSON, None)]
