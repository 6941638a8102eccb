"""Conversions between the frames of PX4 (NED, FRD) and ROS (ENU, FLU), and between local and global positions."""

from nedbus_msgs.frames import *  # noqa: F403 - re-exported
from nedbus_msgs.frames import __all__ as __all__  # noqa: PLC0414 - re-exported
