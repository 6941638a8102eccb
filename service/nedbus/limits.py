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

RING: Final = 16_384
"""Samples that Zenoh's ring holds between two polls: more than 0.2 s of the largest fleet. Then the oldest drop."""

KEYS: Final = 10_000
"""Keys tracked by a reader, to bound its memory. Beyond it the least recently active are evicted and counted."""

KEPT_KEYS: Final = 1_000
"""Keys kept however long they are silent, to count the losses of a long outage. Others follow KEY_SILENCE."""

KEY_SILENCE: Final = 600.0
"""Seconds without a message or heartbeat. After it a key is evicted, if there are more than KEPT_KEYS."""

DECLARED_KEYS: Final = 1024
"""Exact keys that a subscription declares to Zenoh, about 1.5 kB each. The messages of others cost more CPU time."""

PUBLISHERS_OF_KEY: Final = 8
"""Publishers per key. Beyond it the oldest without a gap is evicted; while all have gaps, none is added."""

HELD_MESSAGES: Final = 131_072
"""Messages held back behind gaps, about 90 MB. Beyond it gaps count as lost, those with most messages first."""

REQUESTING_PUBLISHERS: Final = 10_000
"""Publishers with open gaps. Beyond it the heartbeat of an unknown publisher opens none."""

ACK_REQUESTS: Final = 1000
"""Pending acknowledgement requests: a publisher has one per key. Beyond it the oldest gets no answer."""

LOGGED_KEYS: Final = 100
"""Keys with a logged warning about invalid messages. Those of further keys are only counted."""

BUFFERED_MESSAGES: Final = 1024
"""Unread messages that keep Zenoh's receive buffer, which saves a copy. Later ones are copied."""

ENCODING_TEXT: Final = 512
"""Characters kept of an encoding: nedbus's own have at most 250. A longer one is cut, and names no message."""

DEFINITION_FIELDS: Final = 65_536
"""Fields of all definitions from publishers: PX4's messages have 15 on average. Beyond it unused ones are evicted."""

LAYOUT_FIELDS: Final = 256
"""Fields of one definition from a publisher. A longer one is ignored."""

REPLY_LAYOUTS: Final = 32
"""Layouts in one reply of a publisher: five exist. Further ones are ignored."""

UNKNOWN_DEFINITIONS: Final = 64
"""Definitions per query. As many more may wait for the next one; then the message is invalid."""

FAILED_DEFINITIONS: Final = 1024
"""Definitions with a failed query, which is repeated with a backoff. Beyond it the oldest backoff is discarded."""

REQUESTS: Final = 64
"""Retransmission requests in flight for one subscription. Further ones wait."""

HISTORY_REQUESTS: Final = 16
"""Requests in flight to publishers that have delivered no message yet. Further ones wait."""

REQUESTS_OF_KEY: Final = 4
"""Requests in flight on one key, whose publishers may never answer. Further ones wait."""

UNREAD_REPORTS: Final = 250
"""Unread rejection reports, which the routers limit to 16 kB each. Beyond it the oldest are dropped."""

REPORT_BYTES: Final = 2**16
"""Bytes of a rejection report from a peer. A longer one is ignored."""

REPLY_MEMORY: Final = 2**28
"""Bytes of all parsed replies, estimated: parsed JSON takes up to 32 times its length. Further replies are ignored."""

LINK_CHANGES: Final = 64
"""Changes of a link between two polls of 0.1 s. Beyond it the oldest are dropped."""

MEASURED_LATENCIES: Final = 1000
"""Latencies measured per second and stream, to bound the cost. Further messages are only counted."""

# --- Publishers ---

GROUP_MESSAGES: Final = 64
"""Messages that a lossless publisher hands to Zenoh together, at full speed. Then the next group begins."""

UNUSED_DEFINITIONS: Final = 64
"""Definitions kept after their publisher closed, for readers with unread messages. Beyond it the oldest goes."""

KNOWN_VEHICLES: Final = 10_000
"""Vehicles whose permission is remembered. Beyond it the oldest is asked for again."""

QUEUED_QUERIES: Final = 1000
"""Queued queries per key expression. Beyond it the oldest get no answer."""

# --- Zenoh ---

