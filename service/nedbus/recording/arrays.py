"""Load one topic of a log or a recording as a NumPy array or a data frame, with PX4's own types."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, Self, overload

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from nedbus.errors import ConfigError, DecodeError, SourceError
from nedbus.extras import needs
from nedbus.log_event import about
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
    vehicle_name,
)
from nedbus_msgs.arrays import DTYPE, MessageArray, decode_cdr_array, to_array, valid_mask

from .choice import the_one
from .formats import SUFFIXES
from .ulog import UlogTopics, read_ulog

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl

    from .reader import RecordedMessage, RecordedStream, RecordingReader

_log = logging.getLogger(__name__)

_CHUNK: Final = 8192  # messages of a recording that are converted together
_NULLABLE: Final = {"bool": "boolean", "uint8": "UInt8", "uint64": "UInt64"}  # of pandas; its floats are NaN

_Mask = npt.NDArray[np.bool_]
Absent = Mapping[str, _Mask]
"""For each missing field, a mask of the messages that lack it."""


@overload
def read(
    path: str | Path, topic: str = ..., *, vehicle: str | int = ..., instance: int | None = ..., dataframe: None = None
) -> MessageArray: ...
@overload
def read(
    path: str | Path,
    topic: str = ...,
    *,
    vehicle: str | int = ...,
    instance: int | None = ...,
    dataframe: Literal["pandas"],
) -> pd.DataFrame: ...
@overload
def read(
    path: str | Path,
    topic: str = ...,
    *,
    vehicle: str | int = ...,
    instance: int | None = ...,
    dataframe: Literal["polars"],
) -> pl.DataFrame: ...
def read(
    path: str | Path,
    topic: str = DEFAULT_TOPIC,
    *,
    vehicle: str | int = ANY,
    instance: int | None = None,
    dataframe: Literal["pandas", "polars"] | None = None,
) -> Any:
    """Return one topic of a .ulg log or an .mcap recording as a structured array, one element a message.

    Its columns are the fields of VehicleLocalPosition with PX4's types (`nedbus.DTYPE`).
    Fields that a layout or a source lacks are NaN, false or 0, and `nedbus.missing_of` names them.
    Invalid messages are left out, and so is what is damaged; both are logged.
    With `dataframe` it is a data frame of pandas or polars instead, with `delta_xy[0]`, `delta_xy[1]` as columns, where
    missing fields are null; that of pandas names them in `attrs["missing"]`.

    Raises SourceError for a file that cannot be read, AddressError when no stream, or more than one, matches topic,
    vehicle and instance, ConfigError when the package that reads the file is not installed.
    """
    if dataframe not in (None, "pandas", "polars"):
        raise ConfigError("dataframe", f"{dataframe!r} is neither pandas nor polars")
    path = Path(path).expanduser()
    selection = Selection(topic, vehicle_name(vehicle), instance)
    with Flight(path) as flight:
        messages, absent = flight.read(the_one(path, flight.addresses, selection))
        for warning in flight.warnings:
            _log.warning("%s: %s", path, warning, extra=about("damaged", source=str(path), reason=warning))
    return messages if dataframe is None else _to_dataframe(messages, absent, dataframe)


def missing_of(messages: MessageArray) -> frozenset[str]:
    """Return the fields that `read` did not find in some or all of these messages: they hold NaN, false or 0.

    It stands in the metadata of the array's dtype, and is kept by slices, masks and copies, but not by `numpy.save`.
    """
    metadata: Mapping[str, Any] = messages.dtype.metadata or {}
    return frozenset(metadata.get("missing", ()))


def addresses_of(path: str | Path) -> list[Address]:
    """Return the addresses that occur in a .ulg log or an .mcap recording; errors are those of `read`."""
    with Flight(Path(path).expanduser()) as flight:
        return flight.addresses


class Flight:
    """A .ulg log or an .mcap recording that is open for reading: `addresses`, and the messages of each.

    `warnings`: what is damaged or left out, of what was read so far.

    Raises SourceError for a file that cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.warnings: list[str] = []
        self._reader: RecordingReader | None = None
        self._log: UlogTopics | None = None
        if SUFFIXES.get(path.suffix) == "mcap":
            self._reader = needs("mcap", f"{__package__}.reader").RecordingReader(path, vehicle="1")
            self.addresses = sorted({stream.address for stream in self._reader.counts})
            if not self.addresses:
                self._reader.close()
                raise SourceError(str(path), "no message of the local position topics is in this recording")
        else:
            self._log = read_ulog(path)
            self.warnings += self._log.warnings
            self.addresses = sorted(address for address, _ in self._log.topics)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._reader is not None:
            self._reader.close()

    @property
    def damaged(self) -> bool:
        """Whether damage cost messages of what was read so far."""
        return any(part is not None and part.damaged for part in (self._reader, self._log))

    def read(self, address: Address) -> tuple[MessageArray, Absent]:
        """Return the messages of an address, and for each field that some of them lack a mask of those."""
        messages, valid, absent = self._read_ulog(address) if self._reader is None else self._read_mcap(address)
        if self._reader is not None:
            self.warnings += (each for each in self._reader.warnings if each not in self.warnings)
        if not valid.all():
            self.warnings.append(f"{np.sum(~valid)} of {len(valid)} messages violate the rules and are left out")
            messages, absent = messages[valid], {name: mask[valid] for name, mask in absent.items()}
        if absent:
            types = [(name, DTYPE[name]) for name in FIELD_TYPES]
            messages = messages.view(np.dtype(types, metadata={"missing": tuple(absent)}))
        return messages, absent

    def _read_ulog(self, address: Address) -> tuple[MessageArray, _Mask, Absent]:
        columns = dict(self._log.topics if self._log else ())[address]
        messages = np.repeat(to_array([VehicleLocalPosition(timestamp=0)]), len(columns["timestamp"]))
        names = upgraded_names(columns)
        for name, old in names.items():
            messages[name] = columns[old]
        valid = valid_mask(messages)
        for name in columns:
            if FIELD_TYPES.get(name) == "bool":
                valid &= columns[name].astype(np.int64) >> 1 == 0  # a byte other than 0 and 1 is invalid
        return messages, valid, {name: np.ones(len(messages), bool) for name in FIELD_TYPES if name not in names}

    def _read_mcap(self, address: Address) -> tuple[MessageArray, _Mask, Absent]:
        recorded = self._reader.messages(address) if self._reader else iter(())
        chunks, masks = [np.empty(0, DTYPE)], [np.empty(0, bool)]
        lacking: list[frozenset[str]] = []  # of each message
        by_stream: dict[RecordedStream, frozenset[str]] = {}
        while chunk := list(islice(recorded, _CHUNK)):
            messages, valid = _decode(chunk)
            chunks.append(messages)
            masks.append(valid)
            for stream in {each.stream for each in chunk} - by_stream.keys():
                by_stream[stream] = stream.lacking
            lacking += [by_stream[each.stream] for each in chunk]
        fields = frozenset[str]().union(*by_stream.values())
        absent = {name: np.array([name in each for each in lacking], bool) for name in FIELD_TYPES if name in fields}
        return np.concatenate(chunks), np.concatenate(masks), absent


