"""UTC offset from the UTC that messages provide: corrections in flight, drifts, mixtures and foreign clocks."""

from collections import defaultdict
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from nedbus_msgs import DEFAULT_TOPIC, is_unix_time

from .utc_offset import FIELDS, RELATIVE, UtcOffset

_TOLERANCE: Final = 1_000_000  # us; messages this close to the median agree
# fraction that must agree; a smaller one indicates several boots or a clock step
_AGREEING: Final = 0.9
_TAIL: Final = 0.1  # share of the messages that determines the offset after a correction
_MIN_PART: Final = 3  # messages after the last correction
_MAX_PARTS: Final = 3  # offsets until the last correction; more are a drift
_MAX_CORRECTION: Final = 20e6  # us, more than all leap seconds; a larger step may be another boot
# us between the messages of a source and all others, if both use the same clock
_APART: Final = 1e6
_MAX_TIME: Final = 2**62  # us; a damaged timestamp may be larger

_Ints = npt.NDArray[np.int64]


class UtcEstimate:
    """Estimate of the offset of one vehicle from its messages; it keeps up to 24 bytes of each message."""

    def __init__(self) -> None:
        self._stamps = defaultdict[tuple[bool, str], list[_Ints]](list)
        """Timestamps of each stream [us], of those with UTC first."""
        self._sources = defaultdict[tuple[int, str], list[_Ints]](list)
        """Timestamps and offsets of the messages with UTC [us], by the index of the field in FIELDS and stream."""

    def add(self, stream: str, columns: Mapping[str, Any]) -> None:
        """Add messages by the UTC_COLUMNS that their source provides; only `timestamp` is required."""
        known = [name for name in FIELDS if name in columns]
        stamps = _to_ints(columns["timestamp"])
        self._stamps[not known, stream].append(stamps)
        for name in known:
            values = _to_ints(columns[name])
            utc = stamps - values if name == FIELDS[1] else values - columns.get(RELATIVE, 0)
            is_used = is_unix_time(utc) & ~is_unix_time(stamps)
            if is_used.any():
                self._sources[FIELDS.index(name), stream].append(
                    np.stack([stamps, utc - stamps])[:, is_used]
                )

    def result(self, boot_utc: int = 0) -> UtcOffset | str:
        """Return the offset, or why it is unknown, "" without UTC; `boot_utc`: of the file's metadata [us]."""
        stamps = {key: np.concatenate(parts) for key, parts in sorted(self._stamps.items())}
        found = {stream: times for (is_other, stream), times in stamps.items() if is_other}
        with_utc = [times for (is_other, _), times in stamps.items() if not is_other]
        others = [found[DEFAULT_TOPIC]] if DEFAULT_TOPIC in found else [*found.values()]
        used = np.concatenate([np.zeros(0), *with_utc, *(others if with_utc else found.values())])
        if (unix := int(np.sum(is_unix_time(used)))) > len(used) / 2:
            return UtcOffset("timestamp", 0, unix, 0)
        period, reasons = _period(np.concatenate([np.zeros(0), *others])), list[str]()
        for (_, stream), parts in sorted(self._sources.items()):
            times, offsets = np.concatenate(parts, axis=1)
            agreement = _find_agreement(stream, times, offsets, period)
            if not isinstance(agreement, str):
                return agreement
            reasons.append(agreement)
        return (
            UtcOffset("boot_time_utc_us", boot_utc, 1, 0)
            if is_unix_time(boot_utc)
            else "".join(reasons[:1])
        )


def to_datetime64(unix: _Ints) -> npt.NDArray[np.datetime64]:
    """Return Unix times [us] as datetimes; NaT for other times."""
    return np.where(is_unix_time(unix), unix.astype("M8[us]"), np.datetime64("NaT", "us"))


def _find_agreement(
    stream: str, times: _Ints, offsets: _Ints, others: tuple[float, float]
) -> UtcOffset | str:
    """Return the offset on which the messages of a stream agree, or why it is unusable.

    `others`: the period of the timestamps of other streams [us].
    """
    first, last = _period(times)
    if len(offsets) > 1 and (first > others[1] + _APART or last < others[0] - _APART):
        return (
            f"the timestamps of {stream}, which has UTC, are not on the clock of the other messages"
        )
    if (parts := _stable_parts(times, offsets)) is None:
        low, high = np.quantile(offsets, [0.05, 0.95]) / 1e6
        return (
            f"the UTC of {stream} varies by {high - low:.0f} s: a drift, or several clocks or boots"
        )
    final, middle = parts[0], int(np.median(parts[0]))
    corrected = middle - int(np.median(parts[1])) if len(parts) > 1 else 0
    return UtcOffset(stream, middle, len(final), int(np.ptp(final)), corrected)


def _to_ints(values: Any) -> _Ints:
    ints: _Ints = np.minimum(values, _MAX_TIME).astype(np.int64)
    return ints


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
    return (
        parts
        if len(parts[0]) >= _MIN_PART and np.ptp([*map(np.median, parts)]) <= _MAX_CORRECTION
        else None
    )


def _is_near(offsets: Any, typical: Any) -> Any:
    """Return which offsets agree with one of the typical ones, not with the mean of two clocks."""
    return np.abs(offsets - int(np.quantile(typical, 0.5, method="lower"))) <= _TOLERANCE
