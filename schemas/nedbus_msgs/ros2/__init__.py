"""ROS 2 types: names, type hashes and .msg definitions."""
