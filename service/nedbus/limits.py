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

ULOG_FORMATS: Final = 2**20
"""Characters of all format definitions of a log; a real log has 50,000. Further definitions are damage."""

ULOG_LAYOUTS: Final = 500
"""Messages of a log that are decoded; a real log has 100, and PX4 300 topics. Further ones are left out."""

ULOG_FIELDS: Final = 8192
"""Fields of all messages of a log, each of which costs 45 us; a real log has 1,500. Further messages are left out."""

ULOG_MESSAGE_FIELDS: Final = 1000
"""Fields of one message, including nested ones and padding; a real one has 100. A larger message is left out."""

ULOG_NESTING: Final = 3
"""Levels of nested messages in a log; PX4 has one. A deeper message is left out, because it may nest itself."""

ULOG_SUBSCRIPTIONS: Final = 1000
"""Subscriptions of a log, except those that continue an earlier one; a real log has 170. Further ones are left out."""

ULOG_TEXT: Final = 1024
"""Bytes of a logged string; PX4 logs at most 127. A longer record is damage."""

LOG_MESSAGES: Final = 100
"""Texts per second of a log or vehicle, and failed checks per report; PX4 logs 20 at boot. Further ones are counted."""

EVENT_METADATA_PACKED: Final = 2**18
"""Bytes of the compressed event metadata of a log; PX4's take 17,000. The rest is cut, and events have no text."""

EVENT_METADATA: Final = 2**21
"""Bytes of the event metadata of a log; PX4's take 170,000. Larger metadata is not used, and events have no text."""

EVENT_METADATA_DICTIONARY: Final = 2**27
"""Bytes of memory to unpack event metadata. Metadata that needs more is not used, and events have no text."""

EVENT_DEFINITIONS: Final = 5000
"""Events in the metadata of a log; PX4 has 400. Metadata with more is not used, and events have no text."""

# --- Time ---

# --- Events ---

# --- Commands ---

# --- Page ---

# --- Doctor ---

# --- Monitoring ---

# --- Bridges ---
