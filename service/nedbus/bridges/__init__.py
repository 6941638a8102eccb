"""Bridges from a bus to ROS 2 and to Foxglove."""

from typing import TYPE_CHECKING, Final

from nedbus.extras import lazy_exports

if TYPE_CHECKING:
    from .foxglove import FoxgloveServer
    from .ros2 import Ros2Bridge

FOXGLOVE_PORT: Final = 8765
"""The default port of the Foxglove app."""

__getattr__ = lazy_exports(
    __name__, {"FoxgloveServer": ("foxglove", "foxglove"), "Ros2Bridge": ("", "ros2")}
)

__all__ = ["FOXGLOVE_PORT", "FoxgloveServer", "Ros2Bridge"]
