"""Conversion of MAVLink to PX4 messages, without links."""
