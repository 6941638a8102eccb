"""Sources of messages: `parse_source` reads a text such as `ulog:flight.ulg?speed=2&vehicle=7`."""

from .source import LiveSource, Rejection, ReplayRun, ReplaySource, Source, SourceContext, SourceMessage
from .spec import SOURCE_KINDS, SourceKind, SourceSpec, parse_source, source_text_of_file

__all__ = [
    "SOURCE_KINDS",
    "LiveSource",
    "Rejection",
    "ReplayRun",
    "ReplaySource",
    "Source",
    "SourceContext",
    "SourceKind",
    "SourceMessage",
    "SourceSpec",
    "parse_source",
    "source_text_of_file",
]
