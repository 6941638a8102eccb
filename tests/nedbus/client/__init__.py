"""Tests of the client through a real router."""
