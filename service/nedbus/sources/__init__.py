"""Where messages come from: `open_source` makes a source of a text such as `ulog:flight.ulg?speed=2&vehicle=7`."""

from .record import Flight, Home, Live, Record, Refusal, Replay, Source
from .spec import SOURCE_KINDS, SourceSpec, parse_source

__all__ = [
    "SOURCE_KINDS",
    "Flight",
    "Home",
    "Live",
    "Record",
    "Refusal",
    "Replay",
    "Source",
    "SourceSpec",
    "parse_source",
]
