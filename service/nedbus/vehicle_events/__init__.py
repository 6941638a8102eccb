"""Vehicle events and their possible causes, derived from live or recorded messages; no I/O."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

from .event import ALL, WINDOW, Condition, Event, State
from .event_log import EventLog
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
from .vehicle import EVENT_TOPICS

if TYPE_CHECKING:
    from .faults import VALID, Expectation, faults_of
    from .story import (
        Span,
        Story,
        events_outside,
        is_alarm,
        spans_of,
        state_at,
        stories_of,
        story_of,
    )
    from .times import Times
    from .verdict import Verdict, verdict_of
else:  # lazy: a service records events, and its readers explain them
    _NAMES = {
        "faults": "VALID Expectation faults_of",
        "story": "Span Story events_outside is_alarm spans_of state_at stories_of story_of",
        "times": "Times",
        "verdict": "Verdict verdict_of",
    }
    __getattr__ = lazy_exports(
        __name__, {name: ("", module) for module, names in _NAMES.items() for name in names.split()}
    )

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
