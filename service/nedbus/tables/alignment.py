"""Time alignment of several streams into one table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, Literal, TypedDict, Unpack, overload

import numpy as np
import numpy.typing as npt

from nedbus import UtcOffset, utc_of
from nedbus.errors import AddressError, ArgumentError, ConfigError
from nedbus.flights import utc_offset_of
from nedbus.timeline import to_datetime64
from nedbus_msgs import ANY, BY_TOPIC, DEFAULT_TOPIC, UnitQuaternion
from nedbus_msgs.arrays import MessageArray, derive_column
from nedbus_msgs.frames import DERIVED, derived_from

from .arrays import (
    Library,
    Pandas,
    Polars,
    Streams,
    missing_of,
    recording_start,
    to_dataframe,
)
from .reading import FlightPath, ReadStreams, read_streams

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl

_METHODS: Final = ("last", "nearest", "linear")
_PERIODS: Final = {"[rad]": 2 * np.pi, "[deg]": 360.0}  # period of an angle, by unit
_MAX_ROWS: Final = 10_000_000  # rows at a given rate; a damaged timestamp must not exhaust memory
# us; a first message that is older when recording starts was sent before the start
_STALE: Final = 1_000_000
# fraction of messages that may be out of order; a larger one indicates several boots
_STRAY: Final = 0.01
_PARALLEL: Final = 1 - 1e-9  # cosine above which two quaternions count as equal

_Floats = npt.NDArray[np.float64]
_Ints = npt.NDArray[np.int64]
_Flights = FlightPath | Sequence[FlightPath] | Mapping[str, MessageArray]


class _AlignOptions(TypedDict, total=False):
    topics: Sequence[str] | None
    fields: Sequence[str] | None
    on: str | float | Sequence[int] | npt.NDArray[np.int64]
    method: Literal["last", "nearest", "linear"]
    vehicle: str | int
    layout: str | None
    utc: bool


@overload
def align(
    flight: _Flights, *, dataframe: None = None, **options: Unpack[_AlignOptions]
) -> MessageArray: ...
@overload
def align(
    flight: _Flights, *, dataframe: Pandas, **options: Unpack[_AlignOptions]
) -> pd.DataFrame: ...
@overload
def align(
    flight: _Flights, *, dataframe: Polars, **options: Unpack[_AlignOptions]
) -> pl.DataFrame: ...
def align(
    flight: _Flights,
    *,
    topics: Sequence[str] | None = None,
    fields: Sequence[str] | None = None,
    on: str | float | Sequence[int] | npt.NDArray[np.int64] = DEFAULT_TOPIC,
    method: Literal["last", "nearest", "linear"] = "last",
    vehicle: str | int = ANY,
    layout: str | None = None,
    utc: bool = False,
    dataframe: Library = None,
) -> Any:
    """Return several streams of one or more files, or arrays from `read`, as one table, aligned in time.

    `topics`, `layout`: as in `read`; by default all topics known to nedbus.
    `fields`: the columns in addition to `timestamp` and `utc`, such as "x" (of each stream) or "battery_status/0.age";
    also quantities of `nedbus.frames.DERIVED`, such as "height" or "roll", which are NaN while they are invalid.
    `on`: the rows of the table: the messages of a stream, a rate [Hz], or times on the clock of PX4's `timestamp` [us].
    Columns are `timestamp` [us], and for each stream `<stream>.<field>` and `<stream>.age` [s], the time since the
    message with these values. Before the first message the age is NaN, floats are NaN, and other values 0 or false.
    `dataframe`: return a data frame as `read` does, with nulls for missing values.

    `method`: "last" uses the last message at or before each row, so no value is from the future.
    "nearest" uses the message nearest in time; its age can be negative. "linear" interpolates floats between the
    messages before and after, unit quaternions by slerp and angles along the shorter arc. Other types, floats across
    a change of a reset counter, and rows after the last message keep the last value.
    Several files are aligned in UTC: `timestamp` is Unix time, a stream is `<vehicle>/<stream>`, as in `read`, and the
    rows are by default the positions of the first vehicle.
    `utc`: add a column `utc` with the UTC from `utc_of`, or NaT if it is unknown.

    Raises ArgumentError for an invalid `on`, `method` or `fields`, ConfigError if a stream spans several boots of a
    vehicle, which share no time base, and the errors of `read`.
    """
    if method not in _METHODS:
        raise ArgumentError("method", method, f"one of {', '.join(_METHODS)}")
    reference = [on] if isinstance(on, str) else []
    topics = [topics] if isinstance(topics, str) else topics
    names = [*reference, *(topics or ())]
    found: ReadStreams | None = None
    if isinstance(flight, Mapping):
        streams = _choose_streams(flight, topics, names)
    else:
        found = read_streams(
            flight, names if topics else None, vehicle=vehicle, layout=layout, utc=utc
        )
        streams = found.streams
    if isinstance(on, str):
        # not a topic known to nedbus
        if not _streams_named(on, streams) and not isinstance(flight, Mapping):
            streams |= read_streams(flight, [on], vehicle=vehicle, layout=layout).streams
        on = _first_named(on, streams)
        reference = [on]
    streams = {name: streams[name] for name in [*reference, *streams]}
    stamps = {name: _stamps(name, messages) for name, (messages, _) in streams.items()}
    times = stamps[on] if isinstance(on, str) else _times(on, stamps, _start_of(found))
    columns: dict[str, npt.NDArray[Any]] = {"timestamp": times.astype(np.uint64)}
    if utc:
        columns["utc"] = _to_utc(times, _offset_of(found, streams))
    absent: dict[str, npt.NDArray[np.bool_]] = {}
    requested = {field.rpartition(".")[2] for field in fields or ()}
    for name, (messages, lacking) in streams.items():
        rows, following, weight = _look_up(
            stamps[name], times, "own" if [name] == reference else method
        )
        values, is_absent = _pick(messages, rows), rows < 0
        if method == "linear":
            _interpolate(name, values, _pick(messages, following), weight)
        columns[f"{name}.age"] = (
            np.where(is_absent, np.nan, times - np.append(stamps[name], 0)[rows]) / 1e6
        )
        for field in messages.dtype.names or ():
            columns[f"{name}.{field}"] = values[field]
            absent[f"{name}.{field}"] = (
                np.append(lacking[field], True)[rows] if field in lacking else is_absent
            )
        for field in requested.intersection(derived_from(messages.dtype.names or ())):
            columns[f"{name}.{field}"] = derive_column(values, field)  # from interpolated values
            absent[f"{name}.{field}"] = is_absent
    columns = columns if fields is None else _choose(columns, fields)
    lacked = {
        f"{name}.{field}"
        for name, (messages, _) in streams.items()
        for field in missing_of(messages)
    }
    missing = tuple(each for each in columns if each in lacked)
    types = [(name, column.dtype, column.shape[1:]) for name, column in columns.items()]
    table = np.zeros(len(times), np.dtype(types, metadata={"missing": missing}))
    for name, column in columns.items():
        table[name] = column
    return to_dataframe(
        table, {name: mask for name, mask in absent.items() if mask.any()}, dataframe
    )


def _streams_named(name: str, streams: Streams) -> list[str]:
    return [each for each in streams if f"/{each}".endswith(f"/{name}")]


def _first_named(name: str, streams: Streams) -> str:
    """Return the stream of the first vehicle that has one of this name; raise ArgumentError if none has."""
    named = _streams_named(name, streams)
    if not named:
        expected = f"one of {', '.join(streams)}, a rate [Hz], or times [us]"
        raise ArgumentError("on", name, expected, problem="is not in this flight")
    return named[0]


def _choose_streams(
    arrays: Mapping[str, MessageArray], topics: Sequence[str] | None, names: Sequence[str]
) -> Streams:
    if unknown := [name for name in topics or () if name not in (ANY, *arrays)]:
        raise AddressError(
            "topic", unknown[0], f"one of {', '.join(arrays)}", problem="is not among these arrays"
        )
    return {
        name: (array, {})
        for name, array in arrays.items()
        if not topics or ANY in topics or name in names
    }


def _start_of(found: ReadStreams | None) -> int:
    """Return when recording began, on the clock of the timestamps [us]; 0 if it is unknown."""
    if found is None:
        return 0
    return recording_start(found.flight, found.addresses, unix_times=found.unix_times)


def _offset_of(found: ReadStreams | None, streams: Streams) -> UtcOffset | None:
    """Return the UTC offset of the streams; None if it is unknown."""
    if found is None or found.unix_times:
        return utc_of({name: messages for name, (messages, _) in streams.items()})
    return utc_offset_of(found.flight, found.addresses[0].vehicle)


def _to_utc(times: _Ints, offset: UtcOffset | None) -> npt.NDArray[np.datetime64]:
    return to_datetime64(offset.unix_us(times) if offset else 0 * times)


def _choose(
    columns: Mapping[str, npt.NDArray[Any]], fields: Sequence[str]
) -> dict[str, npt.NDArray[Any]]:
    """Return the time columns and those that `fields` selects; raise ArgumentError for an unknown field."""
    known = {name: {name, name.rpartition(".")[2]} for name in columns}
    if unknown := set(fields).difference(*known.values()):
        raise ArgumentError(
            "fields",
            sorted(unknown),
            f"any of {', '.join([*columns, *DERIVED])}",
            problem="are in no stream",
        )
    return {
        name: column
        for name, column in columns.items()
        if name in {"timestamp", "utc"} or known[name] & {*fields}
    }


def _look_up(stamps: _Ints, times: _Ints, method: str) -> tuple[_Ints, _Ints, _Floats]:
    """Return for each time the row of its message (-1: none), the row of the next message, and its weight."""
    if method == "own" or not len(stamps):  # by index, because messages may share a timestamp
        rows = np.arange(len(times)) if len(stamps) else np.full(len(times), -1)
        return rows, rows, np.zeros(len(times))
    order = np.argsort(stamps, kind="stable")
    stamps = stamps[order]
    before = np.searchsorted(stamps, times, side="right") - 1
    after = np.minimum(before + 1, len(stamps) - 1)
    since, gap = times - stamps[before], stamps[after] - stamps[before]
    weight = np.where((before >= 0) & (gap > 0), since / np.maximum(gap, 1), 0.0)
    if method == "nearest":
        before = np.where((before < 0) | (stamps[after] - times < since), after, before)
    return np.where(before < 0, -1, order[before]), order[after], weight


def _pick(messages: MessageArray, rows: _Ints) -> MessageArray:
    """Return a copy of the messages in these rows; without one, in row -1, floats are NaN and other values 0."""
    values = (messages if len(messages) else np.zeros(1, messages.dtype))[rows]
    if (is_absent := rows < 0).any():
        for field in values.dtype.names or ():
            kind = values.dtype[field].base
            values[field][is_absent] = np.nan if kind.kind == "f" else kind.type()
    return values


def _interpolate(
    stream: str, values: MessageArray, following: MessageArray, weight: _Floats
) -> None:
    """Interpolate the floats of `values` towards `following`, in place."""
    definition = next((BY_TOPIC[part] for part in stream.split("/") if part in BY_TOPIC), None)
    rules = definition.rules if definition else ()
    quaternions = {
        name for rule in rules if isinstance(rule, UnitQuaternion) for name in rule.fields
    }
    names = values.dtype.names or ()
    for name in names:
        if name.endswith("reset_counter"):
            weight = np.where(values[name] == following[name], weight, 0.0)
    between = weight > 0
    for name in names:
        if values.dtype[name].base.kind != "f":
            continue
        first, second = values[name][between].astype(float), following[name][between].astype(float)
        parts = weight[between].reshape(-1, *[1] * (first.ndim - 1))
        unit = definition.meaning(name) if definition else ""
        period = next((each for text, each in _PERIODS.items() if text in unit), np.inf)
        find = _slerp if name in quaternions else _linear
        is_same = first == second
        if name in quaternions:  # one equal element does not keep its value on the arc
            is_same = is_same.all(axis=1, keepdims=True)
        values[name][between] = np.where(is_same, first, find(first, second, parts, period))


def _linear(first: _Floats, second: _Floats, weight: _Floats, period: float) -> _Floats:
    """Interpolate linearly, angles on the shorter arc, to a range from -period/2 if either is negative, else from 0."""
    with np.errstate(invalid="ignore"):  # for infinity minus infinity, and for an infinite period
        step = second - first
        turned = first + weight * (step - np.sign(step) * period)
        start = np.where(np.minimum(first, second) < 0, -period / 2, 0.0)
        return np.where(
            np.abs(step) > period / 2, start + np.mod(turned - start, period), first + weight * step
        )


def _slerp(first: _Floats, second: _Floats, weight: _Floats, _: float) -> _Floats:
    """Interpolate unit quaternions of shape (n, 4) along the shorter arc."""
    cosine = np.sum(first * second, axis=1, keepdims=True)
    angle = np.arccos(np.minimum(np.abs(cosine), _PARALLEL))
    near = np.where(cosine < 0, -1, 1) * second
    found: _Floats = np.sin((1 - weight) * angle) * first + np.sin(weight * angle) * near
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return found


def _stamps(stream: str, messages: MessageArray) -> _Ints:
    """Return the timestamps [us]; raise ConfigError if they restart, for example after a reboot."""
    stamps: _Ints = np.minimum(messages["timestamp"], 2**62).astype(np.int64)
    late = np.count_nonzero(stamps < np.maximum.accumulate(stamps))
    early = np.count_nonzero(stamps > np.minimum.accumulate(stamps[::-1])[::-1])
    if min(late, early) > max(1, _STRAY * len(stamps)):
        raise ConfigError(
            stream,
            "timestamps restart; align the messages of each boot separately, as slices of `read`",
        )
    return stamps


def _without_wild(times: _Ints) -> _Ints:
    low, high = np.quantile(times, [0.25, 0.75])
    margin = _STALE + 10 * (high - low)
    near: _Ints = times[(times >= low - margin) & (times <= high + margin)]
    return near


def _times(on: float | Sequence[int] | _Ints, stamps: Mapping[str, _Ints], start: int) -> _Ints:
    """Return the given times, or times at the given rate from the first to the last message [us].

    At `start`, PX4 also logs the last message of slow topics, which may be much older: then begin at `start`.
    """
    given = np.asarray(on)
    if (
        given.dtype.kind not in "iuf"
        or given.ndim > 1
        or not np.all((given > 0) if given.ndim == 0 else (given >= 0))
    ):
        raise ArgumentError("on", on, "a stream, a rate above 0 [Hz], or times [us]")
    if given.ndim:
        return given.astype(np.int64)
    # A timestamp of 0 is unset, and a few wild ones do not determine the period.
    valid = {name: _without_wild(times[times > 0]) for name, times in stamps.items() if times.any()}
    firsts, lasts = (
        {name: int(end(each)) for name, each in valid.items()} for end in (np.min, np.max)
    )
    rate = float(given)
    first = min(firsts.values(), default=2**62)
    last = max(lasts.values(), default=0)
    first = start if first + _STALE < start <= last else first
    count = max(0.0, (last - first) / 1e6 * rate + 1)
    if count > _MAX_ROWS:
        earliest, latest = min(firsts, key=firsts.__getitem__), max(lasts, key=lasts.__getitem__)
        ends = f"{earliest} begins at {first / 1e6:.0f} s, {latest} ends at {last / 1e6:.0f} s"
        problem = f"Hz results in too many rows ({ends})"
        raise ArgumentError(
            "on", rate, "topics on one clock, a lower rate, or times", problem=problem
        )
    return first + np.round(np.arange(int(count)) * (1e6 / rate)).astype(np.int64)
