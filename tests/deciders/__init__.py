"""Tests of pure decisions: no Zenoh session, no process, time given by the test."""
