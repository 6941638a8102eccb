"""Sources of messages: `parse_source` reads a text such as `ulog:flight.ulg?speed=2&vehicle=7`."""

from .conversion import convert
from .file_events import KEPT_OF_FILE, FileEvents, Flights, follow, read_events
from .kinds import SOURCE_KINDS, SourceKind, SourceSpec, parse_source, source_text_of_file
from .mavlink.link import Link, Senders, open_link, parse_link, why_ignored
from .source import Absence, LiveSource, Rejection, ReplayRun, ReplaySource, Source, SourceMessage
