"""Where messages come from, and which fields that source did not provide: said by the encoding, beside the payload.

    application/msgpack;px4_msgs/VehicleLocalPosition;source=mavlink;missing=fffff00000000

`missing` has a bit for each field in PX4's order, the lowest for `timestamp`, in hexadecimal; all are there without it.
A publisher says the same of almost all its messages, so neither side works on this more than once.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from .errors import AddressError
from .position import NAMES
from .topics import ENCODING

_SOURCE = re.compile(r"[a-z0-9_-]{1,32}")
_MISSING = re.compile(r"[0-9a-f]{1,14}")
_KEPT: Final = 1024


@dataclass(frozen=True, slots=True)
class Origin:
    """What is known of where a message comes from.

    `source`: the kind of source, such as `sim`, `ulog`, `px4-zenoh` or `mavlink`; None if its publisher did not say.
    `missing`: the fields that the source did not provide; they hold NaN, false or 0.

    Raises AddressError for a source that is not 1 to 32 of a-z 0-9 _ -.
    """

    source: str | None = None
    missing: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if self.source is not None and not _SOURCE.fullmatch(self.source):
            raise AddressError("source", self.source, "1 to 32 of a-z 0-9 _ -")


@lru_cache(_KEPT)
def encoding_of(source: str | None, provided: frozenset[str] | None = None) -> str:
    """Return the Zenoh encoding of messages of a source that provides these fields; None stands for all of them."""
    mask = 0 if provided is None else sum(1 << place for place, name in enumerate(NAMES) if name not in provided)
    parts = [ENCODING]
    if source is not None:
        parts.append(f"source={source}")
    if mask:
        parts.append(f"missing={mask:x}")
    return ";".join(parts)


@lru_cache(_KEPT)
def origin_of(encoding: str) -> Origin:
    """Return what an encoding tells; what is not understood tells nothing, as it may be anybody's."""
    parts = dict(part.partition("=")[::2] for part in encoding.split(";")[2:])
    source, missing = parts.get("source", ""), parts.get("missing", "")
    mask = int(missing, 16) if _MISSING.fullmatch(missing) else 0
    return Origin(
        source if _SOURCE.fullmatch(source) else None,
        frozenset(name for place, name in enumerate(NAMES) if mask >> place & 1),
    )
