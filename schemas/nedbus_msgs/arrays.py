"""Messages as a NumPy structured array: decoding, encoding and validation of many at once.

Types, offsets and rules come from the same tables as those of a single message.
Import this module only where arrays are used: NumPy takes longer to load than all the rest.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from .cdr import cdr_offsets
from .errors import InvalidMessageError
from .flags import FLAGS
from .layouts import CURRENT
from .position import VehicleLocalPosition
from .px4_types import TypeName
from .rows import FIELD_TYPES, NAMES, Values
from .rules import NOT_NEGATIVE, RULED_FIELDS, WITHIN, make_fast_check
from .wire import PAYLOAD_SIZE, TAG_MASK, TAGS, encode_row, value_offsets

MessageArray = npt.NDArray[np.void]
"""A structured array: one element per message, one column per field, such as `array["x"]`."""

_KINDS: Final[Mapping[TypeName, str]] = {
    "uint64": "u8", "uint8": "u1", "bool": "?", "float32": "f4", "float32[2]": "2f4", "float64": "f8",
}  # fmt: skip

DTYPE: Final = np.dtype([(name, _KINDS[kind]) for name, kind in FIELD_TYPES.items()])
"""The dtype of a MessageArray: PX4's fields in PX4's order, with PX4's types."""

# The same bytes as DTYPE, and a payload without its tags: one name for each value, also of the pairs.
_NAMED: Final = [(f"{name}.{part}", DTYPE[name].base, offset) for name, part, offset in value_offsets()]
_NATIVE: Final = np.dtype([(name, kind) for name, kind, _ in _NAMED])
_WIRE: Final = np.dtype(
    {
        "names": [name for name, _, _ in _NAMED],
        "formats": [kind.newbyteorder(">") for _, kind, _ in _NAMED],
        "offsets": [offset for _, _, offset in _NAMED],
        "itemsize": PAYLOAD_SIZE,
    }
)


def _wire_offsets() -> Iterator[int]:
    """Yield the offset in a payload of each byte of an element of DTYPE."""
    for _, kind, offset in _NAMED:
        indexes = range(offset, offset + kind.itemsize)
        yield from reversed(indexes) if sys.byteorder == "little" else indexes


_FROM_WIRE: Final = np.fromiter(_wire_offsets(), np.intp, DTYPE.itemsize)
_TO_WIRE: Final = np.zeros(PAYLOAD_SIZE, np.intp)
_TO_WIRE[_FROM_WIRE] = np.arange(DTYPE.itemsize)
_TAGS: Final = np.frombuffer(TAGS.to_bytes(PAYLOAD_SIZE, "big"), np.uint8)
_TAG_MASK: Final = np.frombuffer(TAG_MASK.to_bytes(PAYLOAD_SIZE, "big"), np.uint8)
_VALUE_MASK: Final = ~_TAG_MASK
_CAST_FROM: Final = 256
"""Messages from which NumPy's cast of all fields is faster than taking the bytes one by one."""


def decode_array(payloads: bytes) -> tuple[MessageArray, npt.NDArray[np.bool_]]:
    """Return the messages of concatenated payloads of PAYLOAD_SIZE, and a mask of those that are valid.

    A payload that is False in the mask may still be valid: `decode` decides.
    """
    # Leaves zeros where the tags are right, and makes the bools 0 or 1.
    wire = np.frombuffer(payloads, np.uint8).reshape(-1, PAYLOAD_SIZE) ^ _TAGS
    wrong = wire & _TAG_MASK
    if not np.count_nonzero(wrong):
        array = _to_native(wire)
        return array, valid_mask(array)
    array = _to_native(wire & _VALUE_MASK)
    return array, valid_mask(array) & ~wrong.any(axis=1)


def encode_array(array: MessageArray) -> bytes:
    """Return the concatenated payloads of messages, without validating them."""
    if len(array) < _CAST_FROM:
        native = np.frombuffer(array.tobytes(), np.uint8).reshape(-1, DTYPE.itemsize)
        wire = native.take(_TO_WIRE, axis=1)
        wire &= _VALUE_MASK
    else:
        wire = np.zeros((len(array), PAYLOAD_SIZE), np.uint8)
        np.ndarray(len(array), _WIRE, wire)[:] = array.view(_NATIVE)
    wire |= _TAGS
    return wire.tobytes()


def _to_native(wire: npt.NDArray[np.uint8]) -> MessageArray:
    """Return the messages of payloads without their tags, of shape (n, PAYLOAD_SIZE)."""
    if len(wire) < _CAST_FROM:
        return np.ndarray(len(wire), DTYPE, wire.take(_FROM_WIRE, axis=1))
    return np.ndarray(len(wire), _WIRE, wire).astype(_NATIVE).view(DTYPE)


