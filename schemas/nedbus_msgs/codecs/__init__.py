"""Message codecs: msgpack on the wire, and CDR as in ROS 2 and PX4."""
