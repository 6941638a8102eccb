"""Tests of nedbus_msgs, mostly without network and processes."""
