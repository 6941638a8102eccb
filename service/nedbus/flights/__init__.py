"""Flights: .ulg logs, .mcap recordings and .tlog files, read by one protocol, merged, and written as MCAP; no Zenoh.

`__all__` is public: to choose streams of an open flight as `nedbus.read` does, to replay it with its events, and to
write a recording.

Each name imports its module on first use: MCAP needs an extra, and NumPy is slow to import.
"""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

if TYPE_CHECKING:
    from .conversion import Conversion, convert, convert_files, convert_flight
    from .event_replay import EventReplay, ReplayedMessage, detect_events
    from .events import (
        EVENT_OPTIONS,
        FileEvents,
        follow,
        follow_flight,
        read_file_events,
        read_flight_events,
        times_of,
    )
    from .flight import Flight, FlightSamples, open_flight, open_messages
    from .merge import no_utc, require_files
    from .readers import (
        FlightReader,
        ReadOptions,
        check_recording,
        find_format,
        format_of,
        open_reader,
    )
    from .sample_events import detect_sample_events
    from .selection import (
        absent_topics,
        matching,
        parse_topics,
        require_one_vehicle,
        single_match,
        topics_of,
    )
    from .utc import find_utc, utc_of
    from .vehicles import path_of, require_utc, utc_offset_of, vehicles_of
    from .writer import RecordingWriter
else:
    # No submodule may share the name of an export: importing it would replace the export.
    _NAMES = {
        ("", "conversion"): "Conversion convert convert_files convert_flight",
        ("", "event_replay"): "EventReplay ReplayedMessage detect_events",
        ("", "events"): "EVENT_OPTIONS FileEvents follow follow_flight read_file_events"
        " read_flight_events times_of",
        ("", "flight"): "Flight FlightSamples open_flight open_messages",
        ("", "merge"): "no_utc require_files",
        (
            "",
            "readers",
        ): "FlightReader ReadOptions check_recording find_format format_of open_reader",
        ("", "sample_events"): "detect_sample_events",
        ("", "selection"): "absent_topics matching parse_topics require_one_vehicle single_match"
        " topics_of",
        ("", "utc"): "find_utc utc_of",
        ("", "vehicles"): "path_of require_utc utc_offset_of vehicles_of",
        ("mcap", "writer"): "RecordingWriter",
    }
    __getattr__ = lazy_exports(
        __name__, {name: place for place, names in _NAMES.items() for name in names.split()}
    )

__all__ = [
    "EventReplay",
    "ReadOptions",
    "RecordingWriter",
    "ReplayedMessage",
    "check_recording",
    "detect_events",
    "matching",
    "path_of",
    "require_one_vehicle",
    "require_utc",
    "single_match",
    "utc_offset_of",
    "vehicles_of",
]
