"""Definitions and layouts of messages."""
