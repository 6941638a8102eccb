"""Tests of the sources: MAVLink, PX4 over Zenoh, logs, and the simulator."""
