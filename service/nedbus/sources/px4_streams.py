"""Decide which messages of rmw_zenoh publishers belong to which address; no I/O, no clock.

Times are monotonic seconds of the caller's clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from nedbus.errors import DecodeError
from nedbus.transport import NO_HASH, Attachment, TopicKey
from nedbus_msgs import Address, layout_of_type_hash, split_ros2_topic

from .options import Px4ZenohOptions

_MAX_STREAMS: Final = 1000  # keys; a vehicle has a handful
_MAX_LOSS: Final = 1_000_000  # messages that can be lost at once; a larger step is not a gap
_TIMEOUT: Final = 3.0  # s without messages after which another publisher may have the address
_HINT: Final = "give each a namespace or a domain of its own"


@dataclass(slots=True, eq=False)
class Stream:
    """One key: the address and layout of its messages, its publisher, and the last sequence number."""

    key: str
    address: Address
    layout: str
    gid: bytes | None = None
    sequence: int | None = None
    last_received: float = -math.inf
    last_reboot: float = -math.inf


class StreamRegistry:
    """All keys that messages arrived on, and the one stream that owns each address."""

    def __init__(self, options: Px4ZenohOptions, *, vehicle: str) -> None:
        self._options = options
        self._vehicle = vehicle
        self._streams: dict[str, Stream] = {}
        self._owners: dict[Address, Stream] = {}

    def find(self, key: str) -> Stream | None:
        """Return the stream of a key that was registered."""
        return self._streams.get(key)

    def register(self, key: str) -> Stream:
        """Return a new stream for a key.

        Raises DecodeError or AddressError for a key that is not that of a local position topic in a known layout,
        and for one key too many.
        """
        parsed = TopicKey.parse(key)
        namespace, topic, instance = split_ros2_topic(parsed.topic)
        address = Address(self._vehicle_of(parsed.domain, namespace), topic, instance)
        stream = Stream(key, address, self._layout_of(parsed.type_hash))
        if len(self._streams) >= _MAX_STREAMS:
            raise DecodeError(f"more than {_MAX_STREAMS} keys: name a domain, as in px4-zenoh:?domain=0")
        self._streams[key] = stream
        return stream

    def claim(self, stream: Stream, attachment: Attachment | None, now: float) -> None:
        """Make a stream and a publisher the owner of their address.

        Raises DecodeError while another key, or another publisher on the same key, owns it.
        """
        owner = self._owners.setdefault(stream.address, stream)
        if owner is not stream:
            if now - owner.last_received < _TIMEOUT:
                raise DecodeError(f"{owner.key} is {stream.address} already: name one of them with vehicles=")
            self._owners[stream.address] = stream
        if attachment is not None and attachment.gid != stream.gid:
            if stream.gid is not None and now - stream.last_received < _TIMEOUT:
                raise DecodeError(f"two publishers share this key: {_HINT}")
            stream.gid, stream.sequence = attachment.gid, None

    def _vehicle_of(self, domain: int, namespace: str) -> str:
        """Return the vehicle that is configured, else one named by namespace and by any domain but the expected one."""
        vehicles = self._options.vehicles
        if namespace in vehicles:
            return vehicles[namespace]
        is_expected = domain == (self._options.domain or 0)
        of_domain = vehicles.get(str(domain), "" if is_expected else f"domain{domain}")
        return "-".join(filter(None, [of_domain, namespace.replace("/", "-")])) or self._vehicle

    def _layout_of(self, type_hash: str) -> str:
        if type_hash == NO_HASH:
            if self._options.layout is None:
                raise DecodeError(f"the key has {NO_HASH}: name the layout, as in px4-zenoh:?layout=1.14")
            return self._options.layout
        layout = layout_of_type_hash(type_hash)
        if layout is None:
            raise DecodeError(f"no known layout has the type hash {type_hash}: update nedbus")
        return layout


def track_sequence(stream: Stream, attachment: Attachment | None, now: float) -> tuple[int, bool]:
    """Take note of a message; return how many were lost just before it, and whether its vehicle rebooted.

    Raises DecodeError for a duplicate, and for a sequence that goes back repeatedly: two vehicles with one gid.
    """
    lost, rebooted = 0, False
    if attachment is not None:
        step = 1 if stream.sequence is None else attachment.sequence - stream.sequence
        if step == 0:
            raise DecodeError(f"sequence number {attachment.sequence} is a duplicate")
        if step < 0:
            is_repeated = now - stream.last_reboot < _TIMEOUT
            stream.last_reboot = now
            if is_repeated:
                raise DecodeError(f"its sequence goes back and forth, as if two vehicles shared this key: {_HINT}")
            rebooted = True
        elif step <= _MAX_LOSS:
            lost = step - 1
        stream.sequence = attachment.sequence
    stream.last_received = now
    return lost, rebooted
