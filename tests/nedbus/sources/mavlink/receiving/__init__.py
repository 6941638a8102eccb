"""Tests of the MAVLink source: receiving, losses, and a host that does not keep up."""
