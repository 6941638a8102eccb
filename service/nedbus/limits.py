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

LINE_TEXT: Final = 1000
"""Characters of a line of an error, a log or a report, parts of which peers write. A longer line is cut."""

LIST_TEXT: Final = 2000
"""Characters of a list of vehicles or topics that `nedbus info` prints. A longer list is cut."""

CELL_TEXT: Final = 120
"""Characters of a peer's value in a table, which must stay readable. A longer value is cut."""

TABLE_ROWS: Final = 200
"""Rows of a table, and services in `nedbus info`, as any peer may claim to be one. The others are counted."""

LIVE_ROWS: Final = 50
"""Rows of a table that is printed each second, as nobody reads more. The others are counted."""

LOG_KINDS: Final = 1000
"""Kinds of log lines with an own rate limit; nedbus itself has about 40. Further kinds share one."""

TRACEBACK_TEXT: Final = 20_000
"""Characters of a traceback in the log, which recursion makes long. Its beginning is cut: the end names the error."""

# --- Page ---

PAGES: Final = 32
"""Pages open at the same time, each of which takes a share of the CPU. Further ones show that the limit is reached."""

WAITING_PAGES: Final = 128
"""Pages without a WebSocket yet, as a client may request many and open none. At it, further pages are refused."""

PAGE_CONNECTIONS: Final = 512
"""Connections of the page, or half of RLIMIT_NOFILE, if that is less. Further ones are closed before `accept` fails."""

PAGE_REQUEST_BYTES: Final = 2**16
"""Body of a request, which Tornado buffers before the Host header is checked. A larger one is refused."""

PAGE_MESSAGE_BYTES: Final = 2**20
"""WebSocket message from a browser, which is buffered as a whole. A larger one closes the page's connection."""

PAGE_STREAMS: Final = 1000
"""Streams on a page, as each takes memory. Of more, positions are shown first, and the others are counted."""

PAGE_STORY_EVENTS: Final = 500
"""Latest events of a vehicle in which the page finds faults, twice a second. Earlier ones are not used."""

PAGE_STORIES: Final = 2000
"""Faults and reasons kept until the next event, more than an event log has vehicles. The oldest are dropped."""

PAGE_MARKS: Final = 2000
"""Events marked in the plots, which a browser can draw. Of more, the latest bad and watch events are marked."""

PAGE_TRACK_POINTS: Final = 6000
"""Points of all tracks on the map, which a browser can draw ten times a second. Of more, some are left out evenly."""

MAP_PIXELS: Final = 50_000_000
"""Pixels of an image file for the map, each of which takes up to 4 bytes. A larger image is refused unread."""

# --- Doctor ---

# --- Monitoring ---

# --- Bridges ---
