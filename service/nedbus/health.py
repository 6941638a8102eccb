"""Health of streams, and what a bus returns about services, publishers, vehicles, events and rejected messages."""

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
