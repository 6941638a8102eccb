"""Tests of the time of a vehicle and of a flight."""
