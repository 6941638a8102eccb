"""Tests of events, with a fake clock."""
