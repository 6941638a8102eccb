"""Tests of the commands: output and exit codes."""
