"""Tests of a release: its public API and its locked dependencies."""
