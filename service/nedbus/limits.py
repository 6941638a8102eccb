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

CHANNELS_OF_VEHICLE: Final = 1000
"""Channels of a vehicle in a recording, so that none uses up those of a file; a PX4 has about 300 topics. \
Messages of further ones are left out, and counted."""

CHANNELS: Final = 60_000
"""Channels of a recording, because MCAP has 65,535, of which some are for log texts. \
Messages of further ones are left out, and counted."""

PENDING_BYTES: Final = 2**24
"""Bytes of a recording that wait in memory for a flush. Beyond it, the file is flushed early."""

BLOCK_BYTES: Final = 2**26
"""Bytes of a chunk of an MCAP file, also decompressed, and of its index; ROS 2 and nedbus write up to 8 MiB. \
A larger one is skipped, as damage."""

DESCRIPTION_BYTES: Final = 2**20
"""Bytes of a schema, a channel or statistics in an MCAP file; those of all possible channels have 655 kB. \
A larger one counts as damage."""

COMPRESSION: Final = 100
"""Compression ratio of an MCAP file above `BLOCK_BYTES`, because a small file could fill the memory. \
The rest of the file is skipped, as damage."""

COMPRESSED_MESSAGE: Final = 2**16
"""Decompressed bytes of a message that rosbag2 has compressed. A larger one is rejected."""

WARNING_TEXT: Final = 1000
"""Characters of a warning about a file, because names in it may be long. The rest is cut."""

FILE_WARNINGS: Final = 100
"""Warnings about one file, because each of its records may be damaged. Further ones are not listed."""


# --- ULog ---

# --- Time ---

LATEST_TIME: Final = 2**62
"""Time in a file [us]; a damaged one may be larger than 64 bits with a sign. A later time counts as this one."""

CLOCK_STEPS: Final = 1000
"""Steps of a recorder's clock that place a vehicle which appears later. Further steps are ignored."""

VEHICLE_STREAMS: Final = 1000
"""Streams of one vehicle whose times and events are followed, because a peer chooses their number. \
Further streams have none."""

KNOWN_TIMES: Final = 512
"""Messages of a stream among which copies are searched. An older copy counts as another message."""

# --- Events ---

VEHICLES: Final = 1000
"""Vehicles with events, because peers choose their names. Beyond it, the one that has been gone longest is \
forgotten; others have no events."""

GONE_VEHICLES: Final = 50
"""Vehicles that are kept although they have been gone for over a minute, or as many as were ever present at once, \
if those are more. Beyond it, those gone longest are forgotten."""

EVENTS: Final = 2000
"""Events that a process keeps, and those of a report. Beyond it, the oldest of the vehicle with the most is deleted."""

EVENTS_OF_VEHICLE: Final = 20
"""Events that a vehicle keeps, however many others have. Beyond it, they count against `EVENTS`."""

FILE_EVENTS: Final = 100_000
"""Events of a file. Beyond it, the oldest are left out, and counted."""

RECENT_EVENTS: Final = 100
"""Events of a vehicle among which the causes of the next one are searched. Older ones explain nothing."""

REPORTED_TOPICS: Final = 30
"""Topics of a vehicle in a report, those that nedbus defines first, because verdicts depend on them. \
The others are left out."""

FUSION_MESSAGES: Final = 400
"""Messages of an aid source, and of an external position, in the second that decides whether it is fused. \
Beyond it, the oldest are left out."""

COMPARED_MESSAGES: Final = 1000
"""Messages of an estimate, and measurements, that wait to be compared. Beyond it, the oldest messages and the \
measurements with the latest times are left out."""

# --- Commands ---

# --- Page ---

# --- Doctor ---

# --- Monitoring ---

# --- Bridges ---
