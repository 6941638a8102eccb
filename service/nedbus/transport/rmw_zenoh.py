"""Keys, attachments and liveliness tokens of ROS 2 over Zenoh, as used by rmw_zenoh and by PX4's `zenoh` module.

    key          <domain>/<topic>/<DDS type>/RIHS01_<hash>
    attachment   sequence number, time, 16, gid: 33 bytes, little-endian
    tokens       @ros2_lv/<domain>/<session>/<node>/<entity>/NN|MP|MS/<enclave>/<namespace>/<node name>
                 and for a publisher (MP) or a subscription (MS) /<topic>/<DDS type>/RIHS01_<hash>/<QoS>

Source: rmw_zenoh's design document; PX4's module is compatible with it.
"""

import re
import struct
from dataclasses import dataclass
from typing import Final, Literal, Self

import xxhash

from nedbus import limits
from nedbus_msgs import DecodeError

NO_HASH: Final = "TypeHashNotSupported"
"""Replaces the hash in keys of ROS 2 Humble, and of PX4 built for Humble."""

BRIDGED_ENCODING: Final = "application/cdr;nedbus"
"""Encoding that marks messages from nedbus, to prevent loops; ROS 2 ignores it."""

_QOS: Final = "2::,10:,:,:,,"  # best effort, volatile, keep last 10, as PX4 publishes
_ATTACHMENT: Final = struct.Struct("<qqB16s")
_GID: Final = 16  # bytes
_KEY: Final = re.compile(r"([0-9]{1,9})/([^*]+)/([^*/]+)/([^*/]+)")
_PX4_NODE: Final = re.compile(r"px4_([0-9a-f]{32})")
LONGEST_TOKEN: Final = limits.KEY_TEXT  # characters; tokens of ROS 2 are shorter
# key expression chunk for the DDS types of PX4 and of its message translation node
PX4_TYPES: Final = "px4_msgs$*"


@dataclass(frozen=True, slots=True)
class TopicKey:
    """The key of one topic; `topic` has no leading slash, `type_hash` may be NO_HASH."""

    domain: int
    topic: str
    dds_type: str
    type_hash: str

    @classmethod
    def parse(cls, key: str) -> Self:
        """Parse a key of rmw_zenoh; raise DecodeError for any other key."""
        match = None
        if len(key) <= limits.KEY_TEXT and "//" not in key:
            match = _KEY.fullmatch(key)
        if match is None:
            raise DecodeError("a key that is not <domain>/<topic>/<type>/<hash>")
        return cls(int(match[1]), match[2], match[3], match[4])

    def token(self, kind: Literal["MP", "MS"], session: str, node: str, entity: int) -> str:
        """Return the liveliness token of a node's publisher (MP), which ROS 2 lists, or of its subscription (MS)."""
        topic = self.topic.replace("/", "%")
        end = f"{self.dds_type}/{self.type_hash}/{_QOS}"
        return f"@ros2_lv/{self.domain}/{session}/0/{entity}/{kind}/%/%/{node}/%{topic}/{end}"

    def __str__(self) -> str:
        return f"{self.domain}/{self.topic}/{self.dds_type}/{self.type_hash}"


@dataclass(frozen=True, slots=True)
class Attachment:
    """The attachment of a message: sequence number, source time, and gid of the publisher.

    `time`: us since boot from PX4, ns since the epoch from rmw_zenoh.
    """

    sequence: int
    time: int
    gid: bytes

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Parse an attachment of rmw_zenoh; raise DecodeError for anything else."""
        if len(data) != _ATTACHMENT.size or data[_GID] != _GID:
            raise DecodeError(
                f"an attachment of {len(data)} bytes, not in rmw_zenoh's format of {_ATTACHMENT.size}"
            )
        sequence, time, _, gid = _ATTACHMENT.unpack(data)
        if sequence < 0:
            raise DecodeError(f"an attachment with the sequence number {sequence}")
        return cls(sequence, time, gid)

    def __bytes__(self) -> bytes:
        return _ATTACHMENT.pack(self.sequence, self.time, _GID, self.gid)


@dataclass(frozen=True, slots=True)
class PublisherToken:
    """The liveliness token of a publisher: session, node name, and key of its messages.

    `text`: the complete token, unique per publisher.
    """

    text: str
    session: str
    node: str
    key: TopicKey

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse the token of a publisher; raise DecodeError for anything else."""
        parts = text.split("/")
        if (
            len(parts) != 13
            or parts[0] != "@ros2_lv"
            or parts[5] != "MP"
            or len(text) > LONGEST_TOKEN
        ):
            raise DecodeError("a liveliness token that does not belong to a publisher")
        _, domain, session, _, _, _, _, _, node, topic, dds_type, type_hash, _ = parts
        name = topic.replace("%", "/").strip("/")
        return cls(text, session, node, TopicKey.parse(f"{domain}/{name}/{dds_type}/{type_hash}"))

    @property
    def gid(self) -> bytes | None:
        """The gid in PX4's node name, None for other nodes; all simulated PX4s have the same gid."""
        match = _PX4_NODE.fullmatch(self.node)
        if match:
            return bytes.fromhex(match[1])
        return None


def gid_of_token(token: str) -> bytes:
    """Return the gid of a token's owner, which ROS 2 shows and the attachments of the owner's messages carry.

    Source: rmw_zenoh, liveliness_utils.cpp: the 128-bit XXH3 of the token, lower half first.
    """
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(_GID, "little")


def node_token(domain: int, session: str, node: str) -> str:
    """Return the liveliness token that makes ROS 2 list a node; the node has no namespace."""
    return f"@ros2_lv/{domain}/{session}/0/0/NN/%/%/{node}"


def px4_publishers_key_expr(domain: int | None) -> str:
    """Return the key expression for the tokens of all publishers of PX4 messages, in one domain or (None) in all."""
    domains = "*"
    if domain is not None:
        domains = str(domain)
    return f"@ros2_lv/{domains}/*/*/*/MP/*/*/*/*/{PX4_TYPES}/*/*"
