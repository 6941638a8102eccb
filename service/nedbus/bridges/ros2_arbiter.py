"""Decide which addresses are published to ROS 2, under which topic names; no I/O and no clock."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Final, Literal

from nedbus_msgs import Address, AddressError, ros2_topic_of

TAKE_OVER_DELAY: Final = 5.0
"""Seconds without another node's publisher after which its topic is taken over."""

_NAMESPACE = re.compile(r"[A-Za-z][A-Za-z0-9_]*(?:/[A-Za-z][A-Za-z0-9_]*)*|")


@dataclass(frozen=True, slots=True)
class Decision:
    """One change of the topics of ROS 2; `topic` has no leading slash.

    `publish`: publish the address.
    `withdraw`: the address is no longer on the bus; stop publishing it.
    `defer`: the node `other` publishes the topic; stop publishing the address if it is published.
    `conflict`: the address `other` has the topic already; the address is not published.
    """

    action: Literal["publish", "withdraw", "defer", "conflict"]
    address: Address
    topic: str
    other: str = ""


class Ros2Arbiter:
    """Follow the addresses of the bus and the nodes of ROS 2, and decide the changes.

    A namespace stands before the topics of every vehicle but "1": that of `namespaces`, else the vehicle's name, or
    `px4_<name>` where ROS 2 requires a leading letter.

    Raises AddressError for a namespace that is invalid in ROS 2.
    """

    def __init__(self, namespaces: Mapping[str, str]) -> None:
        for namespace in namespaces.values():
            if not _NAMESPACE.fullmatch(namespace.strip("/")):
                raise AddressError("namespace", namespace, "a letter, then letters, digits and _, with / between names")
        self._namespaces = {"1": "", **namespaces}
        self._published: dict[Address, str] = {}
        self._deferred: dict[Address, float] = {}  # when another node's publisher was seen last
        self._conflicts: set[Address] = set()

    def topic_of(self, address: Address) -> str:
        """Return the ROS 2 topic of an address, without a leading slash."""
        namespace = self._namespaces.get(address.vehicle)
        if namespace is None:
            name = address.vehicle.replace("-", "_")
            namespace = name if name[0].isalpha() else f"px4_{name}"
        return ros2_topic_of(address, namespace.strip("/"))

    def update(
        self, addresses: Collection[Address], other_nodes: Mapping[Address, str], *, now: float
    ) -> list[Decision]:
        """Return the changes, with these addresses on the bus, and the nodes that publish the topics of some of them.

        `now` is in seconds, of any monotonic clock.
        """
        present = set(addresses)
        decisions = [
            Decision("withdraw", address, self._published.pop(address))
            for address in sorted(self._published.keys() - present)
        ]
        self._deferred = {address: seen for address, seen in self._deferred.items() if address in present}
        self._conflicts &= present
        for address in sorted(present):
            decision = self._decide(address, other_nodes.get(address), now)
            if decision is not None:
                decisions.append(decision)
        return decisions

    def publishes(self, address: Address) -> bool:
        """Return whether an address is published."""
        return address in self._published

    def _decide(self, address: Address, other_node: str | None, now: float) -> Decision | None:
        topic = self.topic_of(address)
        if other_node is not None:
            is_new = address not in self._deferred
            self._deferred[address] = now
            self._published.pop(address, None)
            return Decision("defer", address, topic, other_node) if is_new else None
        if address in self._published or now - self._deferred.get(address, -math.inf) <= TAKE_OVER_DELAY:
            return None
        owner = next((each for each, published in self._published.items() if published == topic), None)
        if owner is None:
            self._deferred.pop(address, None)
            self._conflicts.discard(address)
            self._published[address] = topic
            return Decision("publish", address, topic)
        if address in self._conflicts:
            return None
        self._conflicts.add(address)
        return Decision("conflict", address, topic, str(owner))
