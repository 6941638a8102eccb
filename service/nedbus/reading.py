"""Flights as arrays: one topic of a log or a recording, with PX4's own types."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, overload

import numpy as np

from nedbus_msgs import ANY, CURRENT, FIELD_TYPES, Address, VehicleLocalPosition, decode_cdr, upgrade, upgraded_names
from nedbus_msgs.arrays import DTYPE, Records, find_sound, read_cdr_records, to_records

from .errors import AddressError, SourceError
from .extras import needs

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl

    from .playback import Playback, Played
    from .sources.ulog import Columns

_log = logging.getLogger(__name__)

_AT_ONCE: Final = 8192  # messages of a recording that are turned into an array together
_VLP: Final = "vehicle_local_position"


@overload
def read(
    path: str | Path, topic: str = _VLP, *, vehicle: str = ANY, instance: int | None = None, frame: None = None
) -> Records: ...
@overload
def read(
    path: str | Path, topic: str = _VLP, *, vehicle: str = ANY, instance: int | None = None, frame: Literal["pandas"]
) -> pd.DataFrame: ...
@overload
def read(
    path: str | Path, topic: str = _VLP, *, vehicle: str = ANY, instance: int | None = None, frame: Literal["polars"]
) -> pl.DataFrame: ...
def read(
    path: str | Path,
    topic: str = _VLP,
    *,
    vehicle: str = ANY,
    instance: int | None = None,
    frame: Literal["pandas", "polars"] | None = None,
) -> Any:
    """Return one topic of a .ulg log or an .mcap recording as a structured array, one record a message.

    Its columns are the fields of VehicleLocalPosition with PX4's types (`nedbus_msgs.arrays.DTYPE`).
    What a layout lacks is NaN, false or 0; messages that break the model's rules are left out, which the log tells.
    With `frame` it is a data frame of pandas or polars instead, with `delta_xy[0]`, `delta_xy[1]` as columns.

    Raises SourceError for a file that cannot be read, AddressError when nothing in it, or more than one vehicle or
    instance, is what was asked for, ConfigError when what reads the file is not installed.
    """
    path = Path(path).expanduser()
    read_file = _read_mcap if path.suffix == ".mcap" else _read_ulog
    records = read_file(path, topic, vehicle, instance)
    sound = find_sound(records)
    if not sound.all():
        _log.warning("%s: %d of %d messages break the rules and are left out", path, np.sum(~sound), len(sound))
        records = records[sound]
    if frame is None:
        return records
    return needs(frame, frame).DataFrame(_flat(records))


def addresses_of(path: str | Path) -> list[Address]:
    """Return what is in a .ulg log or an .mcap recording; errors are those of `read`."""
    path = Path(path).expanduser()
    if path.suffix == ".mcap":
        with _open(path) as playback:
            return sorted({stream.address for stream in playback.counts})
    return sorted(address for address, _ in _columns_of(path))


def _read_ulog(path: Path, topic: str, vehicle: str, instance: int | None) -> Records:
    found = dict(_columns_of(path))
    columns = found[_choose(path, found, topic, vehicle, instance)]
    records = np.repeat(to_records([VehicleLocalPosition(timestamp=0)]), len(columns["timestamp"]))
    for name, old in upgraded_names(columns).items():
        records[name] = columns[old]
    for name in columns:
        if FIELD_TYPES.get(name) == "bool":  # anything but 0 and 1 is no bool, and breaks the first of all rules
            records["timestamp_sample"][columns[name].astype(np.int64) >> 1 != 0] = np.iinfo(np.uint64).max
    return records


def _columns_of(path: Path) -> list[tuple[Address, Columns]]:
    from .sources.ulog import read_columns

    found, warnings = read_columns(path)
    for warning in warnings:
        _log.warning("%s: %s", path, warning)
    return found


def _open(path: Path) -> Playback:
    playback: Playback = needs("mcap", "nedbus.playback").Playback(path, vehicle="1")
    return playback


def _read_mcap(path: Path, topic: str, vehicle: str, instance: int | None) -> Records:
    with _open(path) as playback:
        addresses = {stream.address for stream in playback.counts}
        if not addresses:
            raise SourceError(str(path), "no message of the local position topics is in this recording")
        messages = playback.messages(_choose(path, addresses, topic, vehicle, instance))
        parts = []
        while batch := list(islice(messages, _AT_ONCE)):
            parts.append(_to_array(batch))
        for warning in playback.warnings:
            _log.warning("%s: %s", path, warning)
    return np.concatenate(parts) if parts else np.empty(0, DTYPE)


def _to_array(batch: Sequence[Played]) -> Records:
    if all(played.stream.layout == CURRENT.name for played in batch):
        sizes = {len(played.payload) for played in batch}
        if len(sizes) == 1:
            return read_cdr_records(b"".join(played.payload for played in batch))
    fields = (decode_cdr(played.payload, layout=played.stream.layout) for played in batch)
    return to_records([upgrade(each) for each in fields])


def _choose(path: Path, addresses: Iterable[Address], topic: str, vehicle: str, instance: int | None) -> Address:
    """Return the one address that is meant."""
    there = sorted(addresses)
    meant = [
        address
        for address in there
        if topic == address.topic and vehicle in (ANY, address.vehicle) and instance in (None, address.instance)
    ]
    if len(meant) != 1:
        choice = ", ".join(map(str, (meant or there)[:10]))
        raise AddressError("topic", topic, f"one stream of {path}, which has {choice}: name vehicle and instance too")
    return meant[0]


def _flat(records: Records) -> dict[str, Any]:
    columns: dict[str, Any] = {}
    for name, kind in FIELD_TYPES.items():
        if kind == "float32[2]":
            columns |= {f"{name}[{part}]": records[name][:, part] for part in (0, 1)}
        else:
            columns[name] = records[name]
    return {name: np.ascontiguousarray(column) for name, column in columns.items()}
