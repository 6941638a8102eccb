"""Tests of the bus and its messages through a real router."""
