"""Sources of messages: `parse_source` parses a string such as `ulog:flight.ulg?speed=2&vehicle=7`."""

from .conversion import convert
from .file_events import MAX_FILE_EVENTS, FileEvents, Flights, follow, read_file_events
from .kinds import SOURCE_KINDS, parse_source, source_text_of_file
from .log_header import expected_header
from .mavlink.link import DuplicateIds, Link, ignore_reason, open_link, parse_link
from .source import (
    LinkLoad,
    LiveItem,
    LiveSource,
    Rejection,
    ReplayRun,
    ReplaySource,
    Source,
    SourceMessage,
    UnavailableTopics,
)
