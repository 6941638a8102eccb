"""Where messages come from: `open_source` makes a source of a text such as `ulog:flight.ulg?speed=2&vehicle=7`."""

from .record import Flight, Record, Source
from .spec import SOURCE_KINDS, SourceSpec, parse_source

__all__ = ["SOURCE_KINDS", "Flight", "Record", "Source", "SourceSpec", "parse_source"]
