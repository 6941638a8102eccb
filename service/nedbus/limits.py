"""Limits of memory and text: each number once, with its reason and what happens at it.

The reference lists them: a line `# --- Title ---` begins a table, and the docstring of a limit is its row.
A threshold of an algorithm is no limit; it stands in the module of the algorithm.
"""

from __future__ import annotations

from typing import Final

# --- Texts and lists ---

PEER_TEXT: Final = 300
"""Characters of a text from a peer in a log line, an error or a report. A longer text is cut."""

SHOWN_NAMES: Final = 20
"""Names of vehicles, topics or streams in one text. The rest is counted."""

# --- Readers ---

UNREAD_MESSAGES: Final = 65_536
"""Unread messages of a subscription in mode `every`, unless `limit` is set. Beyond it the oldest are dropped."""

UNREAD_BYTES: Final = 64 * 2**20
"""Bytes of payload in the unread messages of a subscription. Beyond it the oldest are dropped."""

BATCH_MESSAGES: Final = 4096
"""Messages in a batch in mode `every`, unless `max_messages` is set. Further ones wait for the next batch."""

# --- Publishers ---

# --- Zenoh ---

# --- Services ---

# --- Sources ---

# --- MAVLink ---

# --- Files ---

ALIGNED_ROWS: Final = 10_000_000
"""Rows of `align` at a given rate, as a damaged timestamp must not exhaust memory. More raise ArgumentError."""

# --- ULog ---

# --- Time ---

# --- Events ---

# --- Commands ---

# --- Page ---

# --- Doctor ---

# --- Monitoring ---

# --- Bridges ---
