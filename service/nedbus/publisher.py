"""What one process publishes: one message in, one put out; and the answers to whoever asks for the last value."""

from __future__ import annotations

import json
import logging
import queue
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Final, cast

import zenoh
from pydantic_core import to_json

from nedbus_msgs import (
    ENCODING,
    Address,
    VehicleLocalPosition,
    encode,
    get_topic,
    json_schema,
    layout_table,
    schema_key,
)

from .errors import AddressInUseError
from .session import while_open

_log = logging.getLogger(__name__)

HEARTBEAT: Final = 0.5  # s: how soon a reader learns that it missed the newest message
_JSON: Final = "application/json"

Answer = tuple[str, bytes, str, "zenoh.Timestamp | None"]
"""Key, payload, encoding and time of one reply."""


class Publisher:
    """Publish the messages of one address; get one from `bus.publisher(...)`.

    Messages are kept for about 10 s for readers that missed some, and the last one for readers that ask.
    `publish` never waits for a slow reader, unless the publisher was made with `lossless=True`.
    Usable from one thread at a time, and from asyncio.
    """

    def __init__(self, session: zenoh.Session, address: Address, *, prefix: str, lossless: bool) -> None:
        self.address = address
        self.key = address.key(prefix=prefix)
        self.published = 0
        self.last: tuple[bytes, zenoh.Timestamp] | None = None
        self._session = session
        topic = get_topic(address.topic)
        control = zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP
        # A heartbeat together with BLOCK and recovering readers can stall a saturated link for 5 s.
        misses = zenoh.ext.MissDetectionConfig(heartbeat=None if lossless else HEARTBEAT, sporadic_heartbeat=None)
        with while_open():
            self._token = session.liveliness().declare_token(address.alive_key(prefix=prefix))
            self._publisher = zenoh.ext.declare_advanced_publisher(
                session,
                self.key,
                encoding=ENCODING,
                congestion_control=control,
                priority=getattr(zenoh.Priority, topic.priority),
                cache=zenoh.ext.CacheConfig(topic.cache),
                sample_miss_detection=misses,
                publisher_detection=True,
            )

    def publish(self, message: VehicleLocalPosition | Mapping[str, object]) -> None:
        """Validate a message, or the fields of one by name, and send it.

        A message that exists was validated when it was made; it is not validated again.

        Raises pydantic.ValidationError for fields that are no message, ClosedError once the bus is closed.
        """
        payload = encode(VehicleLocalPosition.model_validate(message))
        with while_open():
            stamp = self._session.new_timestamp()
            self._publisher.put(payload, timestamp=stamp)
        self.last = payload, stamp
        self.published += 1

    def close(self) -> None:
        """Stop publishing this address; `bus.vehicles()` no longer shows it."""
        with while_open():
            self._publisher.undeclare()
            self._token.undeclare()


class Outbox:
    """All publishers of a session, and its answers to queries; one thread of its own answers them.

    Whoever makes one closes it before the session.
    """

    def __init__(self, session: zenoh.Session, *, prefix: str) -> None:
        self.prefix = prefix
        self._session = session
        self._publishers: dict[Address, Publisher] = {}
        self._vehicles: set[str] = set()
        self._questions: queue.SimpleQueue[tuple[zenoh.Query, Callable[[zenoh.Query], Iterable[Answer]]] | None]
        self._questions = queue.SimpleQueue()
        self._queryables: list[zenoh.Queryable[None]] = []
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    @property
    def publishers(self) -> list[Publisher]:
        """All publishers that are open."""
        return list(self._publishers.values())

    def publisher(self, address: Address, *, lossless: bool = False) -> Publisher:
        """Return a publisher for an address; raise AddressInUseError if there is one already."""
        with self._lock:
            if address in self._publishers:
                raise AddressInUseError(address)
            publisher = Publisher(self._session, address, prefix=self.prefix, lossless=lossless)
            self._publishers[address] = publisher
            if not self._vehicles:
                self.answer(schema_key(prefix=self.prefix), self._answer_schema)
            if address.vehicle not in self._vehicles:
                self._vehicles.add(address.vehicle)
                self.answer(f"{self.prefix}/{address.vehicle}/**", self._answer_last)
        return publisher

    def release(self, address: Address) -> None:
        """Close the publisher of an address, so that another can take its place."""
        with self._lock:
            publisher = self._publishers.pop(address, None)
        if publisher is not None:
            publisher.close()

    def reject(self, address: Address, report: Mapping[str, object]) -> None:
        """Publish why a message of this address was not published; what JSON cannot hold is written as text."""
        payload = to_json(report, inf_nan_mode="strings", fallback=repr)
        with while_open():
            self._session.put(address.rejected_key(prefix=self.prefix), payload, encoding=_JSON)

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
        # The callback runs on Zenoh's own thread, where it must not linger: it only hands over.
        # A Python thread of Zenoh's would keep the process from exiting.
        hand_over: zenoh.handlers.Callback[zenoh.Query]
        hand_over = zenoh.handlers.Callback(lambda query: self._questions.put((query, reply)), indirect=False)
        with while_open():
            self._queryables.append(self._session.declare_queryable(key_expr, hand_over, complete=True))

    def close(self) -> None:
        """Stop answering; the publishers end with the session."""
        for queryable in self._queryables:
            queryable.undeclare()
        self._questions.put(None)
        if self._thread is not None:
            self._thread.join(1.0)

    def _serve(self) -> None:
        while (question := self._questions.get()) is not None:
            query, reply = question
            try:
                with query:
                    for key, payload, encoding, stamp in reply(query):
                        query.reply(key, payload, encoding=encoding, timestamp=stamp)
            except zenoh.ZError as exc:
                _log.debug("a query on %s could not be answered: %s", query.key_expr, exc)

    def _answer_last(self, query: zenoh.Query) -> Iterable[Answer]:
        for publisher in self.publishers:
            if publisher.last is not None and query.key_expr.intersects(publisher.key):
                payload, stamp = publisher.last
                yield publisher.key, payload, ENCODING, stamp

    def _answer_schema(self, _: zenoh.Query) -> Iterable[Answer]:
        content = {"json_schema": json_schema(), "layouts": layout_table()}
        return [(schema_key(prefix=self.prefix), json.dumps(content).encode(), _JSON, None)]
