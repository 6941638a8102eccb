"""Calls that type checkers must accept or reject; read by mypy, never run."""