REPLIES: Final = 10_000
"""Replies, or tokens, accepted per query: well-behaved peers send fewer. Further ones are ignored and reported."""

QUERY_BYTES: Final = 2**26
"""Payload and key bytes accepted per query, so that no peer exhausts the memory. Further replies are ignored."""

REPLY_BYTES: Final = 2**18
"""Bytes of the payload of one reply. Services split longer ones, clients reject them."""

KEY_TEXT: Final = 1024
"""Characters of a heartbeat's key or a key of ROS 2: twice the longest ones. Longer keys are ignored."""

HEARTBEATS: Final = 4096
"""Heartbeats in the channel, each of which may keep a receive buffer of 4 kB. Beyond it the oldest is dropped."""

ROUTER_STATE_BYTES: Final = 2**20
"""Bytes of the state of a router, which then has about 5,700 sessions. A longer reply is ignored."""

ROUTERS: Final = 1000
"""Routers in an answer: any peer may claim to be one. Further ones are ignored."""

LISTED_TOKENS: Final = 131_072
"""Replies that wait in Zenoh, which holds its session lock while it waits for a free slot. Further ones wait there."""

TOKEN_CHANGES: Final = 16_384
"""Queued changes of tokens, more than the tokens stored. Beyond it the oldest is dropped, and all are listed again."""

TOKENS_OF_VEHICLE: Final = 1000
"""Tokens of one vehicle: two services with all topics of a PX4 declare 500. A vehicle with more is not listed."""

EXCLUDING_KEY_EXPRS: Final = 5000
"""Key expressions that exclude vehicles, 64 per character of a name. Further vehicles are not excluded."""

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

UNREADABLE_TOPICS: Final = 100
"""Unsupported messages, and silent topics, in one report of a source. The rest is left out."""

# --- MAVLink ---

MAVLINK_VEHICLES: Final = 100
"""Vehicles per link, because a stranger could send with many ids. Messages of further ones are rejected."""

MAVLINK_TEXTS: Final = 256
"""STATUSTEXT messages of a vehicle that wait, and those of the last 10 s among which copies are searched. \
Beyond it the oldest are dropped, or forgotten."""

MAVLINK_WAITING: Final = 16_384
"""Received messages of all vehicles that wait for the source. Beyond it the oldest of the longest queue is dropped."""

WAITING_REJECTIONS: Final = 1000
"""Different rejections that wait for the source. Further ones count as one of "further places"."""

MAVLINK_UNSENT: Final = 4096
"""Bytes that a TCP or serial link may queue; more would be too old when they arrive. A frame beyond it is not sent."""

TIMESYNC_REQUESTS: Final = 10
"""TIMESYNC requests that may be unanswered. Beyond it the oldest is forgotten, and its answer ignored."""

LOG_STREAM_PENDING: Final = 2**22
"""Bytes of a ULog stream before its first message, 68,000 to 170,000 in real ones: they wait for its file, and are \
kept in its state file. Beyond it neither is written."""

DAMAGE_REASONS: Final = 100
"""Different reasons for damaged records of a ULog stream that are kept. Further ones count as "further damage"."""

SAME_NAMES: Final = 100
"""Files of ULog streams with the same name, told apart by a number. Beyond it no file is written."""

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

ALIGNED_ROWS: Final = 10_000_000
"""Rows of `align` at a given rate, as a damaged timestamp must not exhaust memory. More raise ArgumentError."""

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

LATEST_TIME: Final = 2**62
"""Time in a file [us]; a damaged one may be larger than 64 bits with a sign. A later time counts as this one."""

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

LINE_TEXT: Final = 1000
"""Characters of a line of an error, a log or a report, parts of which peers write. A longer line is cut."""

LIST_TEXT: Final = 2000
"""Characters of a list of vehicles or topics that `nedbus info` prints. A longer list is cut."""

CELL_TEXT: Final = 120
"""Characters of a peer's value in a table, which must stay readable. A longer value is cut."""

TABLE_ROWS: Final = 200
"""Rows of a table, and services in `nedbus info`, as any peer may claim to be one. The others are counted."""

LIVE_ROWS: Final = 50
"""Rows of a table that is printed each second, to stay readable. The others are counted."""

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
