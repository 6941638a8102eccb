"""The message that most tests publish, and its topic."""

from __future__ import annotations

from typing import Any, Final

from nedbus_msgs import VehicleLocalPosition

VLP: Final = "vehicle_local_position"
VALID: Final[dict[str, Any]] = {
    **dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"), True),
    **dict.fromkeys(("x", "y", "z", "vx", "vy", "vz", "heading"), 0.0),
}
"""Fields of a stationary vehicle with a valid position."""


def message(timestamp: int = 1, **fields: object) -> VehicleLocalPosition:
    """Return a message with these fields; the others are not provided."""
    return VehicleLocalPosition.model_validate({"timestamp": timestamp, **fields})
