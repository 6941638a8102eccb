"""Time alignment of several streams into one table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypedDict, Unpack, overload

import numpy as np
import numpy.typing as npt

from nedbus import UtcOffset, limits, utc_of
from nedbus.errors import AddressError, ArgumentError, ConfigError
from nedbus.flights import utc_offset_of
from nedbus.timeline import to_datetime64
from nedbus_msgs import ANY, BY_TOPIC, DEFAULT_TOPIC, Definition, UnitQuaternion
from nedbus_msgs.arrays import MessageArray, derive_column
from nedbus_msgs.frames import DERIVED, derived_from

from .arrays import (
    Library,
    Pandas,
    Polars,
    StreamArray,
    Streams,
    missing_of,
    recording_start,
    to_dataframe,
)
from .reading import FlightPath, ReadStreams, names_of, read_streams

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl

_METHODS: Final = ("last", "nearest", "linear")
_PERIODS: Final = {"[rad]": 2 * np.pi, "[deg]": 360.0}  # period of an angle, by unit
# us; a first message that is older when recording starts was sent before the start
_STALE: Final = 1_000_000
# fraction of messages that may be out of order; a larger one indicates several boots
_STRAY: Final = 0.01
_PARALLEL: Final = 1 - 1e-9  # cosine above which two quaternions count as equal
_NO_TIME: Final = 2**62  # us; larger timestamps are damaged
_ABSENT: Final = -1  # row of a message that does not exist

_Floats = npt.NDArray[np.float64]
_Ints = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]
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
    topics = names_of(topics)
    names = [*topics] if topics else []
    if isinstance(on, str):
        names.insert(0, on)
    opened: ReadStreams | None = None
    if isinstance(flight, Mapping):
        streams = _choose_streams(flight, topics, names)
    else:
        selected = names if topics else None
        opened = read_streams(flight, selected, vehicle=vehicle, layout=layout, utc=utc)
        streams = opened.streams
        if isinstance(on, str) and not _streams_named(on, streams):
            # not a topic known to nedbus
            streams |= read_streams(flight, [on], vehicle=vehicle, layout=layout).streams
    own = ""
    if isinstance(on, str):
        own = _first_named(on, streams)
        streams = {own: streams[own], **streams}
    stamps = {name: _stamps(name, stream.messages) for name, stream in streams.items()}
    times = stamps[own] if isinstance(on, str) else _times(on, stamps, _start_of(opened))
    table = _Table({"timestamp": times.astype(np.uint64)}, {})
    if utc:
        table.columns["utc"] = _to_utc(times, _offset_of(opened, streams))
    requested = {field.rpartition(".")[2] for field in fields or ()}
    for name, stream in streams.items():
        if name == own:
            match = _match_own(len(times))
        else:
            match = _match(stamps[name], times, nearest=method == "nearest")
        table.add(name, stream, match, requested, is_linear=method == "linear")
    if fields is not None:
        table.columns = _choose(table.columns, fields)
    return to_dataframe(table.to_array(_missing(streams)), table.incomplete(), dataframe)


class _Match(NamedTuple):
    """The messages of a stream that belong to the rows of the table.

    `rows`: the index of each row's message, or _ABSENT; `following`: the index of the next message.
    `weight`: the position of the row's time between the two, from 0 at the first to 1. `age`: of the message [s].
    """

    rows: _Ints
    following: _Ints
    weight: _Floats
    age: _Floats


@dataclass
class _Table:
    """The columns of the table by name, and the masks of the rows in which they have no value."""

    columns: dict[str, npt.NDArray[Any]]
    absent: dict[str, _Mask]

    def add(
        self, name: str, stream: StreamArray, match: _Match, requested: set[str], *, is_linear: bool
    ) -> None:
        """Add the age and the fields of a stream, and the requested quantities that follow from them."""
        values = _pick(stream.messages, match.rows)
        if is_linear:
            following = _pick(stream.messages, match.following)
            _interpolate(name, values, following, match.weight)
        fields = values.dtype.names or ()
        is_absent = match.rows == _ABSENT
        self.columns[f"{name}.age"] = match.age
        for field in fields:
            column = f"{name}.{field}"
            self.columns[column] = values[field]
            self.absent[column] = is_absent
        for field, mask in stream.absent.items():
            with_absent = np.append(mask, True)  # row _ABSENT, the last one
            self.absent[f"{name}.{field}"] = with_absent[match.rows]
        for field in requested.intersection(derived_from(fields)):
            column = f"{name}.{field}"
            self.columns[column] = derive_column(values, field)  # interpolated
            self.absent[column] = is_absent

    def to_array(self, missing: set[str]) -> MessageArray:
        """Return the columns as a structured array whose dtype names those in `missing`."""
        names = tuple(name for name in self.columns if name in missing)
        types = [(name, column.dtype, column.shape[1:]) for name, column in self.columns.items()]
        rows = len(self.columns["timestamp"])
        array = np.zeros(rows, np.dtype(types, metadata={"missing": names}))
        for name, column in self.columns.items():
            array[name] = column
        return array

    def incomplete(self) -> dict[str, _Mask]:
        """Return the masks of the columns that lack values."""
        return {name: mask for name, mask in self.absent.items() if mask.any()}


def _missing(streams: Streams) -> set[str]:
    """Return the columns of the fields that messages lack."""
    missing = set()
    for name, stream in streams.items():
        for field in missing_of(stream.messages):
            missing.add(f"{name}.{field}")
    return missing


def _streams_named(name: str, streams: Streams) -> list[str]:
    return [stream for stream in streams if f"/{stream}".endswith(f"/{name}")]


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
    for topic in topics or ():
        if topic != ANY and topic not in arrays:
            known = f"one of {', '.join(arrays)}"
            raise AddressError("topic", topic, known, problem="is not among these arrays")
    chosen = list(arrays)
    if topics and ANY not in topics:
        chosen = [name for name in arrays if name in names]
    return {name: StreamArray(arrays[name], {}) for name in chosen}


def _start_of(opened: ReadStreams | None) -> int:
    """Return when recording began, on the clock of the timestamps [us]; 0 if it is unknown."""
    if opened is None:
        return 0
    return recording_start(opened.flight, opened.addresses, unix_times=opened.unix_times)


def _offset_of(opened: ReadStreams | None, streams: Streams) -> UtcOffset | None:
    """Return the UTC offset of the streams; None if it is unknown."""
    if opened is None or opened.unix_times:
        arrays = {name: stream.messages for name, stream in streams.items()}
        return utc_of(arrays)
    return utc_offset_of(opened.flight, opened.addresses[0].vehicle)


def _to_utc(times: _Ints, offset: UtcOffset | None) -> npt.NDArray[np.datetime64]:
    if offset is None:
        return to_datetime64(np.zeros_like(times))  # NaT
    return to_datetime64(offset.unix_us(times))


def _choose(
    columns: Mapping[str, npt.NDArray[Any]], fields: Sequence[str]
) -> dict[str, npt.NDArray[Any]]:
    """Return the time columns and those that `fields` selects; raise ArgumentError for an unknown field."""
    names = {column: {column, column.rpartition(".")[2]} for column in columns}
    unknown = set(fields).difference(*names.values())
    if unknown:
        known = f"any of {', '.join([*columns, *DERIVED])}"
        raise ArgumentError("fields", sorted(unknown), known, problem="are in no stream")
    chosen = {}
    for name, column in columns.items():
        is_time = name in {"timestamp", "utc"}
        if is_time or not names[name].isdisjoint(fields):
            chosen[name] = column
    return chosen


def _match_own(count: int) -> _Match:
    """Match the messages of the stream that gives the times: by index, because messages may share a timestamp."""
    rows = np.arange(count)
    zeros = np.zeros(count)
    return _Match(rows, rows, weight=zeros, age=zeros)


def _match(stamps: _Ints, times: _Ints, *, nearest: bool) -> _Match:
    """Match each time with the last message of a stream before it, or with the nearest one."""
    if not len(stamps):
        none = np.full(len(times), _ABSENT)
        age = np.full(len(times), np.nan)
        return _Match(none, none, weight=np.zeros(len(times)), age=age)
    order = np.argsort(stamps, kind="stable")
    ordered = stamps[order]
    before = np.searchsorted(ordered, times, side="right") - 1
    after = np.minimum(before + 1, len(ordered) - 1)
    since = times - ordered[before]
    gap = ordered[after] - ordered[before]
    is_between = (before >= 0) & (gap > 0)
    weight = np.where(is_between, since / np.maximum(gap, 1), 0.0)
    if nearest:
        is_next_nearer = ordered[after] - times < since
        before = np.where((before < 0) | is_next_nearer, after, before)
    is_absent = before < 0
    rows = np.where(is_absent, _ABSENT, order[before])
    age = np.where(is_absent, np.nan, times - ordered[before]) / 1e6
    return _Match(rows, order[after], weight, age)


def _pick(messages: MessageArray, rows: _Ints) -> MessageArray:
    """Return a copy of the messages in these rows; in row _ABSENT, floats are NaN and other values 0."""
    if not len(messages):
        messages = np.zeros(1, messages.dtype)
    values = messages[rows]
    is_absent = rows == _ABSENT
    if is_absent.any():
        for field in values.dtype.names or ():
            base = values.dtype[field].base
            absent = base.type()
            if base.kind == "f":
                absent = np.nan
            values[field][is_absent] = absent
    return values


def _interpolate(
    stream: str, values: MessageArray, following: MessageArray, weight: _Floats
) -> None:
    """Interpolate the floats of `values` towards `following`, in place."""
    names = values.dtype.names or ()
    for name in names:
        if name.endswith("reset_counter"):
            weight = np.where(values[name] == following[name], weight, 0.0)
    definition = _definition_of(stream)
    quaternions = _quaternions_of(definition)
    between = weight > 0
    for name in names:
        if values.dtype[name].base.kind != "f":
            continue
        first = values[name][between].astype(float)
        second = following[name][between].astype(float)
        elements = [1] * (first.ndim - 1)
        parts = weight[between].reshape(-1, *elements)
        is_same = first == second
        if name in quaternions:
            is_same = is_same.all(axis=1, keepdims=True)  # an equal element changes on the arc
            middle = _slerp(first, second, parts)
        else:
            unit = ""
            if definition:
                unit = definition.meaning(name)
            middle = _linear(first, second, parts, _period(unit))
        values[name][between] = np.where(is_same, first, middle)


def _definition_of(stream: str) -> Definition[Any] | None:
    """Return the definition of a stream such as "7/sensor_gps/0"; None if its topic is not built in."""
    for part in stream.split("/"):
        if part in BY_TOPIC:
            return BY_TOPIC[part]
    return None


def _quaternions_of(definition: Definition[Any] | None) -> set[str]:
    """Return the fields of a message that are unit quaternions."""
    quaternions: set[str] = set()
    if definition is not None:
        for rule in definition.rules:
            if isinstance(rule, UnitQuaternion):
                quaternions.update(rule.fields)
    return quaternions


def _period(meaning: str) -> float:
    """Return the period of a field, infinite if its meaning names no unit of an angle."""
    for unit, period in _PERIODS.items():
        if unit in meaning:
            return period
    return np.inf


def _linear(first: _Floats, second: _Floats, weight: _Floats, period: float) -> _Floats:
    """Interpolate linearly, angles on the shorter arc, to a range from -period/2 if either is negative, else from 0."""
    with np.errstate(invalid="ignore"):  # for infinity minus infinity, and for an infinite period
        step = second - first
        straight = first + weight * step
        turned = first + weight * (step - np.sign(step) * period)
        start = np.where(np.minimum(first, second) < 0, -period / 2, 0.0)
        wrapped = start + np.mod(turned - start, period)
        return np.where(np.abs(step) > period / 2, wrapped, straight)


def _slerp(first: _Floats, second: _Floats, weight: _Floats) -> _Floats:
    """Interpolate unit quaternions of shape (n, 4) along the shorter arc."""
    cosine = np.sum(first * second, axis=1, keepdims=True)
    angle = np.arccos(np.minimum(np.abs(cosine), _PARALLEL))
    near = np.where(cosine < 0, -second, second)  # both signs are the same attitude
    begin = np.sin((1 - weight) * angle) * first
    end = np.sin(weight * angle) * near
    middle: _Floats = begin + end
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return middle


def _stamps(stream: str, messages: MessageArray) -> _Ints:
    """Return the timestamps [us]; raise ConfigError if they step back, for example after a reboot."""
    stamps: _Ints = np.minimum(messages["timestamp"], _NO_TIME).astype(np.int64)
    latest_before = np.maximum.accumulate(stamps)
    earliest_after = np.minimum.accumulate(stamps[::-1])[::-1]
    late = np.count_nonzero(stamps < latest_before)
    early = np.count_nonzero(stamps > earliest_after)
    # A few wild timestamps make many others late, or many others early, but not both.
    if min(late, early) > max(1, _STRAY * len(stamps)):
        cause = "after a reboot, or because the vehicle's clock was set"
        remedy = "align the messages before and after it separately, as slices of `read`"
        raise ConfigError(stream, f"timestamps step back {cause}; {remedy}")
    return stamps


def _without_wild(times: _Ints) -> _Ints:
    low, high = np.quantile(times, [0.25, 0.75])
    margin = _STALE + 10 * (high - low)
    is_near = (times >= low - margin) & (times <= high + margin)
    near: _Ints = times[is_near]
    return near


def _times(on: float | Sequence[int] | _Ints, stamps: Mapping[str, _Ints], start: int) -> _Ints:
    """Return the given times, or times at the given rate from the first to the last message [us]."""
    given = np.asarray(on)
    is_number = given.dtype.kind in "iuf"
    if is_number and given.ndim == 0 and given > 0:
        return _times_at_rate(float(given), stamps, start)
    if is_number and given.ndim == 1 and np.all(given >= 0):
        return given.astype(np.int64)
    raise ArgumentError("on", on, "a stream, a rate above 0 [Hz], or times [us]")


def _times_at_rate(rate: float, stamps: Mapping[str, _Ints], start: int) -> _Ints:
    """Return times at a rate, from the first to the last message [us].

    At `start`, PX4 also logs the last message of slow topics, which may be much older: then begin at `start`.
    """
    firsts: dict[str, int] = {}
    lasts: dict[str, int] = {}
    for name, times in stamps.items():
        if times.any():
            # A timestamp of 0 is unset, and a few wild ones do not determine the period.
            valid = _without_wild(times[times > 0])
            firsts[name] = int(valid.min())
            lasts[name] = int(valid.max())
    first = min(firsts.values(), default=_NO_TIME)
    last = max(lasts.values(), default=0)
    if first + _STALE < start <= last:
        first = start
    seconds = (last - first) / 1e6
    count = max(0.0, seconds * rate + 1)
    if count > limits.ALIGNED_ROWS:
        earliest = min(firsts, key=firsts.__getitem__)
        latest = max(lasts, key=lasts.__getitem__)
        ends = f"{earliest} begins at {first / 1e6:.0f} s, {latest} ends at {last / 1e6:.0f} s"
        problem = f"Hz results in too many rows ({ends})"
        remedy = "topics on one clock, a lower rate, or times"
        raise ArgumentError("on", rate, remedy, problem=problem)
    offsets = np.round(np.arange(int(count)) * (1e6 / rate))
    return first + offsets.astype(np.int64)
