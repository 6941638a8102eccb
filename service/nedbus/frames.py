"""Conversions between the frames of PX4 and ROS, and between local and global positions."""

from nedbus_msgs.frames import *  # noqa: F403 - all of it
from nedbus_msgs.frames import __all__ as __all__  # noqa: PLC0414 - exported
