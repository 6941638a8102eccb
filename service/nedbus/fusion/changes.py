"""Changes of the fusion of vehicles, from samples of a file or of the bus."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from nedbus.samples import PositionStatus, Sample

from .evidence import FUSION_TOPICS, FusionTracker
from .report import Fusion

_TOPICS: Final = frozenset(FUSION_TOPICS)
_SETTLED: Final = 0.3  # s for which a change must last ...
_UNDECIDED: Final = 1.0  # s ... while a quantity is unknown, as when vision begins


@dataclass(slots=True)
class _Vehicle:
    """The tracker of a vehicle, what was reported last, and what has changed since [s since boot]."""

    tracker: FusionTracker = field(default_factory=FusionTracker)
    reported: object = None
    changed: object = None
    since: float = 0.0


def fusion_changes(
    samples: Iterable[Sample[Any]], sent: Mapping[str, PositionStatus] | None = None
) -> Iterator[tuple[float, Fusion]]:
    """Yield time since boot [s] and report of a vehicle whenever the use of its external position changes.

    `samples`: of any topics and vehicles, in order. `sent`: what services send, by vehicle; may be updated meanwhile.
    """
    vehicles: dict[str, _Vehicle] = {}
    for sample in samples:
        if sample.topic not in _TOPICS:
            continue
        vehicle = vehicles.setdefault(sample.vehicle, _Vehicle())
        if not vehicle.tracker.add_sample(sample):
            continue
        if sent is None:
            own = None
        else:
            own = sent.get(sample.vehicle)
        report = vehicle.tracker.fusion(sample.vehicle, own)
        quantities = [(quantity.state, quantity.cause) for quantity in report.quantities]
        state = (quantities, report.remarks, report.missing)
        now = vehicle.tracker.now / 1e6
        if state != vehicle.changed:
            vehicle.changed = state
            vehicle.since = now
        is_open = any(quantity.state == "unknown" for quantity in report.quantities)
        needed = _UNDECIDED if is_open else _SETTLED
        if state != vehicle.reported and now - vehicle.since >= needed:
            vehicle.reported = state
            yield now, report
