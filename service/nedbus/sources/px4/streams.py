"""Map keys of rmw_zenoh to addresses, and detect unavailable topics; no I/O, callers pass monotonic time [s]."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final, NamedTuple

from nedbus import limits
from nedbus.sources.options import Px4ZenohOptions
from nedbus.sources.source import UnavailableTopics
from nedbus.transport import NO_HASH, Attachment, PublisherToken, TopicKey
from nedbus_msgs import (
    BY_TOPIC,
    Address,
    Definition,
    Layout,
    dds_type,
    get_topic,
    has_char_hash,
    is_vehicle_input,
    message_of_type_hash,
    ros2_types,
    split_ros2_topic,
)

_PLAUSIBLE_LOSS: Final = 1_000_000  # messages lost at once; a larger step is not a gap
_TIMEOUT: Final = 3.0  # s without messages after which another publisher may use the address
_EXPIRY: Final = 60.0  # s without messages after which a key without a publisher is removed
# s during which messages may still arrive after a publisher's token is gone
_SETTLE_TIME: Final = 1.0
# s after which a topic without messages is silent; all nominal rates are 1 Hz or more
_SILENCE: Final = 5.0
_HINT: Final = "give each vehicle its own namespace or domain"


class TypeHashes(NamedTuple):
    """ROS 2 type hashes of one definition: the usual one, and the one with `literal_char`."""

    usual: str
    literal: str


Definitions = Mapping[str, Mapping[TypeHashes, Definition[Any]]]
"""Definitions that the user supplies, by DDS type and type hashes."""


class NotAcceptedError(Exception):
    """Raised for a message that may be valid, but whose vehicle or layout is ambiguous."""


class WireFormat(NamedTuple):
    """Definition and layout of messages; `unknown`: fields of a newer layout; `is_literal`: hash with literal char."""

    definition: Definition[Any]
    layout: Layout
    unknown: tuple[str, ...]
    is_literal: bool


@dataclass(slots=True, eq=False)
class Px4Stream:
    """State of one key: address and format of its messages, publishers, and last sequence number.

    `unsupported`: None if its messages are delivered, else their name, or "" if no option selects them.
    `wire_format`: None until the first message.
    `tokens`: announced publishers by token text; `since`: time of the first one.
    `ambiguous_until`: time until which messages of two publishers may be indistinguishable.
    `last_message`, `last_accepted`: arrival times of the last message, and of the last accepted one.
    `restarted`: another publisher took over, and its first message has not arrived yet.
    `reboots`: number of its vehicle's reboots seen on this key.
    `is_bridged`: messages from `nedbus ros2` have arrived.
    `is_input`: its messages go to the vehicle, from a node that does not reboot with it.
    """

    key: TopicKey
    address: Address
    unsupported: str | None
    wire_format: WireFormat | None = None
    tokens: dict[str, PublisherToken] = field(default_factory=dict)
    since: float = -math.inf
    ambiguous_until: float = -math.inf
    last_message: float = -math.inf
    last_accepted: float = -math.inf
    publisher: PublisherToken | None = None
    gid: bytes | None = None
    sequence: int | None = None
    restarted: bool = False
    rebooted: float = -math.inf
    reboots: int = 0
    is_bridged: bool = False
    is_input: bool = False

    def is_ambiguous(self) -> bool:
        """Return whether several sessions publish with the same gid."""
        session_of: dict[bytes, str] = {}
        for token in self.tokens.values():
            if token.gid is None:
                continue
            if session_of.setdefault(token.gid, token.session) != token.session:
                return True
        return False

    def nodes(self) -> set[tuple[str, str]]:
        """Return the nodes that publish on this key, except nedbus's bridges, which serve several vehicles."""
        return {
            (token.session, token.node)
            for token in self.tokens.values()
            if not token.node.startswith("nedbus_")
        }

    def is_silent(self, now: float) -> bool:
        """Return whether messages are overdue; never for topics without a nominal rate, which may pause."""
        if self.unsupported is not None or not get_topic(self.address.topic).rate:
            return False
        return now - max(self.since, self.last_message) >= _SILENCE

    def is_expired(self, now: float) -> bool:
        """Return whether the key has no publisher, and no recent message that could be decoded."""
        if self.tokens or now < self.ambiguous_until:
            return False
        return self.wire_format is None or now - self.last_message >= _EXPIRY

    def count_lost(self, sequence: int, now: float) -> int:
        """Note the sequence number of a message, and return the number of messages lost just before it.

        A number that goes back is a restart.

        Raises NotAcceptedError for a duplicate, and if numbers go back repeatedly.
        """
        before = self.sequence
        if before is None:
            self.sequence = sequence
            return 0
        step = sequence - before
        if step == 0:
            raise NotAcceptedError(f"sequence number {sequence} is a duplicate")
        if step < 0:
            is_repeated = now - self.rebooted < _TIMEOUT
            self.rebooted = now
            if is_repeated:
                reason = f"sequence numbers go back and forth, as if two vehicles shared this key; {_HINT}"
                raise NotAcceptedError(reason)
            self.restarted = True
        self.sequence = sequence
        if 0 < step <= _PLAUSIBLE_LOSS:
            return step - 1
        return 0

    def claim_key(self, gid: bytes, now: float) -> None:
        """Make a publisher the owner of the key; raise NotAcceptedError while it has another one."""
        publisher = self.publisher
        self.restarted = publisher is not None and publisher.text not in self.tokens
        is_active = self.gid is not None and now - self.last_accepted < _TIMEOUT
        if is_active and not self.restarted:
            raise NotAcceptedError(f"two publishers share this key; {_HINT}")
        self.gid = gid
        self.sequence = None
        self.publisher = None
        if len(self.tokens) == 1:
            [self.publisher] = self.tokens.values()


