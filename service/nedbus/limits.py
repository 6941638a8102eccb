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

# --- ULog ---

# --- Time ---

# --- Events ---

# --- Commands ---

# --- Page ---

# --- Doctor ---

EXAMINED_NAMES: Final = 2_000
"""Services, streams and keys that the doctor examines, because a peer may claim any number. Others are left out."""

SHOWN_FINDINGS: Final = 10
"""Findings of one check, because a peer may claim to be a thousand vehicles. The others are counted."""

# --- Monitoring ---

HTTP_REQUESTS: Final = 16
"""Requests that an HTTP server answers at a time, each in a thread. Further clients wait, or replace the slowest."""

EXPORTED_STREAMS: Final = 1_000
"""Streams with own time series, which fill Prometheus' memory, positions first. The others are summed as "other"."""

EXPORTED_ROUTERS: Final = 16
"""Routers with own time series, because any peer may claim to be one. Others are left out."""

# --- Bridges ---

BRIDGED_STREAMS: Final = 10_000
"""Streams of which a bridge keeps a clock, a message or a log line, as peers may publish. The oldest is forgotten."""
