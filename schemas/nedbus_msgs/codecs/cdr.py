"""CDR codec for all layouts, as in ROS 2, PX4's Zenoh module and rosbag2.

Converts between payloads and fields by name; the model validates the fields.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from pydantic import ValidationError

from nedbus_msgs.errors import DecodeError, EncodeError
from nedbus_msgs.model.declaration import Layout, kept
from nedbus_msgs.model.definition import Definition
from nedbus_msgs.model.validation import Validation

HEAD: Final = b"\x00\x01\x00\x00"  # XCDR1, little-endian, no options
_PX4_EXTRA: Final = 24  # bytes that PX4 may send after the header and its own struct, which may be longer than CDR


@dataclass(frozen=True, slots=True)
class CdrLayout:
    """One layout in CDR: its body, and the offset of each field in a payload.

    `limit`: bytes of the longest payload. `not_bools`: bits of a payload, as a little-endian integer, that are 0 in all
    valid bools.
    """

    body: struct.Struct
    offsets: Mapping[str, int]
    limit: int
    not_bools: int
    validation: Validation

    @property
    def zeros(self) -> bytes:
        """A payload with all fields zero."""
        return HEAD + bytes(self.body.size)


def decode_with(definition: Definition[Any], payload: bytes, layout: Layout) -> dict[str, object]:
    """Decode a CDR payload to fields by name, in the order of the layout; arrays are tuples.

    Padding and the bytes that PX4 appends are ignored.

    Raises DecodeError for an encapsulation other than little-endian XCDR1, for too few or too many bytes, and for a
    bool that is neither 0 nor 1.
    """
    cdr = cdr_layout(layout)
    shortest = len(HEAD) + cdr.body.size
    if payload[:2] != HEAD[:2]:
        start = payload[:2].hex(" ") or "nothing"
        raise DecodeError(f"a payload that starts with {start}: not little-endian CDR", definition.name)
    if not shortest <= len(payload) <= cdr.limit:
        sizes = f"{shortest}" if cdr.limit == shortest else f"{shortest} to {cdr.limit}"
        raise DecodeError(f"{len(payload)} bytes, where layout {layout.name} has {sizes}", definition.name)
    if wrong := int.from_bytes(payload[:shortest], "little") & cdr.not_bools:
        offset = ((wrong & -wrong).bit_length() - 1) // 8
        name = next(name for name, first in reversed([*cdr.offsets.items()]) if first <= offset)
        raise DecodeError(f"{name}: {payload[offset]}, where a bool is 0 or 1", definition.name)
    return cdr.validation.name(cdr.validation.unflatten(cdr.body.unpack_from(payload, len(HEAD))))


def encode_with(definition: Definition[Any], fields: Mapping[str, object], layout: Layout) -> bytes:
    """Encode the fields of a layout, as returned by `downgrade`, as CDR with zeros for padding.

    float32 fields are rounded to the nearest float32.

    Raises EncodeError for a value that its type cannot hold.
    """
    cdr = cdr_layout(layout)
    row = cdr.validation.values_of(fields)
    try:
        return HEAD + cdr.body.pack(*cdr.validation.flatten(cdr.validation.validate(row)))
    except ValidationError as exc:
        name = list(layout.types)[int(exc.errors()[0]["loc"][0])]
        raise EncodeError(f"{name}: {fields[name]!r:.40} is not a {layout.types[name]}", definition.name) from None
    except OverflowError:
        name, _ = next(cdr.validation.overflows(fields))
        reason = f"{name}: {fields[name]!r:.40} is beyond the range of {layout.types[name]}"
        raise EncodeError(reason, definition.name) from None


@kept
def cdr_layout(layout: Layout) -> CdrLayout:
    """Compute the CDR form of a layout, with each field at the next multiple of its alignment."""
    body, size, unpadded, not_bools = "<", 0, 0, 0
    offsets = {}
    for name, kind in layout.types.items():
        padding = 0 if kind.is_text else -size % kind.size
        body += (f"{padding}x" if padding else "") + kind.form
        offsets[name] = len(HEAD) + size + padding
        if kind.base == "bool":
            not_bools |= int.from_bytes(b"\xfe" * kind.values) << 8 * offsets[name]
        size += padding + kind.size * kind.values
        unpadded += kind.size * kind.values
    px4_struct = unpadded + -unpadded % 8
    limit = len(HEAD) + max(size, px4_struct + _PX4_EXTRA)
    return CdrLayout(struct.Struct(body), offsets, limit, not_bools, Validation(layout.types, ()))
