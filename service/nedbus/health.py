"""Stream health, and the status types that a bus returns: services, publishers, vehicles, events, rejections."""

from .client import (
    Health,
    Histogram,
    LogStreamStatus,
    Monitor,
    Publishers,
    RejectionReport,
    Rejections,
    ServiceStatus,
    SourceStatus,
    StreamHealth,
    StreamStatus,
    Vehicles,
)
from .events import AccountReport, Condition, Event, VehicleReport

__all__ = [
    "AccountReport", "Condition", "Event", "Health", "Histogram", "LogStreamStatus", "Monitor", "Publishers",
    "RejectionReport", "Rejections", "ServiceStatus", "SourceStatus", "StreamHealth", "StreamStatus", "VehicleReport",
    "Vehicles",
]  # fmt: skip
