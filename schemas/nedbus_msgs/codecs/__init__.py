"""The forms of a message: msgpack on the wire, CDR of ROS 2 and PX4, arrays of NumPy; each from its definition."""
