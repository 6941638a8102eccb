"""The publishers of a session, by address, and the replies to queries for their last messages and schemas."""

import json
import logging
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from functools import partial
from typing import Any, Final, cast

import zenoh
from pydantic_core import to_json

from nedbus import limits
from nedbus.client.protocol import LIVE
from nedbus.errors import AddressInUseError
from nedbus.log_event import about
from nedbus.transport import LivelinessTokens, Session, VehicleDirectory, translate_zenoh_errors
from nedbus_msgs import (
    ANY,
    BY_TOPIC,
    Address,
    AddressError,
    Definition,
    Selection,
    schema_key,
    short_hash,
)

from .downsampler import MatchingListener
from .flow_control import SharedWindow
from .publish_permission import PublishPermission
from .publisher import FLUSH_TIMEOUT, Publisher
from .query_server import JSON, QueryServer
from .writer import Heartbeats

_log = logging.getLogger(__name__)

# s between acknowledgement requests: time for three round trips over a radio link
_FLUSH_POLL: Final = 2.0


class PublisherRegistry:
    """Create the publishers of a session, one per address, and reply to queries for their last messages.

    `is_client`: the session is a client, and reaches readers through a router.
    `on_vehicle`: called before the first publisher of a vehicle.
    `permission`: checks whether the router accepts what is published; None without a client certificate.
    """

    def __init__(
        self,
        session: Session,
        queries: QueryServer,
        *,
        prefix: str,
        is_client: bool,
        on_vehicle: Callable[[str], None] = lambda _: None,
        permission: PublishPermission | None = None,
    ) -> None:
        self.permission = permission
        self.prefix, self.is_client = prefix, is_client
        self._on_vehicle = on_vehicle
        self.heartbeats, self.window = Heartbeats(session), SharedWindow()
        self._session, self._queries = session, queries
        self.publishers: dict[Address, Publisher] = {}  # open publishers
        # by name and hash, oldest first
        self._definitions: dict[tuple[str, str], Definition[Any]] = {}
        # a vehicle without publishers that still answers schema queries, for messages in transit
        self._former = ""
        # by vehicle, for all its downsampled streams
        self._rate_listeners: dict[str, MatchingListener] = {}
        self._directories: dict[str, VehicleDirectory] = {}  # by vehicle
        self._shared: set[str] = set()  # vehicles that another process also publishes
        self._lock = threading.Lock()

    def publisher(
        self,
        address: Address,
        definition: Definition[Any] | None = None,
        *,
        lossless: bool = False,
        short_history: bool = False,
        source: str | None = None,
        owner: object = None,
    ) -> Publisher:
        """Return a new publisher for an address; the publisher keeps `owner` alive.

        `definition`: required for a topic that is not in BY_TOPIC.
        `short_history`: for one of the many streams of a source; see `Topic.kept_for_source`.

        Raises AddressInUseError if the address has a publisher, AddressError for an unknown topic.
        """
        definition = definition or BY_TOPIC.get(address.topic)
        if definition is None:
            expected = f"a definition from nedbus.define_msg, or one of {', '.join(BY_TOPIC)}"
            raise AddressError("topic", address.topic, expected)
        with self._lock, ExitStack() as undo:
            if address in self.publishers:
                raise AddressInUseError(address)
            if address.vehicle not in self._rate_listeners:
                undo.callback(self._forget_vehicle, address.vehicle)
                self._add_vehicle(address.vehicle)
            listener = self._rate_listeners[address.vehicle]
            publisher = self.publishers[address] = Publisher(
                address, definition, registry=self, listener=listener, lossless=lossless, short_history=short_history,
                source=source, owner=owner,
            )  # fmt: skip
            undo.pop_all()
            self._definitions[definition.name, short_hash(definition.name, definition.types)] = (
                definition
            )
            if len(self._definitions) > len(self.publishers) + limits.UNUSED_DEFINITIONS:
                used = {publisher.definition for publisher in self.publishers.values()}
                del self._definitions[
                    next(
                        key
                        for key, definition in self._definitions.items()
                        if definition not in used
                    )
                ]
        return publisher

    def reject(self, address: Address, report: Mapping[str, object]) -> None:
        """Publish a rejection report for an address; values that JSON cannot represent become text."""
        payload = to_json(report, inf_nan_mode="strings", fallback=repr)
        with translate_zenoh_errors():
            self._session.put(address.rejected_key(prefix=self.prefix), payload, encoding=JSON)

    def shared_vehicles(self) -> set[str]:
        """Return the vehicles that another process also publishes; log new ones."""
        with self._lock:  # several threads call this, and `forget` closes directories
            counts = {
                name: directory.publishers(timeout=0)
                for name, directory in self._directories.items()
            }
            shared = {
                name for name, numbers in counts.items() if max(numbers.values(), default=0) > 1
            }
            known, self._shared = self._shared, shared
        for name in shared - known:
            text = "vehicle %s is also published by another process: stop one, or give it another --vehicle"
            _log.warning(text, name, extra=about("duplicate"))
        return shared

    def has_subscriber(self, addresses: Iterable[Address]) -> bool:
        """Return True if any of these addresses has a subscriber."""
        with ExitStack() as opened:
            keys = (address.key(prefix=self.prefix) for address in addresses)
            probes = [opened.enter_context(self._session.declare_publisher(key)) for key in keys]
            # Zenoh's stubs declare the status as a bool, but the status is an object, which is always true.
            return any(
                cast("zenoh.MatchingStatus", probe.matching_status).matching for probe in probes
            )

    def flush(
        self,
        publishers: Iterable[Publisher],
        *,
        timeout: float = FLUSH_TIMEOUT,
        stop: threading.Event | None = None,
    ) -> None:
        """Wait until readers have received all messages of these publishers; end after `timeout` s or on `stop`."""
        end = time.monotonic() + timeout
        for publisher in publishers:
            address, logged = publisher.address, False
            while not publisher.flush(min(_FLUSH_POLL, max(0.0, end - time.monotonic()))):
                if (stop and stop.is_set()) or time.monotonic() >= end:
                    text = "%s: stopped waiting for a reader that has not received all messages"
                    _log.warning(text, address, extra=about("slow_reader", address))
                    return
                if not logged:
                    _log.info(
                        "%s: waiting for a slow reader",
                        address,
                        extra=about("slow_reader", address),
                    )
                logged = True

    def forget(self, address: Address) -> None:
        """Free the address of a closed publisher."""
        with self._lock:
            self.publishers.pop(address, None)
            if not any(publisher.vehicle == address.vehicle for publisher in self.publishers):
                self._forget_vehicle(address.vehicle)

    def _add_vehicle(self, vehicle: str) -> None:
        prefix, selection = self.prefix, Selection(vehicle=vehicle)
        schema = partial(schema_key, vehicle=vehicle, prefix=prefix)
        self._on_vehicle(vehicle)
        self._directories[vehicle] = VehicleDirectory(
            partial(LivelinessTokens, self._session, *selection.alive_key_exprs(prefix=prefix)),
            prefix=prefix,
        )
        self._rate_listeners[vehicle] = MatchingListener(
            self._session, *selection.rate_key_exprs(ANY, prefix=prefix)
        )
        self._queries.answer(f"{prefix}/{vehicle}/**", partial(_reply, weakref.ref(self), vehicle))
        # One key per vehicle, for the access rules: a vehicle may answer for its own messages only.
        self._queries.answer(schema(ANY), partial(_reply_schemas, schema, self._definitions))
        if self._former != vehicle:
            self._queries.end(schema_key(ANY, vehicle=self._former, prefix=prefix))
        self._former = ""

    def _forget_vehicle(self, vehicle: str) -> None:
        self._queries.end(f"{self.prefix}/{vehicle}/**")
        if (listener := self._rate_listeners.pop(vehicle, None)) is not None:
            listener.close()
        if (directory := self._directories.pop(vehicle, None)) is not None:
            directory.close()
        if self._rate_listeners or self._former:  # another vehicle can answer
            self._queries.end(schema_key(ANY, vehicle=vehicle, prefix=self.prefix))
        else:
            self._former = vehicle


def _reply(registry: weakref.ref[PublisherRegistry], vehicle: str, query: zenoh.Query) -> None:
    """Reply with the last messages of a vehicle; a strong reference would keep the registry and its bus alive."""
    owner = registry()
    if owner is None or (owner.permission is not None and owner.permission.is_refused(vehicle)):
        return  # this process sees what others see
    for publisher in tuple(owner.publishers.values()):
        matches = publisher.address.vehicle == vehicle and query.key_expr.intersects(publisher.key)
        if matches and publisher.last is not None:
            payload, stamp, encoding = publisher.last
            query.reply(publisher.key, payload, encoding=encoding, timestamp=stamp, attachment=LIVE)


def _reply_schemas(
    key_of: Callable[[str], str],
    definitions: Mapping[tuple[str, str], Definition[Any]],
    query: zenoh.Query,
) -> None:
    """Reply with the schemas of the queried messages, or only with the one whose hash the query names."""
    requested = query.parameters.get("hash")
    for (name, short), definition in tuple(definitions.items()):
        if requested in (None, short) and query.key_expr.intersects(key_of(name)):
            query.reply(
                key_of(name), json.dumps({**definition.schema(), "hash": short}), encoding=JSON
            )
