"""Reader of PX4 .ulg logs; topics are returned as columns."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec, module_from_spec
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt
from pyulog import ULogException

from nedbus.errors import AddressError, SourceError
from nedbus_msgs import BASES, BY_TOPIC, TOPICS, Address, Definition, FieldType, define, field_type

from .flight_files import open_flight

_MESSAGE_HEADER: Final = 3  # bytes
_FILE_HEADER: Final = 16  # bytes
_MESSAGE_TYPES: Final = frozenset(b"BFIMPQARDLCSO")
_MIN_READ_COST: Final = 4096  # bytes charged to the budget per read, in addition to its size
_BUDGET: Final = 2**31  # bytes that may be read from a log, plus 1000 times its size
_MAX_FIELDS: Final = 1000  # fields read from a format; real messages have fewer
_MAX_NESTING: Final = 3  # levels of nested messages; PX4 has one
_INDEX = re.compile(r"\[(\d+)\]")
_OLDEST: Final = 0x010D  # PX4 1.13, the oldest release with known layouts
_FLOATS: Final = {"float": "float32", "double": "float64"}  # C's names, as in the log; its integers end with _t
_READ_ERRORS: Final = (ULogException, ValueError, TypeError, KeyError, IndexError, AttributeError, MemoryError)

UlogColumns = Mapping[str, npt.NDArray[np.generic]]
"""The values of all messages of one topic, by PX4's field name; array fields have one row per message."""


@dataclass(frozen=True, slots=True)
class UlogTopic:
    """One topic of a log; its message definition is known to nedbus, or comes from the log."""

    address: Address
    definition: Definition[Any]
    columns: UlogColumns


@dataclass(slots=True)
class UlogTopics:
    """Topics of a log.

    `warnings`: damage and skipped parts; `damaged`: True if damage may have cost messages.
    Logs have no checksums: damage to the values of a message goes undetected.
    """

    topics: dict[Address, UlogTopic]
    warnings: list[str]
    damaged: bool


def read_ulog(
    path: Path, *, topics: Collection[str] | None = TOPICS, vehicle: str | None = None, default_vehicle: str = "1"
) -> UlogTopics:
    """Read topics of a log, all for None; messages unknown to nedbus are defined by the log's formats.

    `vehicle`: by default the log's MAV_SYS_ID; `default_vehicle` is used if the log has none.

    Raises SourceError if the file is not a ULog file, or has none of the topics.
    """
    log, damage = _load(path, topics)
    found = UlogTopics({}, damage, bool(damage))
    vehicle = vehicle or _system_id(log) or default_vehicle
    several = {data.name for data in log.data_list if data.multi_id > 0}
    for data in log.data_list:
        name = f"{data.name} [{data.multi_id}]"
        try:
            definition = BY_TOPIC.get(data.name) or _describe(log.message_formats, data.name)
            instances = TOPICS[data.name].instances if data.name in TOPICS else data.name in several
            address = Address(vehicle, data.name, data.multi_id if instances else None)
        except (AddressError, ValueError) as exc:
            found.warnings.append(f"skipped {data.name}: {exc}")
            found.damaged |= data.name in TOPICS or isinstance(exc, AddressError)
            continue
        columns = _by_field(data.data)
        if data.name not in BY_TOPIC:  # types are the log's own, except that pyulog reads char as int8
            chars = [field for field, kind in definition.types.items() if kind.base == "uint8" and field in columns]
            columns |= {field: columns[field].view(np.uint8) for field in chars}
        known = definition.known_types
        wrong = {field for field, column in columns.items() if field in known and not _has_type(known[field], column)}
        if wrong and _is_older(log):
            found.warnings.append(f"{name}: skipped {', '.join(sorted(wrong))}, which had another type before PX4 1.13")
            columns = {field: column for field, column in columns.items() if field not in wrong}
            wrong = set()
        lacking = definition.always - columns.keys()
        if wrong or lacking:
            names = ", ".join(sorted(wrong | lacking))
            found.warnings.append(f"{name}: the definition of {names} is damaged")
            found.damaged = True
        if address in found.topics:
            if not _equal(found.topics[address].columns, columns):
                found.warnings.append(f"skipped a second {name} with other messages")
                found.damaged |= instances or data.multi_id == 0
        elif not wrong and "timestamp" in columns:
            found.topics[address] = UlogTopic(address, definition, columns)
    if not found.topics:
        wanted = "any topic" if topics is None else "these topics" if len(topics) < len(TOPICS) else "a known topic"
        raise SourceError(str(path), "; ".join([f"this log has no message of {wanted}", *found.warnings[:3]]))
    return found


def _equal(one: UlogColumns, other: UlogColumns) -> bool:
    """Return whether two topics have the same messages; PX4 can log a topic twice."""
    return one.keys() == other.keys() and all(one[name].tobytes() == other[name].tobytes() for name in one)


def _describe(formats: Mapping[str, Any], topic: str) -> Definition[Any]:
    """Return the definition of a message from the log's formats; raise ValueError if it is invalid."""
    name = "".join(part.capitalize() for part in topic.split("_"))
    return _define(name, tuple(islice(_fields(formats, topic), _MAX_FIELDS)))


