"""Fusion: whether PX4's EKF2 uses a position that was sent into the vehicle, and why not; from messages, no I/O."""

from .causes import EV_BITS, Cause
from .evidence import FUSION_TOPICS, QUANTITIES, FusionTracker
from .report import Fusion, QuantityFusion

__all__ = ["EV_BITS", "FUSION_TOPICS", "QUANTITIES", "Cause", "Fusion", "FusionTracker", "QuantityFusion"]
