"""Tests of the bridges to ROS 2 and Foxglove."""
