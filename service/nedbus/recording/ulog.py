"""Read the local position topics of a PX4 .ulg log as columns."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt
from pyulog import ULogException

from nedbus.errors import AddressError, SourceError
from nedbus_msgs import FIELD_TYPES, TOPICS, Address, get_topic

from .formats import open_flight

_MESSAGE_HEADER: Final = 3  # bytes
_FILE_HEADER: Final = 16  # bytes
_MESSAGE_TYPES: Final = frozenset(b"BFIMPQARDLCSO")
_READ_COST: Final = 4096  # of any read, in bytes, however short it is
_BUDGET: Final = 2**31  # bytes that may be read of a damaged log, beside what its size makes plausible
_DTYPES: Final = {"uint64": "<u8", "uint8": "u1", "bool": "i1", "float32": "<f4", "float64": "<f8"}  # of pyulog
_ALWAYS: Final = {"timestamp", "x", "y", "z", "vx", "vy", "vz", "xy_valid", "z_valid", "v_xy_valid", "v_z_valid"}
_READ_ERRORS: Final = (ULogException, ValueError, TypeError, KeyError, IndexError, AttributeError, MemoryError)

UlogColumns = Mapping[str, npt.NDArray[np.generic]]
"""One topic of a log: PX4's field names, and the values of all messages; delta_xy and delta_vxy have two columns."""


@dataclass(slots=True)
class UlogTopics:
    """The local position topics of a log, each with its columns by PX4's field names.

    `warnings`: what is damaged or left out; `damaged`: whether damage may have cost messages.
    A log has no checksums: damage inside the values of a message cannot be noticed.
    """

    topics: list[tuple[Address, UlogColumns]]
    warnings: list[str]
    damaged: bool


def read_ulog(path: Path, *, vehicle: str | None = None, default_vehicle: str = "1") -> UlogTopics:
    """Return each local position topic of a log.

    `vehicle` is the log's MAV_SYS_ID unless it is given, and `default_vehicle` if the log has none.

    Raises SourceError when it is not a ULog file, or has none of the topics.
    """
    log, damage = _load(path)
    found = UlogTopics([], damage, bool(damage))
    vehicle = vehicle or _system_id(log) or default_vehicle
    seen: set[tuple[str, int]] = set()
    for data in log.data_list:
        try:
            address = Address(vehicle, data.name, data.multi_id if get_topic(data.name).instances else None)
        except AddressError as exc:
            found.warnings.append(f"{data.name} is left out: {exc}")
            found.damaged = True
            continue
        columns = _by_field(data.data)
        wrong = {name for name, column in columns.items() if not _has_type(name, column)}
        lacking = _ALWAYS - columns.keys()
        if wrong or lacking:
            names = ", ".join(sorted(wrong | lacking))
            found.warnings.append(f"{data.name} [{data.multi_id}]: the definition of {names} is damaged")
            found.damaged = True
        if any(address == other for other, _ in found.topics):
            found.warnings.append(f"{data.name} [{data.multi_id}] is left out: a second one")
            found.damaged |= (data.name, data.multi_id) in seen
        elif not wrong and "timestamp" in columns:
            found.topics.append((address, columns))
        seen.add((data.name, data.multi_id))
    if not found.topics:
        reason = "no message of the local position topics is in this log"
        raise SourceError(str(path), "; ".join([reason, *found.warnings[:3]]))
    return found


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


def _load_pyulog() -> ModuleType:
    """Return a copy of pyulog that only this module uses: with a `print` of its own."""
    spec = find_spec("pyulog.core")
    if spec is None or spec.loader is None:
        raise ModuleNotFoundError(name="pyulog")
    module = module_from_spec(spec)
    vars(module)["print"] = _capture
    spec.loader.exec_module(module)
    return module


_pyulog = _load_pyulog()


def _load(path: Path) -> tuple[Any, list[str]]:
    """Return pyulog's ULog, and what is damaged."""
    _printed.lines = []
    try:
        with open_flight(path) as file:
            bounded = _BoundedFile(file, path.stat().st_size)
            log = _pyulog.ULog(bounded, list(TOPICS))
        end = None if log.has_data_appended else _find_damage(path)
    except OSError as exc:
        raise SourceError(str(path), (exc.strerror or str(exc)).lower()) from exc
    except _READ_ERRORS as exc:
        raise SourceError(str(path), f"not a readable ULog file ({exc})") from exc
    damage = [f"damaged: {line}" for line in _printed.lines[:5]]
    if log.file_corruption and not damage:
        damage.append("damaged: parts of it were skipped")
    elif bounded.cut:
        damage.append("cut: it ends inside a message")
    elif end is not None and not damage:
        damage.append(f"damaged: no message begins at byte {end}")
    return log, damage


def _find_damage(path: Path) -> int | None:
    """Return where a log does not go on with a message, as pyulog skips what it does not know without a word."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(_FILE_HEADER)
        while head := file.read(_MESSAGE_HEADER):
            end = file.tell() + int.from_bytes(head[:2], "little")
            if len(head) < _MESSAGE_HEADER or head[2] not in _MESSAGE_TYPES or end > size:
                return file.tell() - len(head)
            file.seek(end)
    return None


def _has_type(name: str, column: npt.NDArray[np.generic]) -> bool:
    """Return whether a column has PX4's type of the field, if it is one of ours: no release ever changed one."""
    base, _, pair = FIELD_TYPES.get(name, "").partition("[")
    return not base or (column.dtype == np.dtype(_DTYPES[base]) and column.shape[1:] == ((2,) if pair else ()))


def _system_id(log: Any) -> str | None:
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
