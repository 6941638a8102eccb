"""Messages by the thousand: the fixed-width payload as a NumPy record, with the model's rules checked on whole columns.

Types, offsets and rules come from the same tables as those of a single message.
Import it where arrays are used, and nowhere else: NumPy takes longer to load than all the rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from .cdr import places_in_cdr
from .layouts import CURRENT
from .position import FIELD_TYPES, NAMES, Values, VehicleLocalPosition
from .px4_types import TypeName
from .rules import FLAGGED, NOT_NEGATIVE, WITHIN
from .wire import NO_VALUES, PAYLOAD_SIZE, TAGS, places_on_the_wire

Records = npt.NDArray[np.void]
"""A structured array, one record a message, one column a field: `records["x"]`."""

_NATIVE: Final[Mapping[TypeName, str]] = {
    "uint64": "u8", "uint8": "u1", "bool": "?", "float32": "f4", "float32[2]": "2f4", "float64": "f8",
}  # fmt: skip
_ON_WIRE: Final[Mapping[TypeName, str]] = {**_NATIVE, "bool": "u1", "float32[2]": "f4"}

DTYPE: Final = np.dtype([(name, _NATIVE[kind]) for name, kind in FIELD_TYPES.items()])
"""The columns of Records: PX4's fields in PX4's order, with PX4's types."""

FEW: Final = 8
"""Messages below which whole columns cost more than one by one."""

_PAIRS: Final = [place for place, kind in enumerate(FIELD_TYPES.values()) if kind == "float32[2]"]
_PARTS: Final = list(places_on_the_wire())
_WIRE: Final = np.dtype(
    {
        "names": [f"{name}.{part}" for name, part, _ in _PARTS],
        "formats": [">" + _ON_WIRE[FIELD_TYPES[name]] for name, _, _ in _PARTS],
        "offsets": [offset for _, _, offset in _PARTS],
        "itemsize": PAYLOAD_SIZE,
    }
)
_CDR_PLACES, _NOTHING_IN_CDR = places_in_cdr(CURRENT.name)
_CDR: Final = np.dtype(
    {
        "names": list(FIELD_TYPES),
        "formats": ["<" + _NATIVE[kind] if kind != "float32[2]" else "2<f4" for kind in FIELD_TYPES.values()],
        "offsets": [_CDR_PLACES[name] for name in FIELD_TYPES],
        "itemsize": len(_NOTHING_IN_CDR),
    }
)
_WORDS: Final = PAYLOAD_SIZE // 4
_TAG_WORDS = np.frombuffer(TAGS.to_bytes(PAYLOAD_SIZE, "big"), "u4")
_TAG_BITS = np.frombuffer((NO_VALUES & ((1 << 8 * PAYLOAD_SIZE) - 1)).to_bytes(PAYLOAD_SIZE, "big"), "u4")


def read_records(payloads: bytes) -> tuple[Records, npt.NDArray[np.bool_]]:
    """Return the messages of full-width payloads, one after the other, and which of them are valid.

    False says only that `decode` should look at that payload.
    """
    words = np.frombuffer(payloads, "u4").reshape(-1, _WORDS)
    valid = ((words & _TAG_BITS) == _TAG_WORDS).all(axis=1)
    wire = np.frombuffer(payloads, _WIRE)
    records = np.empty(len(wire), DTYPE)
    for name, part, _ in _PARTS:
        values = wire[f"{name}.{part}"]
        if FIELD_TYPES[name] == "float32[2]":
            records[name][:, part] = values
        else:
            records[name] = values & 1 if FIELD_TYPES[name] == "bool" else values
    return records, valid & find_sound(records)


def write_records(records: Records) -> bytes:
    """Return the payloads of messages, one after the other; whether they are valid is not looked at."""
    wire = np.frombuffer(bytearray(TAGS.to_bytes(PAYLOAD_SIZE, "big") * len(records)), _WIRE)
    for name, part, _ in _PARTS:
        if FIELD_TYPES[name] == "float32[2]":
            wire[f"{name}.{part}"] = records[name][:, part]
        elif FIELD_TYPES[name] == "bool":
            wire[f"{name}.{part}"] |= records[name]
        else:
            wire[f"{name}.{part}"] = records[name]
    return wire.tobytes()


def write_cdr_records(records: Records) -> npt.NDArray[np.void]:
    """Return the CDR payloads of messages, in the current layout, as an array with one payload a record."""
    payloads = np.frombuffer(bytearray(_NOTHING_IN_CDR * len(records)), _CDR)
    for name in FIELD_TYPES:
        payloads[name] = records[name]
    return payloads


def read_cdr_records(payloads: bytes) -> Records:
    """Return the messages of CDR payloads of the current layout, one after the other; rules are not looked at."""
    return np.frombuffer(payloads, _CDR).astype(DTYPE)


def find_sound(records: Records) -> npt.NDArray[np.bool_]:
    """Return which messages keep the rules between fields."""
    sound = records["timestamp_sample"] <= records["timestamp"]
    for flag, names in FLAGGED.items():
        for name in names:
            sound &= ~records[flag] | np.isfinite(records[name])
    for name in NOT_NEGATIVE:
        sound &= ~(records[name] < 0)
    for name, bound in WITHIN.items():
        sound &= ~(np.abs(records[name]) > bound)
    return sound


def to_records(messages: Sequence[VehicleLocalPosition]) -> Records:
    """Return messages as an array."""
    return np.array([tuple(message.__dict__.values()) for message in messages], DTYPE)


def to_row(record: np.void) -> Values:
    """Return the values of one record in PX4's order, `delta_xy` and `delta_vxy` as tuples."""
    values = list(record.item())
    for place in _PAIRS:
        values[place] = tuple(values[place].tolist())
    return tuple(values)


def to_message(record: np.void) -> VehicleLocalPosition:
    """Return one record as a message; raise pydantic.ValidationError for what the model refuses."""
    fields: dict[str, Any] = dict(zip(NAMES, to_row(record), strict=True))
    return VehicleLocalPosition(**fields)
