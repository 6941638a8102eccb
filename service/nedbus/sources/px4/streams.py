"""Decide which messages of rmw_zenoh publishers belong to which address; no I/O, no clock.

Times are monotonic seconds of the caller's clock.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from nedbus.sources.options import Px4ZenohOptions
from nedbus.transport import NO_HASH, Attachment, PublisherToken, TopicKey
from nedbus_msgs import (
    BY_TOPIC,
    Address,
    Definition,
    Layout,
    dds_type,
    message_of_type_hash,
    ros2_types,
    split_ros2_topic,
)

from .definitions import Definitions
from .publishers import PublisherTable

_MAX_STREAMS: Final = 1000  # keys; a vehicle has a handful
_MAX_LOSS: Final = 1_000_000  # messages that can be lost at once; a larger step is not a gap
_TIMEOUT: Final = 3.0  # s without messages after which another publisher may have the address
_HINT: Final = "give each a namespace or a domain of its own"


class NotAcceptedError(Exception):
    """Raised for a message that may be valid, but whose vehicle or layout is uncertain."""


class NotCarriedError(Exception):
    """Raised for a key that no option asks for; its text is the message, empty for what `topics=` leaves out."""


@dataclass(slots=True, eq=False)
class Px4Stream:
    """One key: the address and layout of its messages, its publisher, and the last sequence number.

    `unknown`: fields of a layout newer than this version, whose names or types it does not know.
    `restarted`: its publisher was replaced by another one, whose first message is not counted yet.
    `reboots`: the number of reboots of its vehicle that it took part in.
    """

    key: TopicKey
    address: Address
    definition: Definition[Any]
    layout: Layout
    unknown: tuple[str, ...]
    reboots: int
    publisher: PublisherToken | None = None
    gid: bytes | None = None
    sequence: int | None = None
    restarted: bool = False
    last_received: float = -math.inf
    last_reboot: float = -math.inf


class StreamRegistry:
    """All keys that messages arrived on, and the one stream that owns each address."""

    def __init__(self, options: Px4ZenohOptions, *, vehicle: str, given: Definitions | None = None) -> None:
        self.publishers = PublisherTable()
        self._options = options
        self._given = given or {}
        self._vehicle = vehicle
        self._streams: dict[str, Px4Stream] = {}
        self._owners: dict[Address, Px4Stream] = {}
        self._reboots: dict[str, int] = {}  # by vehicle

    def add_publisher(self, token: PublisherToken, now: float) -> None:
        """Add the publisher of a liveliness token that appeared; AddressError for a key without an address."""
        stream = self._streams.get(str(token.key))
        if stream is not None and _TIMEOUT <= now - stream.last_received < math.inf:
            # The publisher before is silent: it lost its connection, and a router takes longer to notice.
            self.publishers.forget(token.key)
        try:
            self.publishers.add(token, self._address_of(token.key), now)
        except NotCarriedError as exc:
            self.publishers.add(token, str(exc), now)

    def find(self, key: str) -> Px4Stream | None:
        """Return the stream of a key that was registered."""
        return self._streams.get(key)

    def register(self, key: str) -> Px4Stream:
        """Return a new stream for a key.

        Raises DecodeError or AddressError for a key that is none of a topic of PX4's, NotAcceptedError for one whose
        layout is unknown, and for one key too many, NotCarriedError for one that no option asks for.
        """
        parsed = TopicKey.parse(key)
        address = self._address_of(parsed)
        definition, layout = self._layout_of(parsed, address.topic)
        known = definition.known_types
        unknown = tuple(name for name, kind in layout.types.items() if kind not in known.get(name, ()))
        stream = Px4Stream(parsed, address, definition, layout, unknown, self._reboots.get(address.vehicle, 0))
        if len(self._streams) >= _MAX_STREAMS:
            raise NotAcceptedError(f"more than {_MAX_STREAMS} keys: name a domain, as in px4-zenoh:?domain=0")
        self._streams[key] = stream
        return stream

    def claim(self, stream: Px4Stream, attachment: Attachment | None, now: float) -> None:
        """Make a stream and a publisher the owner of their address.

        Raises NotAcceptedError while another key, or another publisher on the same key, owns it, and while two
        publishers are alike.
        """
        if self.publishers.are_alike(stream.key, now):
            stream.publisher = stream.gid = stream.sequence = None
            stream.last_received = now
            raise NotAcceptedError(f"two vehicles are alike, with one key and one gid: {_HINT}")
        owner = self._owners.setdefault(stream.address, stream)
        if owner is not stream:
            if now - owner.last_received < _TIMEOUT:
                raise NotAcceptedError(f"{owner.key} is {stream.address} already: name one of them with vehicles=")
            self._owners[stream.address] = stream
        if attachment is not None and attachment.gid != stream.gid:
            stream.restarted = stream.publisher is not None and not self.publishers.is_alive(stream.publisher)
            if stream.gid is not None and not stream.restarted and now - stream.last_received < _TIMEOUT:
                raise NotAcceptedError(f"two publishers share this key: {_HINT}")
            stream.gid, stream.sequence = attachment.gid, None
            stream.publisher = self.publishers.only(stream.key)

    def is_reboot(self, stream: Px4Stream) -> bool:
        """Count the restart of a stream; return whether it is the first one of its vehicle to restart."""
        vehicle = stream.address.vehicle
        known = self._reboots.get(vehicle, 0)
        is_first = stream.reboots == known
        self._reboots[vehicle] = stream.reboots = known + is_first
        return is_first

    def _address_of(self, key: TopicKey) -> Address:
        """Return the address of a key's messages; AddressError or NotCarriedError for one that has none here."""
        namespace, topic, instance = split_ros2_topic(key.topic)
        options, name = self._options, _message_name(key)
        is_known = key.dds_type in _by_dds_type() or key.dds_type in self._given
        if options.chosen_topics is None:
            if not is_known:
                raise NotCarriedError(name)
        elif topic not in options.chosen_topics and (options.topics or key.dds_type not in self._given):
            raise NotCarriedError("" if options.topics else f"{name} on {topic}" if is_known else name)
        return Address(self._vehicle_of(key.domain, namespace), topic, instance)

    def _vehicle_of(self, domain: int, namespace: str) -> str:
        """Return the vehicle that is configured, else one named by namespace and by any domain but the expected one."""
        vehicles = self._options.vehicles
        if namespace in vehicles:
            return vehicles[namespace]
        is_expected = domain == (self._options.domain or 0)
        of_domain = vehicles.get(str(domain), "" if is_expected else f"domain{domain}")
        return "-".join(filter(None, [of_domain, namespace.replace("/", "-")])) or self._vehicle

    def _layout_of(self, key: TopicKey, topic: str) -> tuple[Definition[Any], Layout]:
        """Return message and layout by the type hash of a key, else by the definition that is given for it."""
        name, known, given = _message_name(key), _by_dds_type().get(key.dds_type), self._given.get(key.dds_type, {})
        expected = BY_TOPIC.get(topic)
        if expected is not None and expected is not known:
            raise NotAcceptedError(f"{topic} has messages of type {expected.name}, not {name}")
        found = message_of_type_hash(key.type_hash)
        if found is not None and found[0] is known:
            return found
        own = given.get(key.type_hash)
        if own is None and key.type_hash == NO_HASH and len(given) == 1:
            [own] = given.values()
        if own is not None:
            return known or own, own.current
        hint = f"give PX4's own definition of it, as in px4-zenoh:?msg={name}.msg"
        if given:
            hashes = " or ".join(given)
            raise NotAcceptedError(
                f"{name}.msg has the type hash {hashes}, the key {key.type_hash}: give the vehicle's"
            )
        if known is None:
            raise NotAcceptedError(f"{name} with the type hash {key.type_hash} has no file here: {hint}")
        if key.type_hash != NO_HASH:
            reason = f"no known layout of {name} has the type hash {key.type_hash}"
            raise NotAcceptedError(f"{reason}: update nedbus, or {hint}")
        release = self._options.layout
        layout = known.layout_of_release(release) if release else None
        if layout is None:
            raise NotAcceptedError(f"the key has {NO_HASH}: name the layout, as in px4-zenoh:?layout=1.14, or {hint}")
        return known, layout


def _message_name(key: TopicKey) -> str:
    return key.dds_type.rpartition("::")[2].removesuffix("_")


@cache
def _by_dds_type() -> Mapping[str, Definition[Any]]:
    return {dds_type(name): definition for name, definition in ros2_types().items()}


def track_sequence(stream: Px4Stream, attachment: Attachment | None, now: float) -> tuple[int, bool]:
    """Account for a message; return the number lost just before it, and whether its publisher restarted.

    Raises NotAcceptedError for a duplicate, and for a sequence that goes back repeatedly: two vehicles with one gid.
    """
    lost, restarted = 0, stream.restarted
    if attachment is not None:
        step = 1 if stream.sequence is None else attachment.sequence - stream.sequence
        if step == 0:
            raise NotAcceptedError(f"sequence number {attachment.sequence} is a duplicate")
        if step < 0:
            is_repeated = now - stream.last_reboot < _TIMEOUT
            stream.last_reboot = now
            if is_repeated:
                raise NotAcceptedError(f"its sequence goes back and forth, as if two vehicles shared this key: {_HINT}")
            restarted = True
        elif step <= _MAX_LOSS:
            lost = step - 1
        stream.sequence = attachment.sequence
    stream.last_received, stream.restarted = now, False
    return lost, restarted
