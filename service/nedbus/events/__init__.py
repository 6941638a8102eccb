"""Events of vehicles from their messages, live or of a file, and the answer to why; no I/O.

A new kind of event is a row of KINDS in `event.py`, its flags or thresholds in `rules.py`, and a finding of a detector
in `detectors.py` or `position.py`.
"""

from .account import KEPT, Account
from .event import ALL, KINDS, SEVERITIES, WINDOW, Condition, Event, Severity, State
from .faults import VALID, Expectation, faults_of, merge_vehicles
from .report import FORGOTTEN, QUESTION, AccountReport, VehicleReport, by_vehicle, from_json, report_of
from .rules import FIXES, MODES, RECENT
from .story import Span, Story, about, spans_of, state_at, tell
from .times import Times, since_text, to_age, to_clock
from .vehicle import Vehicle

__all__ = [
    "ALL",
    "FIXES",
    "FORGOTTEN",
    "KEPT",
    "KINDS",
    "MODES",
    "QUESTION",
    "RECENT",
    "SEVERITIES",
    "VALID",
    "WINDOW",
    "Account",
    "AccountReport",
    "Condition",
    "Event",
    "Expectation",
    "Severity",
    "Span",
    "State",
    "Story",
    "Times",
    "Vehicle",
    "VehicleReport",
    "about",
    "by_vehicle",
    "faults_of",
    "from_json",
    "merge_vehicles",
    "report_of",
    "since_text",
    "spans_of",
    "state_at",
    "tell",
    "to_age",
    "to_clock",
]
