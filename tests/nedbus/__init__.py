"""Tests of nedbus with real sessions and real processes."""
