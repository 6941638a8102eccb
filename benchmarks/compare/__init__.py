"""Comparison of nedbus with similar libraries: `python -m benchmarks.compare`."""
