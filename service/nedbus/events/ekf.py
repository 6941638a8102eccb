"""Detectors of several EKFs: which one is in use, and faults of the others."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Final, TypeGuard, cast

from .detectors import ChangeDetector, FieldReader, Fields, Finding, detect_aiding, detect_flags
from .kinds import flagged
from .rules import FAKE_AIDING

_KINDS: Final = flagged("EstimatorStatusFlags")
_FAULTS: Final = [kind for kind in _KINDS if kind.name != "not_fused"]

EKF_SELECTOR: Final = "estimator_selector_status"
"""The topic that names the EKF in use."""

HEALTHY: Final[Fields] = {flag: not kind.bad for kind in _FAULTS for flag in kind.flags}
"""The flags of an EKF without a fault."""

_MAX_EKFS: Final = 9  # instances; 255 stands for none


def selection_detector() -> ChangeDetector:
    """Return a detector of the EKF that an estimator_selector_status names."""
    return ChangeDetector(["primary_instance"], _detect_selection)


def flags_detector(instance: int, used: Callable[[], int]) -> ChangeDetector:
    """Return a detector of the flags of an EKF; `used` returns the instance in use."""

    def detect(before: Fields, after: Fields) -> Iterator[Finding]:
        if instance == used():
            yield from detect_flags(_KINDS, before, after)
            yield from detect_aiding(before, after)
        else:
            yield from _detect_unused(instance, before, after)

    return ChangeDetector([*(flag for kind in _KINDS for flag in kind.flags), *FAKE_AIDING], detect)


class EstimateDetector(ChangeDetector):
    """Detector of an estimator_local_position, to find the EKF in use where no selector names it.

    `position` returns the detector of vehicle_local_position, which follows the estimate that it equals.
    `equal`: by instance, if the last estimate of the same sample equalled it; shared by all instances.
    `used` returns the instance in use.
    """

    def __init__(
        self, instance: int, position: Callable[[], ChangeDetector | None], equal: dict[int, bool],
        used: Callable[[], int],
    ) -> None:  # fmt: skip
        self._read_estimate = FieldReader(("timestamp", "timestamp_sample", "x", "y", "z"))
        self._instance, self._position, self._equal, self._used = instance, position, equal, used
        self._estimate: tuple[object, ...] = (0, None)
        self.stamp = self.earlier = 0

    def add(self, message: object, missing: frozenset[str]) -> Iterator[Finding] | None:
        """Return a finding if this EKF is in use, and the one that was taken to be is not."""
        (_, *estimate), self._estimate = self._estimate, self._read_estimate(message)
        self.earlier, self.stamp = self.stamp, cast("int", self._estimate[0])
        position = self._position()
        vehicle = self._estimate if position is None else self._read_estimate(position.last)
        if estimate[0] == vehicle[1]:
            self._equal[self._instance] = estimate[1:] == [*vehicle[2:]]
        if not self._equal.get(self._instance) or self._equal.get(self._used(), True):
            return None
        return iter([_selected(self._instance, None)])

    def reset(self) -> None:
        """Discard the state after a reboot of the vehicle."""
        self._estimate = (0, None)
        self.stamp = self.earlier = 0


def _detect_selection(before: Fields, after: Fields) -> Iterator[Finding]:
    was, now = (each.get("primary_instance") for each in (before, after))
    if _is_ekf(now):
        yield _selected(now, was if _is_ekf(was) else None)


def _is_ekf(instance: object) -> TypeGuard[int]:
    return type(instance) is int and instance in range(_MAX_EKFS)


def _selected(now: int, was: int | None) -> Finding:
    """Return the finding of an EKF that is in use now, which is no event if the one before is unknown."""
    numbers = {"to": now} if was is None else {"from": was, "to": now}
    text = f"EKF {now} in use, was EKF {was}"
    return Finding("ekf_changed", "once", text, numbers=numbers, initial=was is None)


def _detect_unused(instance: int, before: Fields, after: Fields) -> Iterator[Finding]:
    for each in detect_flags(_FAULTS, before, after):
        names = tuple(f"{instance}:{name}" for name in each.names)
        text = f"EKF {instance}, not in use: {each.text.removeprefix('EKF ')}"
        yield replace(each, kind="other_ekf", severity=None, text=text, names=names)
