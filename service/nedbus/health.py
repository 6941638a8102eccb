"""The newest message and health of a stream, and status types: services, publishers, vehicles, events, rejections.

Each name imports its package on first use: types of events need no Zenoh.
"""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

if TYPE_CHECKING:
    from .client import (
        Health,
        Histogram,
        LinkCallback,
        LogStreamStatus,
        Monitor,
        NewestMessage,
        PositionStatus,
        Publishers,
        RejectionReport,
        Rejections,
        ServiceStatus,
        SourceStatus,
        StreamHealth,
        StreamState,
        StreamStatus,
        Vehicles,
        describe_stream,
        find_services,
        health_of_last,
        stream_state,
    )
    from .event_history import EventHistory
    from .fusion import Fusion, QuantityFusion
    from .monitoring import LiveEvents
    from .transport import RouterState, WriteVerdict, probe_writes, query_routers
    from .vehicle_events import (
        SEVERITIES,
        AccountReport,
        Condition,
        Event,
        Span,
        Story,
        Times,
        VehicleReport,
        Verdict,
    )
else:
    _NAMES = {
        "client": "Health Histogram LinkCallback LogStreamStatus Monitor NewestMessage PositionStatus Publishers"
        " RejectionReport Rejections ServiceStatus SourceStatus StreamHealth StreamState StreamStatus Vehicles"
        " describe_stream find_services health_of_last stream_state",
        "vehicle_events": "SEVERITIES AccountReport Condition Event Span Story Times VehicleReport Verdict",
        "event_history": "EventHistory",
        "fusion": "Fusion QuantityFusion",
        "monitoring": "LiveEvents",
        "transport": "RouterState WriteVerdict probe_writes query_routers",
    }
    __getattr__ = lazy_exports(
        "nedbus", {name: ("", module) for module, names in _NAMES.items() for name in names.split()}
    )

__all__ = [
    "SEVERITIES", "AccountReport", "Condition", "Event", "EventHistory", "Fusion", "Health", "Histogram",
    "LinkCallback", "LiveEvents", "LogStreamStatus", "Monitor", "NewestMessage", "PositionStatus", "Publishers",
    "QuantityFusion", "RejectionReport", "Rejections", "RouterState", "ServiceStatus", "SourceStatus", "Span", "Story",
    "StreamHealth", "StreamState", "StreamStatus", "Times", "VehicleReport", "Vehicles", "Verdict", "WriteVerdict",
    "describe_stream", "find_services", "health_of_last", "probe_writes", "query_routers", "stream_state",
]  # fmt: skip
