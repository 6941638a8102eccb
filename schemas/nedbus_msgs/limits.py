"""Limits of definitions and values: each number once, with its reason and what happens at it; see `nedbus.limits`."""

from __future__ import annotations

from typing import Final

# --- Messages ---

SHOWN_VALUE: Final = 200
"""Characters of a value in an error: the key of a peer may be 64 kB long. A longer value is cut."""
