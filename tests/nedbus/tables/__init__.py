"""Tests of nedbus.tables."""
