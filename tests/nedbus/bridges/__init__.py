"""ROS 2 and Foxglove."""
