"""Buses and their messages over a real router."""
