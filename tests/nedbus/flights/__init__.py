"""Tests of nedbus.flights."""
