"""Tests of the fusion of external positions."""
