"""Tests of nedbus_msgs: no network, no processes."""
