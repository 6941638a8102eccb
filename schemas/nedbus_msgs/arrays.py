"""Messages as a NumPy structured array: decoding, encoding and validation of many at once, column by column.

Types, offsets and rules come from the same tables as those of a single message.
Import this module only where arrays are used: NumPy takes longer to load than all the rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from .cdr import cdr_offsets
from .flags import FLAGS
from .layouts import CURRENT
from .position import VehicleLocalPosition
from .px4_types import TypeName
from .rows import FIELD_TYPES, NAMES, Values
from .rules import NOT_NEGATIVE, WITHIN
from .wire import PAYLOAD_SIZE, TAG_MASK, TAGS, value_offsets

MessageArray = npt.NDArray[np.void]
"""A structured array: one element per message, one column per field, such as `array["x"]`."""

_NATIVE: Final[Mapping[TypeName, str]] = {
    "uint64": "u8", "uint8": "u1", "bool": "?", "float32": "f4", "float32[2]": "2f4", "float64": "f8",
}  # fmt: skip
_ON_WIRE: Final[Mapping[TypeName, str]] = {**_NATIVE, "bool": "u1", "float32[2]": "f4"}

DTYPE: Final = np.dtype([(name, _NATIVE[kind]) for name, kind in FIELD_TYPES.items()])
"""The dtype of a MessageArray: PX4's fields in PX4's order, with PX4's types."""

FEW: Final = 8
"""Number of messages below which column by column takes longer than one by one."""

_PAIRS: Final = [index for index, kind in enumerate(FIELD_TYPES.values()) if kind == "float32[2]"]
_VALUES: Final = list(value_offsets())
_WIRE: Final = np.dtype(
    {
        "names": [f"{name}.{part}" for name, part, _ in _VALUES],
        "formats": [">" + _ON_WIRE[FIELD_TYPES[name]] for name, _, _ in _VALUES],
        "offsets": [offset for _, _, offset in _VALUES],
        "itemsize": PAYLOAD_SIZE,
    }
)
_CDR_OFFSETS, _ZEROS_IN_CDR = cdr_offsets(CURRENT.name)
_CDR: Final = np.dtype(
    {
        "names": list(FIELD_TYPES),
        "formats": ["<" + _NATIVE[kind] if kind != "float32[2]" else "2<f4" for kind in FIELD_TYPES.values()],
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
_WORDS: Final = PAYLOAD_SIZE // 4  # 32-bit words of a payload
_TAG_WORDS = np.frombuffer(TAGS.to_bytes(PAYLOAD_SIZE, "big"), "u4")
_TAG_MASK_WORDS = np.frombuffer(TAG_MASK.to_bytes(PAYLOAD_SIZE, "big"), "u4")


def decode_array(payloads: bytes) -> tuple[MessageArray, npt.NDArray[np.bool_]]:
    """Return the messages of concatenated payloads of PAYLOAD_SIZE, and a mask of those that are valid.

    A payload that is False in the mask may still be valid: `decode` decides.
    """
    words = np.frombuffer(payloads, "u4").reshape(-1, _WORDS)
    valid = ((words & _TAG_MASK_WORDS) == _TAG_WORDS).all(axis=1)
    wire = np.frombuffer(payloads, _WIRE)
    array = np.empty(len(wire), DTYPE)
    for name, part, _ in _VALUES:
        values = wire[f"{name}.{part}"]
        if FIELD_TYPES[name] == "float32[2]":
            array[name][:, part] = values
        else:
            array[name] = values & 1 if FIELD_TYPES[name] == "bool" else values
    return array, valid & valid_mask(array)


def encode_array(array: MessageArray) -> bytes:
    """Return the concatenated payloads of messages, without validating them."""
    wire = np.frombuffer(bytearray(TAGS.to_bytes(PAYLOAD_SIZE, "big") * len(array)), _WIRE)
    for name, part, _ in _VALUES:
        if FIELD_TYPES[name] == "float32[2]":
            wire[f"{name}.{part}"] = array[name][:, part]
        elif FIELD_TYPES[name] == "bool":
            wire[f"{name}.{part}"] |= array[name]
        else:
            wire[f"{name}.{part}"] = array[name]
    return wire.tobytes()


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


def valid_mask(array: MessageArray) -> npt.NDArray[np.bool_]:
    """Return a mask of the messages that keep the rules between fields."""
    valid = array["timestamp_sample"] <= array["timestamp"]
    for flag in FLAGS.values():
        for name in flag.fields:
            valid &= ~array[flag.name] | np.isfinite(array[name])
    for name in NOT_NEGATIVE:
        valid &= ~(array[name] < 0)
    for name, bound in WITHIN.items():
        valid &= ~(np.abs(array[name]) > bound)
    return valid


def to_array(messages: Sequence[VehicleLocalPosition]) -> MessageArray:
    """Return messages as a structured array."""
    return np.array([tuple(message.__dict__.values()) for message in messages], DTYPE)


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
