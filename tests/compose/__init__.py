"""Tests of the shipped compose files with real containers and networks."""
