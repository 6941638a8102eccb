"""Tests of the built-in messages."""