_CDR_OFFSETS, _ZEROS_IN_CDR = cdr_offsets(CURRENT.name)
_CDR: Final = np.dtype(
    {
        "names": list(FIELD_TYPES),
        "formats": ["<" + _KINDS[kind] if kind != "float32[2]" else "2<f4" for kind in FIELD_TYPES.values()],
        "offsets": [_CDR_OFFSETS[name] for name in FIELD_TYPES],
        "itemsize": len(_ZEROS_IN_CDR),
    }
)
_CDR_BOOLS: Final = np.dtype(
    {
        "names": [name for name, kind in FIELD_TYPES.items() if kind == "bool"],
        "formats": ["u1" for kind in FIELD_TYPES.values() if kind == "bool"],
        "offsets": [_CDR_OFFSETS[name] for name, kind in FIELD_TYPES.items() if kind == "bool"],
        "itemsize": len(_ZEROS_IN_CDR),
    }
)


def encode_cdr_array(array: MessageArray) -> npt.NDArray[np.void]:
    """Return the CDR payloads of messages in the current layout, one per element, without validating them."""
    payloads = np.frombuffer(bytearray(_ZEROS_IN_CDR * len(array)), _CDR)
    for name in FIELD_TYPES:
        payloads[name] = array[name]
    return payloads


def decode_cdr_array(payloads: Sequence[bytes]) -> tuple[MessageArray, npt.NDArray[np.bool_]]:
    """Return the messages of CDR payloads of the current layout, and a mask of those that are valid.

    A payload that is False in the mask may still be valid: `decode_cdr` and the model decide.
    """
    size = len(_ZEROS_IN_CDR)
    fits = np.array([len(each) == size and each[:2] == _ZEROS_IN_CDR[:2] for each in payloads], bool)
    data = b"".join(each if fit else _ZEROS_IN_CDR for each, fit in zip(payloads, fits.tolist(), strict=True))
    bools = np.frombuffer(data, _CDR_BOOLS)
    for name in _CDR_BOOLS.names or ():
        fits &= bools[name] <= 1
    array = np.frombuffer(data, _CDR).astype(DTYPE)
    return array, fits & valid_mask(array)


# The fields that rules look at, unpacked from the bytes of an element: as a struct, and their indexes in it.
_FORMATS: Final[Mapping[TypeName, str]] = {"uint64": "Q", "bool": "?", "float32": "f", "float64": "d"}
_STEPS: Final = [
    _FORMATS[kind] if name in RULED_FIELDS else f"{DTYPE[name].itemsize}x" for name, kind in FIELD_TYPES.items()
]
_RULED: Final = struct.Struct("=" + "".join(_STEPS))
_RULED_NAMES: Final = [name for name in FIELD_TYPES if name in RULED_FIELDS]
_passes_rules = make_fast_check({name: index for index, name in enumerate(_RULED_NAMES)})
_COLUMNS_FROM: Final = 20
"""Messages from which checking the rules column by column is faster than one message after the other."""


def valid_mask(array: MessageArray) -> npt.NDArray[np.bool_]:
    """Return a mask of the messages that pass the rules between fields; the array has the dtype DTYPE."""
    if len(array) < _COLUMNS_FROM:
        return np.fromiter(map(_passes_rules, _RULED.iter_unpack(array.tobytes())), np.bool_, len(array))
    invalid = array["timestamp_sample"] > array["timestamp"]
    for flag in FLAGS.values():
        for name in flag.fields:
            invalid |= array[flag.name] & ~np.isfinite(array[name])
    for name in NOT_NEGATIVE:
        invalid |= array[name] < 0
    for name, bound in WITHIN.items():
        invalid |= np.abs(array[name]) > bound
    return ~invalid


def require_valid(array: MessageArray) -> None:
    """Raise InvalidMessageError for the first message that breaks a rule between fields, with its index."""
    for index in np.flatnonzero(~valid_mask(array)).tolist():
        try:
            encode_row(to_row(array[index]))
        except InvalidMessageError as exc:
            raise InvalidMessageError(exc.reason, exc.violations, index=index) from exc


def to_array(messages: Sequence[VehicleLocalPosition]) -> MessageArray:
    """Return messages as a structured array."""
    return np.array([tuple(message.__dict__.values()) for message in messages], DTYPE)


_PAIRS: Final = [index for index, kind in enumerate(FIELD_TYPES.values()) if kind == "float32[2]"]


def to_row(element: np.void) -> Values:
    """Return the values of one element in PX4's order, `delta_xy` and `delta_vxy` as tuples."""
    values = list(element.item())
    for index in _PAIRS:
        values[index] = tuple(values[index].tolist())
    return tuple(values)


def to_message(element: np.void) -> VehicleLocalPosition:
    """Return one element as a message; raise pydantic.ValidationError if it is invalid."""
    fields: dict[str, Any] = dict(zip(NAMES, to_row(element), strict=True))
    return VehicleLocalPosition(**fields)