_define = lru_cache(1024)(define)  # shared by all instances and logs, since codecs are cached per definition


def _fields(formats: Mapping[str, Any], name: str, prefix: str = "", level: int = 0) -> Iterator[tuple[str, FieldType]]:
    """Yield field names and types of a format; fields of a nested message are prefixed with its field name."""
    for kind, length, field in formats[name].fields:
        if field.startswith("_padding"):
            continue
        if kind not in formats or not formats[kind].fields:
            base = _FLOATS.get(kind, kind.removesuffix("_t"))
            yield f"{prefix}{field}", field_type(f"{base}[{length}]" if length > 0 else base)
        elif level < _MAX_NESTING:
            for index in range(length) if length > 0 else [None]:
                inner = f"{prefix}{field}_" if index is None else f"{prefix}{field}_{index}_"
                yield from _fields(formats, kind, inner, level + 1)


class _BoundedFile:
    """A file with a read budget in bytes: pyulog can loop on a damaged file."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file = file
        self._budget = _BUDGET + 1000 * size
        self.seek = file.seek
        self.tell = file.tell
        self.close = file.close

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(size)
        self._budget -= _MIN_READ_COST + len(data)
        if self._budget < 0:
            raise ULogException("invalid structure: its records form a loop")
        return data


def _load_pyulog(printed: list[str]) -> ModuleType:
    """Return a copy of pyulog that appends its warnings to `printed`, because a library must not write to stdout."""
    spec = find_spec("pyulog.core")
    if spec is None or spec.loader is None:
        raise ModuleNotFoundError(name="pyulog")
    module = module_from_spec(spec)
    vars(module)["print"] = lambda *values: printed.append(" ".join(map(str, values)))
    spec.loader.exec_module(module)
    return module


def _load(path: Path, topics: Collection[str] | None) -> tuple[Any, list[str]]:
    """Return pyulog's ULog and a list of the damage found."""
    damage: list[str] = []
    try:
        with open_flight(path) as file:
            bounded = _BoundedFile(file, path.stat().st_size)
            log = _load_pyulog(damage).ULog(bounded, None if topics is None else list(topics))
        end = "" if log.has_data_appended else _find_damage(path)
    except OSError as exc:
        raise SourceError(str(path), (exc.strerror or str(exc)).lower()) from exc
    except _READ_ERRORS as exc:
        raise SourceError(str(path), f"not a readable ULog file ({exc})") from exc
    if damage:
        return log, [f"damaged: {line}" for line in damage[:5]]
    if log.file_corruption:
        return log, ["damaged: parts were skipped"]
    return log, [end] if end else []


def _find_damage(path: Path) -> str:
    """Return the first structural damage of a log, "" if there is none; pyulog skips unknown messages silently."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(_FILE_HEADER)
        while head := file.read(_MESSAGE_HEADER):
            if len(head) == _MESSAGE_HEADER and head[2] not in _MESSAGE_TYPES:
                return f"damaged: no message begins at byte {file.tell() - len(head)}"
            end = file.tell() + int.from_bytes(head[:2], "little")
            if len(head) < _MESSAGE_HEADER or end > size:
                return "truncated: the file ends inside a message"
            file.seek(end)
    return ""


def _has_type(kinds: Iterable[FieldType], column: npt.NDArray[np.generic]) -> bool:
    """Return whether a column has one of the PX4 types of its field; pyulog reads bool as int8."""
    return any(
        column.dtype == np.dtype("i1" if kind.base == "bool" else BASES[kind.base].code)
        and column.shape[1:] == ((kind.length,) if kind.length else ())
        for kind in kinds
    )


def _is_older(log: Any) -> bool:
    """Return whether a log was written by a release before the oldest known layouts."""
    release = log.msg_info_dict.get("ver_sw_release")
    return isinstance(release, int) and 0 < release >> 16 < _OLDEST


def _system_id(log: Any) -> str | None:
    """Return the MAVLink system id of the vehicle that wrote the log."""
    value = log.initial_parameters.get("MAV_SYS_ID")
    return str(value) if isinstance(value, int) and 0 < value < 256 else None


def _by_field(data: Mapping[str, npt.NDArray[np.generic]]) -> dict[str, npt.NDArray[np.generic]]:
    """Return the columns by PX4's field names: `q[0]` to `q[3]` become one array, `esc[0].rpm` becomes `esc_0_rpm`."""
    parts: dict[str, list[npt.NDArray[np.generic]]] = {}
    arrays: set[str] = set()
    for name, column in data.items():
        *outer, last = name.split(".")
        base, bracket, _ = last.partition("[")
        field = "_".join([*(_INDEX.sub(r"_\1", part) for part in outer), base])
        if not base.startswith("_padding"):
            parts.setdefault(field, []).append(column)
            arrays.update({field} if bracket else ())
    return {name: np.column_stack(part) if name in arrays else part[0] for name, part in parts.items()}
