"""UTC offset from the UTC that messages provide: corrections in flight, drifts, mixtures and foreign clocks."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from nedbus import limits
from nedbus_msgs import DEFAULT_TOPIC, is_unix_time

from .utc_offset import FIELDS, RELATIVE, UtcOffset

_TOLERANCE: Final = 1_000_000  # us; messages this close to the median agree
# fraction that must agree; a smaller one indicates several boots or a clock step
_AGREEING: Final = 0.9
_TAIL: Final = 0.1  # share of the messages that determines the offset after a correction
_CONFIRMED: Final = 3  # messages after the last correction that confirm it
_CORRECTIONS: Final = 2  # that a receiver makes in a flight; more are a drift
_CORRECTION_RANGE: Final = 20e6  # us, more than all leap seconds; a larger step may be another boot
# us between the messages of a source and all others, if both use the same clock
_APART: Final = 1e6

_Ints = npt.NDArray[np.int64]


class _Period(NamedTuple):
    """The first and the last time of messages [us]; infinite without messages, so that no other time is outside."""

    first: float = -np.inf
    last: float = np.inf


class _SourceKey(NamedTuple):
    """A stream with UTC, and the index in FIELDS of the field that provides it."""

    field: int
    stream: str


class UtcEstimate:
    """Estimate of the offset of one vehicle from its messages; it keeps up to 24 bytes of each message."""

    def __init__(self) -> None:
        self._stamps_with_utc = defaultdict[str, list[_Ints]](list)
        """Timestamps of the streams with UTC [us]."""
        self._other_stamps = defaultdict[str, list[_Ints]](list)
        """Timestamps of all other streams [us]."""
        self._sources = defaultdict[_SourceKey, list[_Ints]](list)
        """Timestamps and offsets of the messages with UTC [us], in two rows."""

    def add(self, stream: str, columns: Mapping[str, Any]) -> None:
        """Add messages by the UTC_COLUMNS that their source provides; only `timestamp` is required."""
        stamps = _to_ints(columns["timestamp"])
        names = [name for name in FIELDS if name in columns]
        if names:
            self._stamps_with_utc[stream].append(stamps)
        else:
            self._other_stamps[stream].append(stamps)
        for name in names:
            utc = _utc_of(name, columns, stamps)
            is_used = is_unix_time(utc) & ~is_unix_time(stamps)
            if not is_used.any():
                continue
            offsets = utc - stamps
            rows = np.stack([stamps, offsets])
            key = _SourceKey(FIELDS.index(name), stream)
            self._sources[key].append(rows[:, is_used])

    def result(self, boot_utc: int = 0) -> UtcOffset | str:
        """Return the offset, or why it is unknown, "" without UTC; `boot_utc`: of the file's metadata [us]."""
        with_utc = _by_stream(self._stamps_with_utc)
        without_utc = _by_stream(self._other_stamps)
        others = without_utc
        if DEFAULT_TOPIC in without_utc:
            others = {DEFAULT_TOPIC: without_utc[DEFAULT_TOPIC]}
        compared = others if with_utc else without_utc
        stamps = _joined([*with_utc.values(), *compared.values()])
        is_unix = is_unix_time(stamps)
        unix = int(np.sum(is_unix))
        if unix > len(stamps) / 2:
            return UtcOffset("timestamp", 0, unix, 0)
        period = _period(_joined(others.values()))
        first_reason = ""
        for key, parts in sorted(self._sources.items()):
            times, offsets = np.concatenate(parts, axis=1)
            agreement = _find_agreement(key.stream, times, offsets, period)
            if isinstance(agreement, UtcOffset):
                return agreement
            first_reason = first_reason or agreement
        if is_unix_time(boot_utc):
            return UtcOffset("boot_time_utc_us", boot_utc, 1, 0)
        return first_reason


def to_datetime64(unix: _Ints) -> npt.NDArray[np.datetime64]:
    """Return Unix times [us] as datetimes; NaT for other times."""
    return np.where(is_unix_time(unix), unix.astype("M8[us]"), np.datetime64("NaT", "us"))


