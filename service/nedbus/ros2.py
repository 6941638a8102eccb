"""The bridge to ROS 2: what is on a bus, published again as CDR for rmw_zenoh, in the layout that is asked for."""

from __future__ import annotations

import logging
import math
import os
import re
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import zenoh

from nedbus_msgs import (
    ANY,
    CURRENT,
    LAYOUTS,
    ROS2_TYPE,
    Address,
    LayoutError,
    VehicleLocalPosition,
    dds_type,
    downgrade,
    encode_cdr,
    type_hash,
)

from .bus import Bus
from .errors import AddressError, NoDataError
from .rmw_zenoh import NO_HASH, Attachment, TopicKey, make_gid, node_token, publisher_token, publishers_of
from .session import Session, alive_keys, while_open

_log = logging.getLogger(__name__)

_LOOK: Final = 1.0  # s between two looks at who is there
_TAKE_OVER: Final = 5.0  # s after which what was left to another node is taken over
_OLD: Final = 1.0  # s: what was recovered later than that is no estimate of now, which ROS 2 would take it for
_NAMESPACE = re.compile(r"[A-Za-z][A-Za-z0-9_]*(?:/[A-Za-z][A-Za-z0-9_]*)*|")


class Bridge:
    """Publish the vehicles of a bus to ROS 2, for nodes that use rmw_zenoh on the router of `session`.

    `ros2 topic list` shows each topic for as long as its vehicle is there, as `/fmu/out/<topic>`, with a namespace
    before it for every vehicle but `plain`: the vehicle's name, or `px4_<name>` where ROS 2 needs a letter first, or
    what `namespaces` says.
    Instances are `estimator_local_position_0`, `_1` and so on.
    A topic that another node publishes is left to that node: a PX4 that speaks Zenoh itself is not doubled.
    `hashed=False` is for ROS 2 Humble, whose keys have no hash of the type.

    Raises LayoutError for a layout that does not exist, AddressError for a namespace that ROS 2 would refuse.
    """

    def __init__(
        self,
        bus: Bus,
        session: Session,
        *,
        layout: str = CURRENT.name,
        domain: int = 0,
        topic: str = ANY,
        vehicle: str = ANY,
        instance: int | None = None,
        hashed: bool = True,
        plain: str = "1",
        namespaces: Mapping[str, str] | None = None,
    ) -> None:
        if layout not in LAYOUTS:
            raise LayoutError(f"no layout {layout!r}: choose from {', '.join(LAYOUTS)}")
        for namespace in (namespaces or {}).values():
            if not _NAMESPACE.fullmatch(namespace.strip("/")):
                raise AddressError("namespace", namespace, "a letter, then letters, digits and _, with / between names")
        self._bus = bus
        self._session = session
        self._layout = layout
        self._domain = domain
        self._topic, self._vehicle, self._instance = topic, vehicle, instance
        self._hash = type_hash(layout) if hashed else NO_HASH
        self._namespaces = {plain: "", **(namespaces or {})}
        self._node = f"nedbus_{os.getpid()}"
        self._outlets: dict[Address, _Outlet] = {}
        self._left: dict[Address, float] = {}  # to somebody else, and when that one was seen last
        self._met: set[Address] = set()  # that have the ROS 2 topic of another address
        self._entities = 0

    @property
    def bridged(self) -> dict[Address, tuple[str, int]]:
        """The ROS 2 topic of each address, and how many messages went there."""
        return {address: (f"/{outlet.key.topic}", outlet.sequence) for address, outlet in self._outlets.items()}

    def run(self, stop: threading.Event) -> None:
        """Publish until `stop` is set or the bus is closed."""
        with while_open(self._session):
            token = self._session.liveliness().declare_token(node_token(self._domain, self._zid, self._node))
        try:
            with self._bus.subscribe(
                self._topic, vehicle=self._vehicle, instance=self._instance, mode="every"
            ) as subscription:
                look = 0.0
                while not stop.is_set():
                    if time.monotonic() >= look:
                        self._look()
                        look = time.monotonic() + _LOOK
                    try:
                        sample = subscription.receive(0.1)
                    except NoDataError:
                        continue
                    outlet = self._outlets.get(sample.address)
                    if outlet is not None and (sample.latency is None or sample.latency < _OLD):
                        self._put(outlet, sample.message)
        finally:
            for outlet in self._outlets.values():
                outlet.close()
            self._outlets.clear()
            token.undeclare()

    @property
    def _zid(self) -> str:
        return str(self._session.info.zid())

    def _look(self) -> None:
        """Publish what is there, and no longer what is gone."""
        addresses = {
            address
            for addresses in self._bus.vehicles().values()
            for address in addresses
            if self._topic in (ANY, address.topic)
            and self._vehicle in (ANY, address.vehicle)
            and self._instance in (None, address.instance)
        }
        if not (self._bus.connected and self._session.info.routers_zid()):
            return  # nobody can be seen
        for address in self._outlets.keys() - addresses:
            _log.info("%s is gone: /%s ends", address, self._outlets[address].key.topic)
            self._outlets.pop(address).close()
        self._left = {address: seen for address, seen in self._left.items() if address in addresses}
        self._met &= addresses
        for address in sorted(addresses):
            self._open_or_leave(address)

    def _open_or_leave(self, address: Address) -> None:
        """Publish an address to ROS 2, unless and until another node does."""
        now = time.monotonic()
        key = TopicKey(self._domain, self._name(address), dds_type(ROS2_TYPE), self._hash)
        other = self._other_publisher(key)
        if other is not None:
            if address not in self._left:
                _log.warning("%s: node %s publishes /%s, it is left to that", address, other, key.topic)
            self._left[address] = now
            if address in self._outlets:
                self._outlets.pop(address).close()
        elif address not in self._outlets and now - self._left.get(address, -math.inf) > _TAKE_OVER:
            rival = next((each for each, outlet in self._outlets.items() if outlet.key == key), None)
            if rival is None:
                self._left.pop(address, None)
                self._open(address, key)
            elif address not in self._met:
                self._met.add(address)
                _log.warning("%s is left out: %s is /%s already: give one a --namespace", address, rival, key.topic)

    def _other_publisher(self, key: TopicKey) -> str | None:
        """Return the name of another node that publishes this."""
        for token in alive_keys(self._session, publishers_of(key), timeout=0.5):
            _, _, session, *_, node = token.split("/")[:9]
            if session != self._zid:
                return node
        return None

    def _open(self, address: Address, key: TopicKey) -> None:
        self._entities += 1
        with while_open(self._session):
            self._outlets[address] = _Outlet(
                key,
                make_gid(),
                self._session.declare_publisher(str(key), congestion_control=zenoh.CongestionControl.DROP),
                self._session.liveliness().declare_token(
                    publisher_token(key, self._zid, self._node, self._entities),
                ),
            )
        _log.info("%s -> /%s, %s of layout %s", address, key.topic, ROS2_TYPE, self._layout)

    def _name(self, address: Address) -> str:
        namespace = self._namespaces.get(address.vehicle)
        if namespace is None:
            word = address.vehicle.replace("-", "_")
            namespace = word if word[0].isalpha() else f"px4_{word}"
        topic = address.topic if address.instance is None else f"{address.topic}_{address.instance}"
        return "/".join(filter(None, [namespace.strip("/"), "fmu/out", topic]))

    def _put(self, outlet: _Outlet, message: VehicleLocalPosition) -> None:
        payload = encode_cdr(downgrade(message, self._layout), layout=self._layout)
        outlet.sequence += 1
        attachment = bytes(Attachment(outlet.sequence, time.time_ns(), outlet.gid))
        with while_open(self._session):
            outlet.publisher.put(payload, attachment=attachment)


@dataclass(slots=True, eq=False)
class _Outlet:
    """One topic of ROS 2: its key, the id and the sequence of its publisher, and its liveliness token."""

    key: TopicKey
    gid: bytes
    publisher: zenoh.Publisher
    token: zenoh.LivelinessToken
    sequence: int = 0

    def close(self) -> None:
        self.token.undeclare()
        self.publisher.undeclare()
