"""The one table of the boolean flags of a VehicleLocalPosition: what each promises, and how it is shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

from .messages.vehicle_local_position import VehicleLocalPosition
from .model.rules import FiniteWhile

_PARTLY_BAD: Final = (1, 99)  # the percentages that a share between 0 and 1 is shown with


@dataclass(frozen=True, slots=True)
class Flag:
    """One boolean field of the message.

    `fields`: those that are finite while the flag is set.
    `kind`: what it qualifies: the estimate, its global reference, or the terrain below.
    `label`: its name in a list of doubts, "" if it is not shown there.
    `inverted`: the flag is a warning: set is bad.
    """

    name: str
    fields: tuple[str, ...]
    kind: Literal["estimate", "reference", "terrain"]
    label: str = ""
    inverted: bool = False


_FINITE: Final = next(rule.flags for rule in VehicleLocalPosition.RULES if isinstance(rule, FiniteWhile))
_ROWS: Final[tuple[tuple[str, Literal["estimate", "reference", "terrain"], str, bool], ...]] = (
    ("xy_valid", "estimate", "xy", False),
    ("z_valid", "estimate", "z", False),
    ("v_xy_valid", "estimate", "vxy", False),
    ("v_z_valid", "estimate", "vz", False),
    ("heading_good_for_control", "estimate", "", False),
    ("dead_reckoning", "estimate", "dead reckoning", True),
    ("xy_global", "reference", "", False),
    ("z_global", "reference", "", False),
    ("dist_bottom_valid", "terrain", "", False),
)
FLAGS: Final[Mapping[str, Flag]] = {
    name: Flag(name, tuple(_FINITE.get(name, ())), kind, label, inverted) for name, kind, label, inverted in _ROWS
}
"""The flags by name: those of the estimate first, in PX4's order."""

DOUBT_FLAGS: Final = tuple(flag.name for flag in FLAGS.values() if flag.label)
"""The flags that are shown when they cast doubt on a position."""


def describe_flags(shares: Mapping[str, float]) -> str:
    """Return which flags cast doubt on messages, given the share of them with each flag set, 0 to 1; "ok" if none does.

    "xy z invalid, dead reckoning" holds for all messages, "xy invalid 20 %" for some; a flag without a share is fine.
    """
    invalid, others = [], []
    for name in DOUBT_FLAGS:
        flag = FLAGS[name]
        if name not in shares:
            continue
        bad = shares[name] if flag.inverted else 1.0 - shares[name]
        text = flag.label if flag.inverted else f"{flag.label} invalid"
        if bad >= 1.0 and not flag.inverted:
            invalid.append(flag.label)
        elif bad > 0.0:
            least, most = _PARTLY_BAD
            others.append(text if bad >= 1.0 else f"{text} {min(most, max(least, round(100 * bad)))} %")
    grouped = [f"{' '.join(invalid)} invalid"] if invalid else []
    return ", ".join(grouped + others) or "ok"


def message_doubts(message: VehicleLocalPosition) -> str:
    """Return which flags cast doubt on one message, "ok" if none does."""
    return describe_flags({name: float(getattr(message, name)) for name in DOUBT_FLAGS})
