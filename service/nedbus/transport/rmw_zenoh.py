"""Keys, attachments and liveliness tokens of ROS 2 over Zenoh: of rmw_zenoh, and of PX4's own Zenoh module.

    key          <domain>/<topic>/<DDS type>/RIHS01_<hash>
    attachment   sequence number, time, 16, gid: 33 bytes, little-endian
    tokens       @ros2_lv/<domain>/<session>/<node>/<entity>/NN|MP/<enclave>/<namespace>/<node name>[/<topic>/...]

Source: rmw_zenoh's design document, and PX4's `zenoh` module, which is compatible with it.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from typing import Final, Self

from nedbus_msgs import DecodeError

NO_HASH: Final = "TypeHashNotSupported"
"""What stands in place of the type hash in keys of ROS 2 Humble, and of a PX4 that is built for it."""

_QOS: Final = "2::,10:,:,:,,"  # best effort, volatile, the last 10: what PX4 offers
_ATTACHMENT: Final = struct.Struct("<qqB16s")
_GID: Final = 16
_GID_PREFIX: Final = b"nedbus"
_DOMAINS: Final = 10**9
_LENGTH: Final = 512  # characters of a key; PX4 and ROS 2 have half as many


@dataclass(frozen=True, slots=True)
class TopicKey:
    """The key of one topic: `topic` without a leading slash, `dds_type`, and its `type_hash` or NO_HASH."""

    domain: int
    topic: str
    dds_type: str
    type_hash: str

    @classmethod
    def parse(cls, key: str) -> Self:
        """Parse a key; raise DecodeError for any key that is not one of rmw_zenoh."""
        domain, *topic, dds_type, type_hash = [*key.split("/"), "", "", ""][: max(4, key.count("/") + 1)]
        if len(key) > _LENGTH:
            raise DecodeError(f"a key of {len(key)} characters")
        digits = domain.isascii() and domain.isdigit() and len(domain) < len(str(_DOMAINS))
        if not digits or not all(topic) or "*" in key or not type_hash:
            raise DecodeError("a key that is not <domain>/<topic>/<type>/<hash>")
        return cls(int(domain), "/".join(topic), dds_type, type_hash)

    def __str__(self) -> str:
        return f"{self.domain}/{self.topic}/{self.dds_type}/{self.type_hash}"


@dataclass(frozen=True, slots=True)
class Attachment:
    """The attachment of each message: its sequence number, its source time, and its publisher's gid.

    `time` is in us since boot from PX4, in ns since the epoch from rmw_zenoh.
    """

    sequence: int
    time: int
    gid: bytes

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Parse an attachment; raise DecodeError for anything else."""
        if len(data) != _ATTACHMENT.size or data[_GID] != _GID:
            raise DecodeError(f"an attachment of {len(data)} bytes that is not rmw_zenoh's of {_ATTACHMENT.size}")
        sequence, time, _, gid = _ATTACHMENT.unpack(data)
        if sequence < 0:
            raise DecodeError(f"an attachment with the sequence number {sequence}")
        return cls(sequence, time, gid)

    def __bytes__(self) -> bytes:
        return _ATTACHMENT.pack(self.sequence, self.time, _GID, self.gid)


def make_gid() -> bytes:
    """Return the gid of a new publisher of nedbus, which `is_nedbus_gid` recognizes."""
    return _GID_PREFIX + os.urandom(_GID - len(_GID_PREFIX))


def is_nedbus_gid(gid: bytes) -> bool:
    """Return whether a publisher of nedbus has this gid: its messages must not be bridged back."""
    return gid.startswith(_GID_PREFIX)


def node_token(domain: int, session: str, node: str) -> str:
    """Return the liveliness token of a node without namespace, by which ROS 2 lists it."""
    return f"@ros2_lv/{domain}/{session}/0/0/NN/%/%/{node}"


def publisher_token(key: TopicKey, session: str, node: str, entity: int) -> str:
    """Return the liveliness token of a node's publisher, by which ROS 2 lists its topic."""
    topic = "%" + key.topic.replace("/", "%")
    return f"@ros2_lv/{key.domain}/{session}/0/{entity}/MP/%/%/{node}/{topic}/{key.dds_type}/{key.type_hash}/{_QOS}"


def publishers_key_expr(key: TopicKey) -> str:
    """Return the key expression for the tokens of all publishers of a topic with this type and hash."""
    topic = "%" + key.topic.replace("/", "%")
    return f"@ros2_lv/{key.domain}/*/*/*/MP/*/*/*/{topic}/{key.dds_type}/{key.type_hash}/*"
