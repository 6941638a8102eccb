"""MCAP recordings, .ulg and .tlog logs: write and read MCAP, read .ulg, load all of them as arrays, and plot them.

Each name imports its module on first use: MCAP and plots need extras, and NumPy is slow to import.
"""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

if TYPE_CHECKING:
    from .alignment import align
    from .arrays import Flight, addresses_of, missing_of
    from .flight_files import check_recording, distinct_names, find_format, format_of, matching, open_flight
    from .mcap_reader import RecordedMessage, RecordingReader
    from .mcap_writer import RecordingWriter
    from .plot import MAX_STREAMS, draw
    from .reading import read
    from .recorder import Recorder
    from .ulog_reader import UlogReader
    from .utc import UtcOffset, find_utc, utc_of
else:
    # No submodule may share the name of an export: importing it would replace the export.
    _NAMES = {
        ("", "alignment"): "align",
        ("", "arrays"): "Flight addresses_of missing_of",
        ("", "reading"): "read",
        ("", "flight_files"): "check_recording distinct_names find_format format_of matching open_flight",
        ("", "ulog_reader"): "UlogReader",
        ("", "utc"): "UtcOffset find_utc utc_of",
        ("mcap", "mcap_reader"): "RecordedMessage RecordingReader",
        ("mcap", "recorder"): "Recorder",
        ("mcap", "mcap_writer"): "RecordingWriter",
        ("plot", "plot"): "MAX_STREAMS draw",
    }
    __getattr__ = lazy_exports(__name__, {name: place for place, names in _NAMES.items() for name in names.split()})
