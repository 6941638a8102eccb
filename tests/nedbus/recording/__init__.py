"""Recordings, arrays, plots, and events of logs."""
