"""Load one topic of a log or a recording as a NumPy array or a data frame, with PX4's own types."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, overload

import numpy as np

from nedbus.errors import AddressError, SourceError
from nedbus.extras import needs
from nedbus_msgs import (
    ANY,
    CURRENT,
    DEFAULT_TOPIC,
    FIELD_TYPES,
    Address,
    Selection,
    VehicleLocalPosition,
    decode_cdr,
    upgrade,
    upgraded_names,
)
from nedbus_msgs.arrays import DTYPE, MessageArray, decode_cdr_array, to_array, valid_mask

from .formats import SUFFIXES
from .ulog import UlogColumns, read_ulog

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl

    from .reader import RecordedMessage, RecordingReader

_log = logging.getLogger(__name__)

_CHUNK: Final = 8192  # messages of a recording that are converted together


@overload
def read(
    path: str | Path, topic: str = ..., *, vehicle: str = ..., instance: int | None = ..., frame: None = None
) -> MessageArray: ...
@overload
def read(
    path: str | Path, topic: str = ..., *, vehicle: str = ..., instance: int | None = ..., frame: Literal["pandas"]
) -> pd.DataFrame: ...
@overload
def read(
    path: str | Path, topic: str = ..., *, vehicle: str = ..., instance: int | None = ..., frame: Literal["polars"]
) -> pl.DataFrame: ...
def read(
    path: str | Path,
    topic: str = DEFAULT_TOPIC,
    *,
    vehicle: str = ANY,
    instance: int | None = None,
    frame: Literal["pandas", "polars"] | None = None,
) -> Any:
    """Return one topic of a .ulg log or an .mcap recording as a structured array, one element a message.

    Its columns are the fields of VehicleLocalPosition with PX4's types (`nedbus.DTYPE`).
    Fields that a layout lacks are NaN, false or 0; messages that violate the model's rules are left out and logged.
    With `frame` it is a data frame of pandas or polars instead, with `delta_xy[0]`, `delta_xy[1]` as columns.

    Raises SourceError for a file that cannot be read, AddressError when no stream, or more than one, matches topic,
    vehicle and instance, ConfigError when the package that reads the file is not installed.
    """
    path = Path(path).expanduser()
    selection = Selection(topic, vehicle, instance)
    messages = _read_mcap(path, selection) if SUFFIXES.get(path.suffix) == "mcap" else _read_ulog(path, selection)
    valid = valid_mask(messages)
    if not valid.all():
        _log.warning("%s: %d of %d messages violate the rules and are left out", path, np.sum(~valid), len(valid))
        messages = messages[valid]
    if frame is None:
        return messages
    return needs(frame, frame).DataFrame(_columns(messages))


def addresses_of(path: str | Path) -> list[Address]:
    """Return the addresses that occur in a .ulg log or an .mcap recording; errors are those of `read`."""
    path = Path(path).expanduser()
    if SUFFIXES.get(path.suffix) == "mcap":
        with _open(path) as reader:
            return sorted({stream.address for stream in reader.counts})
    return sorted(_load_ulog(path))


def _read_ulog(path: Path, selection: Selection) -> MessageArray:
    topics = _load_ulog(path)
    columns = topics[_choose(path, topics, selection)]
    messages = np.repeat(to_array([VehicleLocalPosition(timestamp=0)]), len(columns["timestamp"]))
    for name, old in upgraded_names(columns).items():
        messages[name] = columns[old]
    for name in columns:
        if FIELD_TYPES.get(name) == "bool":  # a byte other than 0 and 1 is invalid: let such a message violate a rule
            messages["timestamp_sample"][columns[name].astype(np.int64) >> 1 != 0] = np.iinfo(np.uint64).max
    return messages


def _load_ulog(path: Path) -> dict[Address, UlogColumns]:
    topics, warnings = read_ulog(path)
    for warning in warnings:
        _log.warning("%s: %s", path, warning)
    return dict(topics)


def _open(path: Path) -> RecordingReader:
    reader: RecordingReader = needs("mcap", f"{__package__}.reader").RecordingReader(path, vehicle="1")
    return reader


def _read_mcap(path: Path, selection: Selection) -> MessageArray:
    with _open(path) as reader:
        addresses = {stream.address for stream in reader.counts}
        if not addresses:
            raise SourceError(str(path), "no message of the local position topics is in this recording")
        recorded = reader.messages(_choose(path, addresses, selection))
        chunks = []
        while chunk := list(islice(recorded, _CHUNK)):
            chunks.append(_to_array(chunk))
        for warning in reader.warnings:
            _log.warning("%s: %s", path, warning)
    return np.concatenate(chunks) if chunks else np.empty(0, DTYPE)


def _to_array(chunk: Sequence[RecordedMessage]) -> MessageArray:
    if all(recorded.stream.layout == CURRENT.name for recorded in chunk):
        sizes = {len(recorded.payload) for recorded in chunk}
        if len(sizes) == 1:
            return decode_cdr_array(b"".join(recorded.payload for recorded in chunk))
    fields = (decode_cdr(recorded.payload, layout=recorded.stream.layout) for recorded in chunk)
    return to_array([upgrade(each) for each in fields])


def _choose(path: Path, addresses: Iterable[Address], selection: Selection) -> Address:
    """Return the only address that matches."""
    available = sorted(addresses)
    matching = [address for address in available if selection.matches(address)]
    if len(matching) != 1:
        choice = ", ".join(map(str, (matching or available)[:10]))
        reason = f"one stream of {path}, which has {choice}: name vehicle and instance too"
        raise AddressError("topic", selection.topic, reason)
    return matching[0]


def _columns(messages: MessageArray) -> dict[str, Any]:
    columns: dict[str, Any] = {}
    for name, kind in FIELD_TYPES.items():
        if kind == "float32[2]":
            columns |= {f"{name}[{index}]": messages[name][:, index] for index in (0, 1)}
        else:
            columns[name] = messages[name]
    return {name: np.ascontiguousarray(column) for name, column in columns.items()}
