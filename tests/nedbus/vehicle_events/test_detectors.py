"""Detection of changes in a stream."""

from __future__ import annotations

from collections.abc import Iterator

from nedbus.vehicle_events.detectors import ChangeDetector, Fields, Finding


def test_detection_runs_only_when_a_compared_field_or_missing_changes() -> None:
    """Detection receives the fields before and after a change; a change of its context or of the time is ignored."""
    calls: list[tuple[Fields, Fields]] = []

    def detect(before: Fields, after: Fields) -> Iterator[Finding]:
        calls.append((before, after))
        return iter(())

    detector = ChangeDetector(["a"], ["b"], detect)
    for time, (a, b, missing) in enumerate(
        [(1, 2, ""), (1, 3, ""), (4, 3, ""), (4, 3, "a"), (4, 5, "a")]
    ):
        detector.add({"timestamp": time, "a": a, "b": b}, frozenset(missing))
    first, second = {"timestamp": 0, "a": 1, "b": 2}, {"timestamp": 2, "a": 4, "b": 3}
    unknown = {"timestamp": 3, "a": None, "b": 3}
    assert calls == [({}, first), ({"timestamp": 1, "a": 1, "b": 3}, second), (second, unknown)]
