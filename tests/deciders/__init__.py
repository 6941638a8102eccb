"""Decisions alone: no Zenoh session, no process, time given by the test."""