class StreamRegistry:
    """All keys with publishers or messages, and the stream that owns each address."""

    def __init__(
        self, options: Px4ZenohOptions, *, vehicle: str, supplied: Definitions | None = None
    ) -> None:
        self._options = options
        self._vehicle = vehicle
        self._supplied = supplied or {}
        self._streams: dict[str, Px4Stream] = {}
        self._owners: dict[Address, Px4Stream] = {}
        self._reboots: dict[str, int] = {}  # by vehicle

    def add_publisher(self, token: PublisherToken, now: float) -> None:
        """Add the publisher of a new liveliness token; raise the errors of `on_message` if its key has no address."""
        stream = self._stream_of(token.key)
        if _TIMEOUT <= now - stream.last_accepted < math.inf:
            # The previous publisher is silent: it lost its connection, which a router takes longer to notice.
            stream.tokens.clear()
            stream.ambiguous_until = -math.inf
        if not stream.tokens:
            stream.since = now
        if len(stream.tokens) < limits.PX4_PUBLISHERS:
            stream.tokens[token.text] = token
            if stream.is_ambiguous():
                stream.ambiguous_until = math.inf

    def remove_publisher(self, token: PublisherToken, now: float) -> bool:
        """Remove a publisher; return whether it was the last one of its key."""
        stream = self._streams.get(str(token.key))
        if stream is None:
            return True
        stream.tokens.pop(token.text, None)
        if stream.ambiguous_until == math.inf and not stream.is_ambiguous():
            stream.ambiguous_until = now + _SETTLE_TIME
        return not stream.tokens

    def on_message(self, key: str, now: float) -> Px4Stream:
        """Return the stream of a message's key; raise DecodeError, AddressError or NotAcceptedError."""
        stream = self._streams.get(key) or self._stream_of(TopicKey.parse(key))
        stream.last_message = now
        return stream

    def wire_format_of(self, stream: Px4Stream) -> WireFormat:
        """Return the format of a stream's messages; raise NotAcceptedError if it is unknown."""
        definition, layout = self._layout_of(stream.key, stream.address.topic)
        unknown = []
        for name, kind in layout.types.items():
            if kind not in definition.known_types.get(name, ()):
                unknown.append(name)
        type_hash = stream.key.type_hash
        is_literal = has_char_hash(type_hash)
        for hashes in self._supplied.get(stream.key.dds_type, {}):
            if type_hash == hashes.literal != hashes.usual:
                is_literal = True
        stream.wire_format = WireFormat(definition, layout, tuple(unknown), is_literal)
        stream.reboots = self._reboots.get(stream.address.vehicle, 0)
        return stream.wire_format

    def accept(
        self, stream: Px4Stream, attachment: Attachment | None, now: float
    ) -> tuple[int, bool]:
        """Return the number of messages lost just before this one, and whether its vehicle rebooted.

        Its stream and publisher become the owners of the address.

        Raises NotAcceptedError while another key, or another publisher on the same key, owns the address; while two
        publishers have the same gid; for a duplicate; and for a sequence that goes back repeatedly, as with two
        vehicles of the same gid.
        """
        self._claim_address(stream, now)
        lost = 0
        if attachment is not None:
            if attachment.gid != stream.gid:
                stream.claim_key(attachment.gid, now)
            lost = stream.count_lost(attachment.sequence, now)
        restarted = stream.restarted
        stream.restarted = False
        stream.last_accepted = now
        return lost, restarted and self._is_reboot(stream)

    def report(self, now: float) -> UnavailableTopics:
        """Return unsupported messages, and topics that are silent while others of the same node arrive."""
        self._remove_expired(now)
        # A node without any message has a broken link, not silent topics.
        sending = set()
        for stream in self._streams.values():
            if now - stream.last_message < _TIMEOUT:
                sending |= stream.nodes()
        unsupported = set()
        silent = set()
        for stream in self._streams.values():
            nodes = stream.nodes()
            if nodes and stream.unsupported:
                unsupported.add(stream.unsupported)
            if nodes & sending and stream.is_silent(now):
                silent.add(str(stream.address))
        return UnavailableTopics(
            tuple(sorted(unsupported)[: limits.UNREADABLE_TOPICS]),
            tuple(sorted(silent)[: limits.UNREADABLE_TOPICS]),
        )

    def _stream_of(self, key: TopicKey) -> Px4Stream:
        stream = self._streams.get(str(key))
        if stream is not None:
            return stream
        if len(self._streams) >= limits.PX4_KEYS:
            raise NotAcceptedError(
                f"more than {limits.PX4_KEYS} keys; choose a domain, as in px4-zenoh:?domain=0"
            )
        namespace, topic, instance = split_ros2_topic(key.topic)
        address = Address(self._vehicle_of(key.domain, namespace), topic, instance)
        unsupported = self._unsupported_name(key, topic)
        stream = Px4Stream(key, address, unsupported, is_input=is_vehicle_input(key.topic))
        self._streams[str(key)] = stream
        return stream

    def _remove_expired(self, now: float) -> None:
        for key, stream in [*self._streams.items()]:
            if stream.is_expired(now):
                del self._streams[key]
                if self._owners.get(stream.address) is stream:
                    del self._owners[stream.address]
        vehicles = {stream.address.vehicle for stream in self._streams.values()}
        for vehicle in self._reboots.keys() - vehicles:
            del self._reboots[vehicle]

    def _claim_address(self, stream: Px4Stream, now: float) -> None:
        if now < stream.ambiguous_until:
            stream.publisher = None
            stream.gid = None
            stream.sequence = None
            stream.last_accepted = now
            raise NotAcceptedError(f"two publishers on this key have the same gid; {_HINT}")
        owner = self._owners.setdefault(stream.address, stream)
        if owner is stream:
            return
        if now - owner.last_accepted < _TIMEOUT:
            reason = f"{owner.key} already has the address {stream.address}; rename one of them with vehicles="
            raise NotAcceptedError(reason)
        self._owners[stream.address] = stream

    def _is_reboot(self, stream: Px4Stream) -> bool:
        """Return whether the restart of a stream is the first sign of a reboot of its vehicle."""
        if stream.is_input:
            return False
        vehicle = stream.address.vehicle
        known = self._reboots.get(vehicle, 0)
        if stream.reboots != known:  # another stream of this vehicle has restarted before
            stream.reboots = known
            return False
        self._reboots[vehicle] = known + 1
        stream.reboots = known + 1
        return True

    def _unsupported_name(self, key: TopicKey, topic: str) -> str | None:
        name = _message_name(key)
        is_supplied = key.dds_type in self._supplied
        is_known = is_supplied or key.dds_type in _by_dds_type()
        chosen = self._options.chosen_topics
        if chosen is None:
            return None if is_known else name
        if topic in chosen:
            return None
        if self._options.topics:
            return ""
        if is_supplied:
            return None
        return f"{name} on {topic}" if is_known else name

    def _vehicle_of(self, domain: int, namespace: str) -> str:
        """Return the namespace's vehicle, else the domain's or `domain<N>` and the namespace, else the default."""
        vehicles = self._options.vehicles
        if namespace in vehicles:
            return vehicles[namespace]
        parts = []
        if str(domain) in vehicles:
            parts.append(vehicles[str(domain)])
        elif domain != (self._options.domain or 0):
            parts.append(f"domain{domain}")
        if namespace:
            parts.append(namespace.replace("/", "-"))
        return "-".join(parts) or self._vehicle

    def _layout_of(self, key: TopicKey, topic: str) -> tuple[Definition[Any], Layout]:
        """Return nedbus's definition and layout for the type hash of a key, else those supplied by the user."""
        name = _message_name(key)
        known = _by_dds_type().get(key.dds_type)
        expected = BY_TOPIC.get(topic)
        if expected is not None and expected is not known:
            raise NotAcceptedError(f"{topic} has messages of type {expected.name}, not {name}")
        built_in = message_of_type_hash(key.type_hash)
        if built_in is not None and built_in[0] is known:
            return built_in
        supplied = self._supplied.get(key.dds_type, {})
        for hashes, definition in supplied.items():
            is_only = key.type_hash == NO_HASH and len(supplied) == 1
            if is_only or key.type_hash in hashes:
                return known or definition, definition.layouts["PX4"]
        if supplied:
            own = " or ".join(hashes.usual for hashes in supplied)
            reason = f"{name}.msg has the type hash {own}, but the key has {key.type_hash}; use the file of this PX4"
            raise NotAcceptedError(reason)
        hint = f"supply its definition with px4-zenoh:?msg={name}.msg"
        if known is None:
            reason = f"{name} with the type hash {key.type_hash} is unknown; {hint}"
            raise NotAcceptedError(reason)
        if key.type_hash != NO_HASH:
            reason = f"no known layout of {name} has the type hash {key.type_hash}; update nedbus, or {hint}"
            raise NotAcceptedError(reason)
        layout = known.layout_of_release(self._options.layout or "")
        if layout is None:
            reason = f"the key has no type hash ({NO_HASH}); choose a layout, as in px4-zenoh:?layout=1.14, or {hint}"
            raise NotAcceptedError(reason)
        return known, layout


def _message_name(key: TopicKey) -> str:
    return key.dds_type.rpartition("::")[2].removesuffix("_")


@cache
def _by_dds_type() -> Mapping[str, Definition[Any]]:
    return {dds_type(name): definition for name, definition in ros2_types().items()}
