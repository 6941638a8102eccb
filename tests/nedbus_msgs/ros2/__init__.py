"""Tests of ROS 2 names, types and .msg files."""
