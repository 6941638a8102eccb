"""The newest message and health of a stream, and status types: services, publishers, vehicles, events, rejections."""

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
    StreamStatus,
    Vehicles,
)
from .fusion import Fusion, QuantityFusion
from .vehicle_events import AccountReport, Condition, Event, VehicleReport

__all__ = [
    "AccountReport", "Condition", "Event", "Fusion", "Health", "Histogram", "LinkCallback", "LogStreamStatus",
    "Monitor", "NewestMessage", "PositionStatus", "Publishers", "QuantityFusion", "RejectionReport", "Rejections",
    "ServiceStatus", "SourceStatus", "StreamHealth", "StreamStatus", "VehicleReport", "Vehicles",
]  # fmt: skip
