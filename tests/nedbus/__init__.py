"""Tests of nedbus: real sessions, real processes."""
