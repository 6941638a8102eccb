"""Rounding to float32: the nearest one, as a C float would hold it."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping
from operator import itemgetter
from typing import Final, cast

from .rows import FIELD_TYPES, NAMES, TEMPLATE, Values

FLOAT32_MAX: Final = struct.unpack("<f", b"\xff\xff\x7f\x7f")[0]

_SCALARS = tuple(name for name, kind in FIELD_TYPES.items() if kind == "float32")
_PAIR, _OTHER_PAIR = (name for name, kind in FIELD_TYPES.items() if kind == "float32[2]")
_OTHERS = tuple(name for name, kind in FIELD_TYPES.items() if not kind.startswith("float32"))
_FIRST, _SECOND = NAMES.index(_PAIR), NAMES.index(_OTHER_PAIR)
_get_scalars, _get_others = (
    cast("Callable[[Values], tuple[object, ...]]", itemgetter(*map(NAMES.index, names)))
    for names in (_SCALARS, _OTHERS)
)
_FLOATS = struct.Struct(f"<{len(_SCALARS) + 4}f")


def name_rounded(row: Values) -> dict[str, object]:
    """Return the values of all fields by name, float32 fields rounded; raise OverflowError beyond their range."""
    pairs = cast("tuple[tuple[float, float], ...]", (row[_FIRST], row[_SECOND]))
    floats = _FLOATS.unpack(_FLOATS.pack(*_get_scalars(row), *pairs[0], *pairs[1]))
    values = TEMPLATE.copy()
    values.update(zip(_SCALARS, floats, strict=False))  # the last four are the pairs'
    values.update(zip(_OTHERS, _get_others(row), strict=True))
    values[_PAIR], values[_OTHER_PAIR] = floats[-4:-2], floats[-2:]
    return values


def float32_overflows(values: Mapping[str, object]) -> Iterator[tuple[str, str]]:
    """Yield the field and the reason for every number that is beyond the range of its float32 field."""
    for name, kind in FIELD_TYPES.items():
        value = values[name]
        numbers = (value,) if kind == "float32" else value if kind == "float32[2]" else ()
        for number in cast("tuple[float, ...]", numbers):
            if math.isfinite(number) and abs(number) > FLOAT32_MAX:
                yield name, f"is beyond the range of float32 (+-{FLOAT32_MAX:.9g})"
