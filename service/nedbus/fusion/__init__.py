"""Fusion: whether PX4's EKF2 uses a position that was sent into the vehicle, and why not; from messages, no I/O."""

from .causes import Cause
from .changes import fusion_changes
from .evidence import AID_TOPICS, FUSION_TOPICS, QUANTITIES, VISION_TOPICS, FusionTracker
from .report import Fusion, QuantityFusion

__all__ = [
    "AID_TOPICS",
    "FUSION_TOPICS",
    "QUANTITIES",
    "VISION_TOPICS",
    "Cause",
    "Fusion",
    "FusionTracker",
    "QuantityFusion",
    "fusion_changes",
]