def _decode(chunk: Sequence[RecordedMessage]) -> tuple[MessageArray, npt.NDArray[np.bool_]]:
    """Return the messages, and a mask of those that are valid: all at once, and one by one what that cannot decide."""
    is_current = [recorded.stream.layout == CURRENT.name for recorded in chunk]
    payloads = [recorded.payload if current else b"" for recorded, current in zip(chunk, is_current, strict=True)]
    array, valid = decode_cdr_array(payloads)
    decoded: dict[int, VehicleLocalPosition] = {}
    for index in np.flatnonzero(~valid).tolist():
        stream = chunk[index].stream
        with suppress(DecodeError, ValidationError):
            decoded[index] = upgrade(decode_cdr(chunk[index].payload, layout=stream.layout))
    if decoded:
        rows = list(decoded)
        array[rows] = to_array(list(decoded.values()))
        valid[rows] = True
    return array, valid


def _to_dataframe(messages: MessageArray, absent: Absent, library: str) -> Any:
    package = needs(library, library)
    columns: dict[str, Any] = {}
    for name, kind in FIELD_TYPES.items():
        parts = [f"{name}[0]", f"{name}[1]"] if kind == "float32[2]" else [name]
        for part, values in zip(parts, messages[name].reshape(len(messages), -1).T, strict=True):
            column = np.ascontiguousarray(values)
            if name not in absent:
                columns[part] = column
            elif library == "polars":
                columns[part] = package.Series(column).scatter(np.flatnonzero(absent[name]), None)
            else:
                columns[part] = package.Series(column, dtype=_NULLABLE.get(kind, column.dtype)).mask(absent[name])
    data = package.DataFrame(columns)
    if library == "pandas":
        data.attrs["missing"] = sorted(absent)
    return data
