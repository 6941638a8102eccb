"""Vehicle events and their possible causes, derived from live or recorded messages; no I/O."""

from .event import ALL, WINDOW, Condition, Event, State
from .event_log import EventLog
from .faults import VALID, Expectation, faults_of
from .kinds import KINDS, SEVERITIES, Kind, Severity, rank_vehicle
from .report import (
    ACCOUNT_PARAMETER,
    AccountReport,
    VehicleReport,
    by_vehicle,
    from_json,
    joined,
    once_per_service,
    report_of,
)
from .rules import FIXES, MODES, RECENT
from .story import Span, Story, events_outside, is_alarm, spans_of, state_at, stories_of, story_of
from .times import Times
from .vehicle import EVENT_TOPICS
from .verdict import Verdict, verdict_of

# The types of events, conditions, stories and reports are in `nedbus.health`; all other names are for nedbus itself.
__all__ = [
    "ALL",
    "EVENT_TOPICS",
    "FIXES",
    "KINDS",
    "MODES",
    "RECENT",
    "VALID",
    "EventLog",
    "Expectation",
    "Kind",
    "Severity",
    "State",
    "by_vehicle",
    "events_outside",
    "faults_of",
    "once_per_service",
    "rank_vehicle",
    "report_of",
    "spans_of",
    "state_at",
    "stories_of",
    "story_of",
    "verdict_of",
]
