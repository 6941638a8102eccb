"""Sources of messages: `parse_source` reads a text such as `ulog:flight.ulg?speed=2&vehicle=7`."""

from .mavlink_link import Link, check_link, open_link
from .source import Absence, LiveSource, Rejection, ReplayRun, ReplaySource, Source, SourceContext, SourceMessage
from .spec import SOURCE_KINDS, SourceKind, SourceSpec, parse_source, source_text_of_file

__all__ = [
    "SOURCE_KINDS",
    "Absence",
    "Link",
    "LiveSource",
    "Rejection",
    "ReplayRun",
    "ReplaySource",
    "Source",
    "SourceContext",
    "SourceKind",
    "SourceMessage",
    "SourceSpec",
    "check_link",
    "open_link",
    "parse_source",
    "source_text_of_file",
]
