"""Tests of the source for PX4 over Zenoh."""
