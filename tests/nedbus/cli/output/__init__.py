"""Tests of the output of commands: logs and terminals."""
