"""PX4's Zenoh module."""