def _utc_of(name: str, columns: Mapping[str, Any], stamps: _Ints) -> Any:
    """Return the UTC that a field provides, at the timestamps of its messages [us]."""
    values = _to_ints(columns[name])
    if name == "estimated_offset":
        return stamps - values
    return values - columns.get(RELATIVE, 0)


def _by_stream(stamps: Mapping[str, list[_Ints]]) -> dict[str, _Ints]:
    return {stream: np.concatenate(parts) for stream, parts in sorted(stamps.items())}


def _joined(parts: Iterable[_Ints]) -> npt.NDArray[Any]:
    """Concatenate arrays; without any, return an empty one."""
    return np.concatenate([np.zeros(0), *parts])


def _find_agreement(stream: str, times: _Ints, offsets: _Ints, others: _Period) -> UtcOffset | str:
    """Return the offset on which the messages of a stream agree, or why it is unusable.

    `others`: the period of the timestamps of other streams [us].
    """
    own = _period(times)
    is_later = own.first > others.last + _APART
    is_earlier = own.last < others.first - _APART
    is_apart = is_later or is_earlier
    if is_apart and len(offsets) > 1:
        return (
            f"the timestamps of {stream}, which has UTC, are not on the clock of the other messages"
        )
    parts = _stable_parts(times, offsets)
    if parts is None:
        low, high = np.quantile(offsets, [0.05, 0.95]) / 1e6
        spread = f"{high - low:.0f} s"
        return f"the UTC of {stream} varies by {spread}: a drift, or several clocks or boots"
    final = parts[0]
    offset = int(np.median(final))
    corrected = 0
    if len(parts) > 1:
        corrected = offset - int(np.median(parts[1]))
    variation = int(np.ptp(final))
    return UtcOffset(stream, offset, len(final), variation, corrected)


def _to_ints(values: Any) -> _Ints:
    ints: _Ints = np.minimum(values, limits.LATEST_TIME).astype(np.int64)
    return ints


def _period(times: npt.NDArray[Any]) -> _Period:
    """Return the period of all but a few wild times since boot."""
    is_unix = np.asarray(is_unix_time(times), bool)
    since_boot = times[~is_unix]
    if not len(since_boot):
        return _Period()
    first, last = np.quantile(since_boot, [0.02, 0.98])
    return _Period(first, last)


def _stable_parts(times: Any, offsets: Any) -> list[Any] | None:
    """Return the agreeing offsets after the last correction, then those before it; None for a drift or a mixture."""
    near = offsets[_is_near(offsets, offsets)]
    if len(near) >= _AGREEING * len(offsets):
        return [near]
    # without single wild values
    smooth = np.median([times[:-2], times[1:-1], times[2:]], axis=0)
    is_back = np.diff(smooth) < -_TOLERANCE
    if is_back.any():  # several boots
        return None
    few = (1 - _AGREEING) * len(offsets)
    parts = list[Any]()
    while len(offsets) > few:
        begin = _last_correction(offsets)
        part = offsets[begin:]
        is_late = _is_near(part, _tail(offsets))
        if len(parts) > _CORRECTIONS or is_late.mean() < _AGREEING:
            return None
        parts.append(part[is_late])
        offsets = offsets[:begin]
    if len(parts[0]) < _CONFIRMED:
        return None
    typical = [np.median(part) for part in parts]
    if np.ptp(typical) > _CORRECTION_RANGE:
        return None
    return parts


def _last_correction(offsets: Any) -> int:
    """Return the index from which on offsets agree with the last ones, apart from a few."""
    is_late = _is_near(offsets, _tail(offsets))
    # the sum of +1 for another offset, and -1 for one of the last, is greatest where the last ones begin
    steps = np.where(is_late, -1, 1)
    balance = np.append(0, np.cumsum(steps))
    return int(np.argmax(balance))


def _tail(offsets: Any) -> Any:
    count = max(1, int(_TAIL * len(offsets)))
    return offsets[-count:]


def _is_near(offsets: Any, typical: Any) -> Any:
    """Return which offsets agree with one of the typical ones, not with the mean of two clocks."""
    median = int(np.quantile(typical, 0.5, method="lower"))
    return np.abs(offsets - median) <= _TOLERANCE
