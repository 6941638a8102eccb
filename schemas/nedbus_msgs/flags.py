"""Describe the flags of a VehicleLocalPosition that cast doubt on it."""

from collections.abc import Collection, Mapping
from typing import Final

from .messages.vehicle_local_position import VehicleLocalPosition

_VALID: Final = {"xy_valid": "xy", "z_valid": "z", "v_xy_valid": "vxy", "v_z_valid": "vz"}
_WARNINGS: Final = {"dead_reckoning": "dead reckoning"}  # bad if set
DOUBT_FLAGS: Final = (*_VALID, *_WARNINGS)
"""The flags that can cast doubt on a position."""


def describe_flags(shares: Mapping[str, float]) -> str:
    """Describe the flags that cast doubt on messages, given each flag's share of messages with it set (0 to 1).

    "xy z invalid, dead reckoning" applies to all messages, "xy invalid 20 %" to some of them; "ok" if there is none.
    The validity of a quantity without a share is unknown: "vz unknown", or "validity unknown" if no flag has one.
    """
    bad = {name: 1.0 - shares[name] for name in _VALID if name in shares}
    bad |= {name: shares[name] for name in _WARNINGS if name in shares}
    invalid = [label for name, label in _VALID.items() if bad.get(name, 0.0) >= 1.0]
    unknown = [label for name, label in _VALID.items() if name not in shares]
    texts = [f"{' '.join(invalid)} invalid"] if invalid else []
    if unknown:
        texts.append(f"{'validity' if len(unknown) == len(_VALID) else ' '.join(unknown)} unknown")
    for name, share in bad.items():
        text = _WARNINGS.get(name) or f"{_VALID[name]} invalid"
        if 0.0 < share < 1.0:
            texts.append(f"{text} {min(99, max(1, round(100 * share)))} %")
        elif share >= 1.0 and name in _WARNINGS:
            texts.append(text)
    return ", ".join(texts) or "ok"


def message_doubts(message: VehicleLocalPosition, missing: Collection[str] = ()) -> str:
    """Describe the flags that cast doubt on one message, which lacks the `missing` fields; "ok" if there is none."""
    return describe_flags({name: float(getattr(message, name)) for name in DOUBT_FLAGS if name not in missing})
