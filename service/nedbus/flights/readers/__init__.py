"""Readers of flight files, one per format behind one protocol, and the order and pace of their messages."""

from .formats import check_recording, find_format, format_of, open_reader
from .order import MAX_GAP, Clock, sort_by_time
from .reader import FileStream, FlightReader, ReadOptions, Record, Run
