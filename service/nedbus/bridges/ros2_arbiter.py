"""Arbitration of ROS 2 topics: which addresses to publish, under which names; no I/O, no clock."""

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Literal

from nedbus.timings import TIMINGS
from nedbus_msgs import Address, AddressError, ros2_topic_of

_NAMESPACE = re.compile(r"[A-Za-z][A-Za-z0-9_]*(?:/[A-Za-z][A-Za-z0-9_]*)*|")


@dataclass(frozen=True, slots=True)
class Decision:
    """One change to the ROS 2 topics; `topic` has no leading slash.

    `publish`: publish the address.
    `withdraw`: stop publishing the address, which is no longer on the bus.
    `defer`: stop publishing the address if it is published; the node `other` publishes its topic.
    `conflict`: do not publish the address; the address `other` already uses its topic.
    """

    action: Literal["publish", "withdraw", "defer", "conflict"]
    address: Address
    topic: str
    other: str = ""


class Ros2Arbiter:
    """Decide which addresses to publish, from those on the bus and the publishers of other ROS 2 nodes.

    The namespace of a vehicle's topics is the one in `namespaces`, else none for "1", else the vehicle's name, with the
    prefix `px4_` unless it starts with a letter.
    `published`: the topic of each published address.

    Raises AddressError for a namespace that is invalid in ROS 2.
    """

    def __init__(self, namespaces: Mapping[str, str]) -> None:
        expected = "a letter, then letters, digits and _, with / between names"
        for namespace in namespaces.values():
            if not _NAMESPACE.fullmatch(namespace.strip("/")):
                raise AddressError("namespace", namespace, expected)
        self._namespaces = {"1": "", **namespaces}
        self.published: dict[Address, str] = {}
        self._deferred: dict[Address, float] = {}  # when another node's publisher was last seen [s]
        self._conflicts: set[Address] = set()

    def topic_of(self, address: Address) -> str:
        """Return the ROS 2 topic of an address, without a leading slash."""
        namespace = self._namespaces.get(address.vehicle)
        if namespace is None:
            name = address.vehicle.replace("-", "_")
            if name[0].isalpha():
                namespace = name
            else:
                namespace = f"px4_{name}"
        return ros2_topic_of(address, namespace.strip("/"))

    def update(
        self, addresses: Collection[Address], other_nodes: Mapping[Address, str], *, now: float
    ) -> list[Decision]:
        """Return the changes since the last call.

        `addresses`: the addresses on the bus; `other_nodes`: by address, the other node that publishes its topic.
        `now`: time on any monotonic clock [s].
        """
        present = set(addresses)
        decisions = list[Decision]()
        for address in sorted(self.published.keys() - present):
            topic = self.published.pop(address)
            decisions.append(Decision("withdraw", address, topic))
        for address in self._deferred.keys() - present:
            del self._deferred[address]
        self._conflicts &= present
        for address in sorted(present):
            decision = self._decide(address, other_nodes.get(address), now)
            if decision is not None:
                decisions.append(decision)
        return decisions

    def _decide(self, address: Address, other_node: str | None, now: float) -> Decision | None:
        """Return the change for an address on the bus; `other_node`: the node that publishes its topic."""
        topic = self.topic_of(address)
        if other_node is not None:
            is_new = address not in self._deferred
            self._deferred[address] = now
            self.published.pop(address, None)
            if is_new:
                return Decision("defer", address, topic, other_node)
            return None
        # A node that restarts must find its topic free.
        is_deferred = now - self._deferred.get(address, -math.inf) <= TIMINGS.take_over
        if is_deferred or address in self.published:
            return None
        owner = self._owner_of(topic)
        if owner is None:
            self._deferred.pop(address, None)
            self._conflicts.discard(address)
            self.published[address] = topic
            return Decision("publish", address, topic)
        if address in self._conflicts:
            return None
        self._conflicts.add(address)
        return Decision("conflict", address, topic, str(owner))

    def _owner_of(self, topic: str) -> Address | None:
        """Return the published address that uses a topic; None if the topic is free."""
        for address, published in self.published.items():
            if published == topic:
                return address
        return None
