"""Read the local position topics of a PX4 .ulg log as columns."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
import numpy.typing as npt
import pyulog.core
from pyulog import ULog, ULogException

from nedbus.errors import AddressError, SourceError
from nedbus_msgs import TOPICS, Address, get_topic

_MESSAGE_HEADER: Final = 3  # bytes
_READ_COST: Final = 4096  # of any read, in bytes, however short it is
_BUDGET: Final = 2**31  # bytes that may be read of a damaged log, beside what its size makes plausible

UlogColumns = Mapping[str, npt.NDArray[np.generic]]
"""One topic of a log: PX4's field names, and the values of all messages; delta_xy and delta_vxy have two columns."""


def read_ulog(
    path: Path, *, vehicle: str | None = None, default_vehicle: str = "1"
) -> tuple[list[tuple[Address, UlogColumns]], list[str]]:
    """Return each local position topic of a log with its columns by PX4's field names, and warnings about damage.

    `vehicle` is the log's MAV_SYS_ID unless it is given, and `default_vehicle` if the log has none.

    Raises SourceError when it is not a ULog file, or has none of the topics.
    """
    log, warnings = _load(path)
    vehicle = vehicle or _system_id(log) or default_vehicle
    topics: list[tuple[Address, UlogColumns]] = []
    for data in log.data_list:
        try:
            address = Address(vehicle, data.name, data.multi_id if get_topic(data.name).instances else None)
        except AddressError as exc:
            warnings.append(f"{data.name} is left out: {exc}")
            continue
        if any(address == other for other, _ in topics) or "timestamp" not in data.data:
            warnings.append(f"{data.name} [{data.multi_id}] is left out: a second one, or without timestamps")
            continue
        topics.append((address, _by_field(data.data)))
    if not topics:
        raise SourceError(str(path), "no message of the local position topics is in this log")
    return topics, warnings


class _BoundedFile:
    """A file of which only so much can be read, as pyulog can loop in a damaged one; `cut` if it ends too early."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self.cut = False
        self._file = file
        self._budget = _BUDGET + 1000 * size
        self.seek = file.seek
        self.tell = file.tell
        self.close = file.close

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(size)
        self._budget -= _READ_COST + len(data)
        # Only the read of a message's header may find the end of the file.
        if len(data) < size and (data or size != _MESSAGE_HEADER):
            self.cut = True
        if self._budget < 0:
            raise ULogException("invalid structure: its parts refer back to each other")
        return data


class _Printed(threading.local):
    """What pyulog printed in this thread: it prints its warnings, and a library must leave stdout alone."""

    def __init__(self) -> None:
        self.lines: list[str] = []


_printed = _Printed()


def _capture(*values: object) -> None:
    _printed.lines.append(" ".join(map(str, values)))


pyulog.core.print = _capture


def _load(path: Path) -> tuple[ULog, list[str]]:
    """Return the log, and what pyulog reports as damaged."""
    _printed.lines = []
    try:
        with path.open("rb") as file:
            bounded = _BoundedFile(file, path.stat().st_size)
            log = ULog(bounded, list(TOPICS))
    except OSError as exc:
        raise SourceError(str(path), (exc.strerror or str(exc)).lower()) from exc
    except ULogException as exc:
        raise SourceError(str(path), f"not a readable ULog file ({exc})") from exc
    warnings = [f"damaged: {line}" for line in _printed.lines[:5]]
    if log.file_corruption and not warnings:
        warnings.append("damaged: parts of it were skipped")
    elif bounded.cut:
        warnings.append("cut: it ends inside a message")
    return log, warnings


def _system_id(log: ULog) -> str | None:
    """Return the MAVLink system id of the vehicle that wrote the log."""
    value = log.initial_parameters.get("MAV_SYS_ID")
    return str(value) if isinstance(value, int) and 0 < value < 256 else None


def _by_field(data: Mapping[str, npt.NDArray[np.generic]]) -> dict[str, npt.NDArray[np.generic]]:
    """Return the columns by PX4's field names: `delta_xy[0]` and `delta_xy[1]` become one column of pairs."""
    columns: dict[str, npt.NDArray[np.generic]] = {}
    for name, column in data.items():
        base, bracket, index = name.partition("[")
        if not bracket:
            if not name.startswith("_padding"):
                columns[name] = column
        elif index == "0]" and f"{base}[1]" in data:
            columns[base] = np.column_stack((column, data[f"{base}[1]"]))
    return columns
