"""UTC offset from the UTC that messages provide: corrections in flight, drifts, mixtures and foreign clocks."""

from collections.abc import Iterable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from nedbus_msgs import is_unix_time

_TOLERANCE: Final = 1_000_000  # us; messages this close to the median agree
_AGREEING: Final = 0.9  # fraction that must agree; a smaller one indicates several boots or a clock step
_TAIL: Final = 0.1  # share of the messages that determines the offset after a correction
_MIN_PART: Final = 3  # messages after the last correction
_MAX_PARTS: Final = 3  # offsets until the last correction; more are a drift
_MAX_CORRECTION: Final = 20e6  # us, more than all leap seconds; a larger step may be another boot
_APART: Final = 1e6  # us between the messages of a source and all others, if both use the same clock


class Agreement(NamedTuple):
    """The offset on which the messages of a stream agree, and by how much it was corrected before [us]."""

    stream: str
    offset: int
    messages: int
    spread: int
    corrected: int


def find_agreement(
    sources: Mapping[str, tuple[Iterable[int], Iterable[int]]], others: Iterable[Iterable[int]]
) -> Agreement | str:
    """Return the offset of the first source that is usable, or why none is, "" without sources.

    `sources`: of each stream the timestamps and their offsets to UTC; `others`: the timestamps of other streams [us].
    """
    period, reasons = _period(np.concatenate([np.zeros(0), *map(_to_array, others)])), list[str]()
    for stream, (stamps, differences) in sources.items():
        times, offsets = _to_array(stamps), _to_array(differences)
        first, last = _period(times)
        if len(offsets) > 1 and (first > period[1] + _APART or last < period[0] - _APART):
            reasons.append(f"the timestamps of {stream}, which has UTC, are not on the clock of the other messages")
        elif (parts := _stable_parts(times, offsets)) is None:
            low, high = np.quantile(offsets, [0.05, 0.95]) / 1e6
            reasons.append(f"the UTC of {stream} varies by {high - low:.0f} s: a drift, or several clocks or boots")
        else:
            final, middle = parts[0], int(np.median(parts[0]))
            corrected = middle - int(np.median(parts[1])) if len(parts) > 1 else 0
            return Agreement(stream, middle, len(final), int(np.ptp(final)), corrected)
    return reasons[0] if reasons else ""


def _to_array(values: Iterable[int]) -> Any:
    return np.array(values, np.int64)


def _period(times: Any) -> tuple[float, float]:
    """Return the period of all but a few wild times since boot."""
    times = times[~np.asarray(is_unix_time(times), bool)]
    return tuple(np.quantile(times, [0.02, 0.98])) if len(times) else (-np.inf, np.inf)


def _stable_parts(times: Any, offsets: Any) -> list[Any] | None:
    """Return the agreeing offsets after the last correction and those before it; None for a drift or a mixture."""
    near = offsets[_is_near(offsets, offsets)]
    if len(near) >= _AGREEING * len(offsets):
        return [near]
    medians = np.median([times[:-2], times[1:-1], times[2:]], axis=0)  # without single wild values
    if (np.diff(medians) < -_TOLERANCE).any():
        return None  # several boots
    parts, few = list[Any](), (1 - _AGREEING) * len(offsets)
    while len(offsets) > few:
        is_late = _is_near(offsets, offsets[-max(1, int(_TAIL * len(offsets))) :])
        begin = int(np.argmax(np.append(0, np.cumsum(np.where(is_late, -1, 1)))))
        if len(parts) == _MAX_PARTS or is_late[begin:].mean() < _AGREEING:
            return None
        parts.append(offsets[begin:][is_late[begin:]])
        offsets = offsets[:begin]
    return parts if len(parts[0]) >= _MIN_PART and np.ptp([*map(np.median, parts)]) <= _MAX_CORRECTION else None


def _is_near(offsets: Any, typical: Any) -> Any:
    """Return which offsets agree with one of the typical ones, not with the mean of two clocks."""
    return np.abs(offsets - int(np.quantile(typical, 0.5, method="lower"))) <= _TOLERANCE
