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

LIVE_ADDRESSES: Final = 1000
"""Published and stale addresses of one live source. Beyond it the longest stale one goes, or messages are rejected."""

REPLAYED_ADDRESSES: Final = 10_000
"""Addresses of one replay, as many as a reader tracks. Messages of further ones are rejected."""

REJECTION_ORIGINS: Final = 50
"""Origins of rejections of a source that are kept and logged. Rejections of further origins are only counted."""

REJECTION_RULES: Final = 50
"""Violated rules of a source with a separate counter. Further rules count as "other"."""

LOGGED_INVALID: Final = 5
"""Invalid messages of a source that are logged. Further ones are counted, and published as reports."""

STATUS_STREAMS: Final = 100
"""Streams of a source in its status, which must fit into one reply. Further ones are left out."""

# --- Sources ---

PX4_KEYS: Final = 10_000
"""Keys of rmw_zenoh per source; a vehicle has a few dozen. Messages on further keys are rejected."""

PX4_PUBLISHERS: Final = 64
"""Announced publishers per key, which a peer could announce without end. Further ones are ignored."""

PX4_SUBSCRIPTIONS: Final = 1000
"""Topics to which a source subscribes; a vehicle has a handful. Further ones are not received."""

PX4_PENDING: Final = 4096
"""Samples that wait to be decoded, so that a slow host does not fill its memory. Beyond it new ones are dropped."""

PX4_PAYLOAD: Final = 4096
"""Bytes of a sample, as of a message. A larger sample is rejected before it waits."""

REPORTED_TOPICS: Final = 100
"""Unsupported messages, and silent topics, in one report of a source. The rest is left out."""

# --- MAVLink ---

MAVLINK_VEHICLES: Final = 100
"""Vehicles per link, because a stranger could send with many ids. Messages of further ones are rejected."""

MAVLINK_WAITING: Final = 16_384
"""Received messages of all vehicles that wait for the source. Beyond it the oldest of the longest queue is dropped."""

WAITING_REJECTIONS: Final = 1000
"""Different rejections that wait for the source. Further ones count as one of "further places"."""

MAVLINK_UNSENT: Final = 4096
"""Bytes that a TCP or serial link may queue; more would be too old when they arrive. A frame beyond it is not sent."""

ENCODING: Final = 512
"""Characters of an encoding of a position from the bus; those of nedbus have at most 250. The rest is not parsed."""

TIMESYNC_REQUESTS: Final = 10
"""TIMESYNC requests that may be unanswered. Beyond it the oldest is forgotten, and its answer ignored."""

LOG_STREAM_PENDING: Final = 2**22
"""Bytes of a ULog stream that wait for its file, until its first message. Beyond it no file is written."""

DAMAGE_REASONS: Final = 100
"""Different reasons for damaged records of a ULog stream that are kept. Further ones count as "further damage"."""

SAME_NAMES: Final = 100
"""Files of ULog streams with the same name, told apart by a number. Beyond it no file is written."""

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
