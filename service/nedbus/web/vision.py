"""VisionWatch: whether vehicles use the external position that is sent into them, for the page; no I/O."""

import threading
from collections.abc import Mapping, Set
from typing import Any, Final

from nedbus import Sample
from nedbus.fusion import FUSION_TOPICS, VISION_TOPICS, FusionTracker
from nedbus.health import Fusion, PositionStatus

_TOPICS: Final = frozenset(FUSION_TOPICS)
_VISION: Final = frozenset(VISION_TOPICS)


class VisionWatch:
    """A FusionTracker for each vehicle with vision; one thread may add samples while another one asks for reports."""

    def __init__(self) -> None:
        self._trackers: dict[str, FusionTracker] = {}
        self._lock = threading.Lock()

    def add(self, sample: Sample[Any]) -> None:
        """Add a sample of any topic."""
        if sample.topic not in _TOPICS:
            return
        with self._lock:
            tracker = self._trackers.get(sample.vehicle)
            if tracker is None and sample.topic in _VISION:
                tracker = self._trackers[sample.vehicle] = FusionTracker()
            if tracker is not None:
                tracker.add_sample(sample)

    def reports(self, vehicles: Set[str], sent: Mapping[str, PositionStatus]) -> dict[str, Fusion]:
        """Return the report of each vehicle that receives a position or is sent one; forget all but `vehicles`.

        `sent`: what services send, by vehicle.
        """
        with self._lock:
            for gone in self._trackers.keys() - vehicles:
                del self._trackers[gone]
            reports = {}
            for vehicle in vehicles & (self._trackers.keys() | sent.keys()):
                tracker = self._trackers.get(vehicle, FusionTracker())
                reports[vehicle] = tracker.fusion(vehicle, sent.get(vehicle))
            return reports
