"""Sources of messages: `parse_source` parses a string such as `ulog:flight.ulg?speed=2&vehicle=7`."""

from .kinds import SOURCE_KINDS, parse_source
from .log_header import expected_header
from .mavlink.link import DuplicateIds, Link, open_link, parse_link
from .source import (
    LinkCopies,
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
