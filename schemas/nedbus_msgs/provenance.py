"""Provenance of messages, carried in their Zenoh encoding: the source, and the fields that it does not provide.

    application/msgpack;px4_msgs/VehicleLocalPosition;source=mavlink;missing=fffff00000000

`missing` is a hexadecimal mask with one bit per field in PX4's order, the lowest for `timestamp`; it is left out if no
field is missing.
Both directions are cached, as almost all messages of a publisher have the same encoding.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

from .errors import AddressError
from .model.definition import Definition

_SOURCE = re.compile(r"[a-z0-9_-]{1,32}")
_MISSING = re.compile(r"[0-9a-f]+")
_ENCODING = re.compile(r"application/msgpack;px4_msgs/([A-Z][A-Za-z0-9]{0,63})(?:;.*)?")
_CACHE_SIZE: Final = 1024


@dataclass(frozen=True, slots=True)
class Provenance:
    """The origin of a message, as reported by its publisher.

    `source`: the kind of source, such as `sim`, `ulog`, `px4-zenoh` or `mavlink`; None if unknown.
    `missing`: the fields that the source does not provide; they hold NaN, false or 0.

    Raises AddressError for a source that is not 1 to 32 of a-z 0-9 _ -.
    """

    source: str | None = None
    missing: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if self.source is not None and not _SOURCE.fullmatch(self.source):
            raise AddressError("source", self.source, "1 to 32 of a-z 0-9 _ -")


@lru_cache(_CACHE_SIZE)
def encoding_of(definition: Definition[Any], source: str | None, provided: frozenset[str] | None = None) -> str:
    """Return the Zenoh encoding for a source that provides these fields; None means all fields."""
    names = definition.names
    mask = 0 if provided is None else sum(1 << index for index, name in enumerate(names) if name not in provided)
    parts = [f"application/msgpack;px4_msgs/{definition.name}"]
    if source is not None:
        parts.append(f"source={source}")
    if mask:
        parts.append(f"missing={mask:x}")
    return ";".join(parts)


@lru_cache(_CACHE_SIZE)
def message_name_of(encoding: str) -> str | None:
    """Return the message name in an encoding, None if there is none; known topics are decoded without it."""
    found = _ENCODING.fullmatch(encoding)
    return found[1] if found else None


@lru_cache(_CACHE_SIZE)
def provenance_of(definition: Definition[Any], encoding: str) -> Provenance:
    """Parse the provenance in an encoding; unknown or invalid parts are ignored, as other programs also publish."""
    parts = dict(part.partition("=")[::2] for part in encoding.split(";")[2:])
    source, missing = parts.get("source", ""), parts.get("missing", "")
    fits = _MISSING.fullmatch(missing) and len(missing) <= math.ceil(len(definition.names) / 4)
    mask = int(missing, 16) if fits else 0
    return Provenance(
        source if _SOURCE.fullmatch(source) else None,
        frozenset(name for index, name in enumerate(definition.names) if mask >> index & 1),
    )
