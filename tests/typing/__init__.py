"""What type checkers must accept and reject; read by mypy, never run."""
