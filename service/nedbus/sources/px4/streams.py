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
# s, or periods of the nominal rate if longer, after which a topic without messages is silent
_SILENCE: Final = 5.0
_HINT: Final = "give each vehicle its own namespace or domain"

# Supplied by the user, by DDS type and ROS 2 type hash, the latter also with `literal_char`.
Definitions = Mapping[str, Mapping[tuple[str, str], Definition[Any]]]


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
        sessions = {
            (token.gid, token.session) for token in self.tokens.values() if token.gid is not None
        }
        return len({gid for gid, _ in sessions}) < len(sessions)

    def nodes(self) -> set[tuple[str, str]]:
        """Return the nodes that publish on this key, except nedbus's bridges, which serve several vehicles."""
        every = {(token.session, token.node) for token in self.tokens.values()}
        return {(session, node) for session, node in every if not node.startswith("nedbus_")}

    def is_silent(self, now: float) -> bool:
        """Return whether messages are overdue; never for topics without a nominal rate, which may pause."""
        rate = get_topic(self.address.topic).rate if self.unsupported is None else 0.0
        return rate > 0 and now - max(self.since, self.last_message) >= max(
            _SILENCE, _SILENCE / rate
        )


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
        stream = self._find(token.key)
        if _TIMEOUT <= now - stream.last_accepted < math.inf:
            # The previous publisher is silent: it lost its connection, which a router takes longer to notice.
            stream.tokens.clear()
            stream.ambiguous_until = -math.inf
        if not stream.tokens:
            stream.since = now
        if len(stream.tokens) < limits.PX4_PUBLISHERS:
            stream.tokens[token.text] = token
            stream.ambiguous_until = math.inf if stream.is_ambiguous() else stream.ambiguous_until

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
        stream = self._streams.get(key) or self._find(TopicKey.parse(key))
        stream.last_message = now
        return stream

    def wire_format_of(self, stream: Px4Stream) -> WireFormat:
        """Return the format of a stream's messages; raise NotAcceptedError if it is unknown."""
        definition, layout = self._layout_of(stream.key, stream.address.topic)
        unknown = tuple(
            name
            for name, kind in layout.types.items()
            if kind not in definition.known_types.get(name, ())
        )
        digest, supplied = stream.key.type_hash, self._supplied.get(stream.key.dds_type, {})
        is_literal = has_char_hash(digest) or any(
            literal == digest != own for own, literal in supplied
        )
        stream.wire_format = WireFormat(definition, layout, unknown, is_literal)
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
        self._claim(stream, attachment, now)
        lost, restarted = 0, stream.restarted
        if attachment is not None:
            step = 1 if stream.sequence is None else attachment.sequence - stream.sequence
            if step == 0:
                raise NotAcceptedError(f"sequence number {attachment.sequence} is a duplicate")
            if step < 0:
                is_repeated = now - stream.rebooted < _TIMEOUT
                stream.rebooted = now
                restarted = True
                if is_repeated:
                    reason = f"sequence numbers go back and forth, as if two vehicles shared this key; {_HINT}"
                    raise NotAcceptedError(reason)
            elif step <= _PLAUSIBLE_LOSS:
                lost = step - 1
            stream.sequence = attachment.sequence
        stream.last_accepted, stream.restarted = now, False
        if stream.is_input or not restarted:
            return lost, False
        known = self._reboots.get(stream.address.vehicle, 0)
        is_first = stream.reboots == known  # its vehicle's first stream to restart
        self._reboots[stream.address.vehicle] = stream.reboots = known + is_first
        return lost, is_first

    def report(self, now: float) -> UnavailableTopics:
        """Return unsupported messages, and topics that are silent while others of the same node arrive."""
        self._streams = {
            key: each
            for key, each in self._streams.items()
            if each.tokens
            or (each.wire_format and now - each.last_message < _EXPIRY)
            or now < each.ambiguous_until
        }
        known = {each.address.vehicle for each in self._streams.values()}
        self._owners = {
            at: each
            for at, each in self._owners.items()
            if self._streams.get(str(each.key)) is each
        }
        self._reboots = {
            vehicle: count for vehicle, count in self._reboots.items() if vehicle in known
        }
        nodes = [(stream, stream.nodes()) for stream in self._streams.values()]
        # A node without any message has a broken link, not silent topics.
        sending = {
            node for stream, own in nodes if now - stream.last_message < _TIMEOUT for node in own
        }
        silent = {
            str(stream.address) for stream, own in nodes if sending & own and stream.is_silent(now)
        }
        unsupported = {stream.unsupported for stream, own in nodes if own and stream.unsupported}
        return UnavailableTopics(
            tuple(sorted(unsupported)[: limits.UNREADABLE_TOPICS]),
            tuple(sorted(silent)[: limits.UNREADABLE_TOPICS]),
        )

    def _find(self, key: TopicKey) -> Px4Stream:
        stream = self._streams.get(str(key))
        if stream is None:
            if len(self._streams) >= limits.PX4_KEYS:
                raise NotAcceptedError(
                    f"more than {limits.PX4_KEYS} keys; choose a domain, as in px4-zenoh:?domain=0"
                )
            namespace, topic, instance = split_ros2_topic(key.topic)
            address = Address(self._vehicle_of(key.domain, namespace), topic, instance)
            stream = Px4Stream(
                key,
                address,
                self._unsupported_name(key, topic),
                is_input=is_vehicle_input(key.topic),
            )
            self._streams[str(key)] = stream
        return stream

    def _claim(self, stream: Px4Stream, attachment: Attachment | None, now: float) -> None:
        if now < stream.ambiguous_until:
            stream.publisher = stream.gid = stream.sequence = None
            stream.last_accepted = now
            raise NotAcceptedError(f"two publishers on this key have the same gid; {_HINT}")
        owner = self._owners.setdefault(stream.address, stream)
        if owner is not stream:
            if now - owner.last_accepted < _TIMEOUT:
                reason = f"{owner.key} already has the address {stream.address}; rename one of them with vehicles="
                raise NotAcceptedError(reason)
            self._owners[stream.address] = stream
        if attachment is not None and attachment.gid != stream.gid:
            stream.restarted = (
                stream.publisher is not None and stream.publisher.text not in stream.tokens
            )
            if (
                stream.gid is not None
                and not stream.restarted
                and now - stream.last_accepted < _TIMEOUT
            ):
                raise NotAcceptedError(f"two publishers share this key; {_HINT}")
            stream.gid, stream.sequence = attachment.gid, None
            stream.publisher = (
                next(iter(stream.tokens.values())) if len(stream.tokens) == 1 else None
            )

    def _unsupported_name(self, key: TopicKey, topic: str) -> str | None:
        options, name = self._options, _message_name(key)
        is_known = key.dds_type in _by_dds_type() or key.dds_type in self._supplied
        if options.chosen_topics is None:
            return None if is_known else name
        if topic in options.chosen_topics or (
            not options.topics and key.dds_type in self._supplied
        ):
            return None
        return "" if options.topics else f"{name} on {topic}" if is_known else name

    def _vehicle_of(self, domain: int, namespace: str) -> str:
        """Return the namespace's vehicle, else the domain's or `domain<N>` and the namespace, else the default."""
        vehicles = self._options.vehicles
        if namespace in vehicles:
            return vehicles[namespace]
        is_expected = domain == (self._options.domain or 0)
        of_domain = vehicles.get(str(domain), "" if is_expected else f"domain{domain}")
        return "-".join(filter(None, [of_domain, namespace.replace("/", "-")])) or self._vehicle

    def _layout_of(self, key: TopicKey, topic: str) -> tuple[Definition[Any], Layout]:
        """Return nedbus's definition and layout for the type hash of a key, else those supplied by the user."""
        name, known = _message_name(key), _by_dds_type().get(key.dds_type)
        supplied = self._supplied.get(key.dds_type, {})
        expected = BY_TOPIC.get(topic)
        if expected is not None and expected is not known:
            raise NotAcceptedError(f"{topic} has messages of type {expected.name}, not {name}")
        found = message_of_type_hash(key.type_hash)
        if found is not None and found[0] is known:
            return found
        own = next((each for hashes, each in supplied.items() if key.type_hash in hashes), None)
        if own is None and key.type_hash == NO_HASH and len(supplied) == 1:
            [own] = supplied.values()
        if own is not None:
            return known or own, own.layouts["PX4"]
        hint = f"supply its definition with px4-zenoh:?msg={name}.msg"
        if supplied:
            hashes = " or ".join(own for own, _ in supplied)
            reason = f"{name}.msg has the type hash {hashes}, but the key has {key.type_hash}; use the file of this PX4"
        elif known is None:
            reason = f"{name} with the type hash {key.type_hash} is unknown; {hint}"
        elif key.type_hash != NO_HASH:
            reason = f"no known layout of {name} has the type hash {key.type_hash}; update nedbus, or {hint}"
        elif layout := known.layout_of_release(self._options.layout or ""):
            return known, layout
        else:
            reason = f"the key has no type hash ({NO_HASH}); choose a layout, as in px4-zenoh:?layout=1.14, or {hint}"
        raise NotAcceptedError(reason)


def _message_name(key: TopicKey) -> str:
    return key.dds_type.rpartition("::")[2].removesuffix("_")


@cache
def _by_dds_type() -> Mapping[str, Definition[Any]]:
    return {dds_type(name): definition for name, definition in ros2_types().items()}
