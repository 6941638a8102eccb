"""Readers of flight files, one per format behind one protocol."""

from .formats import check_recording, find_format, format_of, open_reader
from .reader import FileStream, FlightReader, ReadOptions, Record, Run
