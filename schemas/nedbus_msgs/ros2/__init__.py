"""ROS 2: the names, hashes and .msg texts of types, and the names of topics."""
