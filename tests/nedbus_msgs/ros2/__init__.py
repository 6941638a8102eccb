"""Names, types and definitions of ROS 2."""
