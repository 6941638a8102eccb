"""Samples as text: a line, columns of a terminal, all fields, JSON and CSV."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from typing import Any, Final

from nedbus.client import Sample, to_age
from nedbus_msgs import ANY, DEFAULT, TOPICS, Message, Selection, get_topic, message_doubts

from .table import COLUMN_GAP, terminal_width

_TIMES: Final = ("timestamp", "timestamp_sample")
_DIGITS: Final = {"float32": 9}  # which distinguish any two of them; those of a float64 are all there are
_SUMMARY_DIGITS: Final = {"float32": 6, "float64": 10}  # 1 mm of a latitude
_OLD: Final = 1.0  # s of latency from which on a line shows it: the last value of a stream that ended, or recovered

_MAX_ADDRESS_SHARE: Final = 3  # of a line without columns: its address gets a third at most
_MIN_PAGE: Final = 10  # lines between two headings, on the lowest terminal
_HEAD, _TAIL = 3, 4  # characters that are kept of a topic at least
_MIN_TOPIC: Final = _HEAD + 1 + _TAIL
# Characters of a value; a longer one widens its column.
_FIELD_WIDTHS: Final = {"uint64": 12, "int64": 12, "uint8": 3, "int8": 3, "bool": 5, "float32": 13, "float64": 18}
_OTHER_WIDTH: Final = 10
_ADDRESS, _POSITION, _STATE = "VEHICLE/TOPIC", f"{'X m':>7} {'Y m':>7} {'Z m':>7}", "STATE"
_VELOCITY, _HEADING, _EPH = f"{'VX m/s':>6} {'VY m/s':>6} {'VZ m/s':>6}", "HDG deg", "EPH m"
_OPTIONAL: Final = (_EPH, _HEADING, _VELOCITY)  # in the order in which a narrow terminal leaves them out


def to_line(sample: Sample[Any], fields: Sequence[str] = (), *, address: str = "") -> str:
    """Return one line with these fields, or with the most important ones; NED, metres, degrees."""
    message = sample.message
    start = f"{address or f'{sample.address!s:<38}'} {message.timestamp / 1e6:12.3f} s"
    if fields:
        return "  ".join([start, *(f"{name} {_to_value(sample, name)}" for name in fields)]) + _notes(sample)
    if not _is_position(message):
        return f"{start}{_notes(sample)}  {_to_summary(message)}"  # whose end has no room on a terminal
    position = " ".join(f"{value:9.3f}" for value in (message.x, message.y, message.z))
    velocity = " ".join(f"{value:7.3f}" for value in (message.vx, message.vy, message.vz))
    heading = f"hdg {math.degrees(message.heading):6.1f}  eph {message.eph:6.2f}"
    return f"{start}  ned {position} m  v {velocity} m/s  {heading}  {_to_state(sample)}"


class Lines:
    """Format samples as lines: on a terminal in columns, with a heading in each screenful and when the columns change.

    A terminal that is too narrow shows no eph, then no heading, then no velocity, and at last no middle of the topic;
    position, doubts and loss always. Where stdout is no terminal, a line is complete and has no heading.
    """

    def __init__(self, selection: Selection) -> None:
        topics = TOPICS.values() if selection.topic == ANY else [get_topic(selection.topic)]
        self._topic = max(len(f"/{topic.name}{'/0' * (topic.instances is not False)}") for topic in topics)
        self._address = self._min_address = 0
        self._widths: dict[str, int] = {}  # of the columns of this page
        self._left = 0  # lines of this page
        self._layout: dict[str, int] = {}

    def __call__(self, sample: Sample, fields: Sequence[str] = ()) -> str:
        """Return the line of a sample, after a heading if one is due."""
        width = terminal_width()
        if width is None:
            return to_line(sample, fields)
        self._left -= 1
        address = str(sample.address)
        if not fields and not _is_position(sample.message):  # it has no columns: all that fits into a line
            room = min(max(self._topic + len(sample.vehicle), len(address)), width // _MAX_ADDRESS_SHARE)
            line = to_line(sample, address=f"{_shorten_address(address, room):<{room}}")
            return line if len(line) <= width else f"{line[: width - 1]}…"
        if self._left < 0:
            self._widths = {}
        self._address = max(self._address, len(address), len(sample.vehicle) + self._topic)
        self._min_address = max(self._min_address, len(sample.vehicle) + 1 + _MIN_TOPIC)
        cells = {_ADDRESS: address, **_cells(sample, fields), _STATE: _to_state(sample)}
        for name, cell in cells.items():
            self._widths[name] = max(self._widths.get(name, 0), len(name), len(cell))
        layout = self._fit(width)
        cells[_ADDRESS] = _shorten_address(address, layout[_ADDRESS])
        line = _join(cells, layout)
        if layout == self._layout and self._left >= 0:
            return line
        self._layout = layout
        self._left = max(_MIN_PAGE, shutil.get_terminal_size().lines - 1) - 2
        return f"{_join({name: name for name in layout}, layout)}\n{line}"

    def _fit(self, width: int) -> dict[str, int]:
        """Return the columns that fit, with their widths; that of the state has none, as it is the last one."""
        columns = self._widths | {_ADDRESS: 0}
        for name in (None, *_OPTIONAL):
            columns.pop(name or "", None)
            room = width - sum(columns.values()) - len(COLUMN_GAP) * (len(columns) - 1)
            if room >= self._address:
                break
        return columns | {_ADDRESS: min(self._address, max(room, self._min_address)), _STATE: 0}


def _shorten_address(address: str, width: int) -> str:
    """Return an address without the middle of its topic that does not fit; the topics of positions stay different."""
    vehicle, _, topic = address.partition("/")
    room = max(_MIN_TOPIC, width - len(vehicle) - 1)
    if len(topic) <= room:
        return address
    tail = _TAIL + (room - _MIN_TOPIC) // 2
    return f"{vehicle}/{topic[: room - 1 - tail]}…{topic[-tail:]}"


def _join(cells: dict[str, str], layout: dict[str, int]) -> str:
    """Return the cells of the columns that are shown; numbers are aligned to the right."""
    text = {_ADDRESS, _STATE}
    return COLUMN_GAP.join(
        cells[name].ljust(width) if name in text else cells[name].rjust(width) for name, width in layout.items()
    )


def _cells(sample: Sample[Any], fields: Sequence[str]) -> dict[str, str]:
    """Return time, then these fields, or position, velocity, heading and eph, by their headings; NED, degrees."""
    message = sample.message
    time = {"TIME s": f"{message.timestamp / 1e6:8.2f}"}
    if fields:
        return time | {name: f"{_to_value(sample, name):>{_width_of(sample, name)}}" for name in fields}
    return time | {
        _POSITION: " ".join(f"{value:7.2f}" for value in (message.x, message.y, message.z)),
        _VELOCITY: " ".join(f"{value:6.2f}" for value in (message.vx, message.vy, message.vz)),
        _HEADING: f"{math.degrees(message.heading):.1f}",
        _EPH: f"{message.eph:.2f}",
    }


def _width_of(sample: Sample[Any], name: str) -> int:
    kind = sample.message.DEFINITION.types.get(name)
    return kind.count * (_FIELD_WIDTHS.get(kind.base, _OTHER_WIDTH) + 1) - 1 if kind else 1


def _to_state(sample: Sample[Any]) -> str:
    """Return what casts doubt on a sample, or "ok"; then its age, if it is old, and the number lost before it."""
    return (message_doubts(sample.message) if _is_position(sample.message) else "ok") + _notes(sample)


def _is_position(message: Message) -> bool:
    """Return whether this is the message whose position, flags and doubts are shown."""
    return message.DEFINITION is DEFAULT


def _to_summary(message: Message) -> str:
    """Return the numbers of a message by name, then the flags that are set; what is not known is left out."""
    numbers, flags = [], []
    for name, kind in message.DEFINITION.types.items():
        value = getattr(message, name)
        if kind.base == "bool":
            flags += [name] if value is True else []
        elif name not in _TIMES and value != kind.absent and repr(value) != repr(kind.absent):
            numbers.append(f"{name} {_to_number(value, _SUMMARY_DIGITS.get(kind.base))}")
    return "  ".join([*numbers, *flags])


def _notes(sample: Sample[Any]) -> str:
    lost = f"  [{sample.lost} lost]" if sample.lost else ""
    old = f"  [{to_age(sample.latency)} old]" if sample.latency is not None and sample.latency > _OLD else ""
    return f"{old}{lost}"


def to_fields(sample: Sample[Any], fields: Sequence[str] = ()) -> str:
    """Return these fields, or all, each on a line of its own, as `ros2 topic echo` does."""
    age = "" if sample.latency is None else f", {to_age(sample.latency)} old"
    source = "" if sample.source is None else f", from {sample.source}"
    stored = ", only stored" if sample.stored else ""
    missing, lines = sample.missing, [f"{sample.address}{age}{source}{stored}"]
    lines += [
        f"  {name}: {_to_value(sample, name)}{' (not provided)' if name in missing else ''}"
        for name in fields or sample.message.DEFINITION.types
    ]
    return "\n".join([*lines, "---"])


def to_json(sample: Sample[Any], fields: Sequence[str] = ()) -> str:
    """Return one line of JSON; non-finite numbers are the strings NaN, Infinity and -Infinity."""
    head = {
        "vehicle": sample.vehicle,
        "topic": sample.topic,
        "instance": sample.address.instance,
        "received": sample.received,
        "sent": sample.sent,
        "lost": sample.lost,
        "source": sample.source,
        "missing": sorted(sample.missing),
        **({"stored": True} if sample.stored else {}),
    }
    message = sample.message.model_dump_json(include=set(fields) or None)
    return f'{json.dumps(head)[:-1]}, "message": {message}}}'


def to_row(sample: Sample[Any], fields: Sequence[str] = ()) -> list[tuple[str, object]]:
    """Return the names and cells of a row of CSV: the address, when it was sent [ns], PX4's time [us], these fields.

    An array has a cell for each element; a field that this message does not have is empty.
    """
    address, message = sample.address, sample.message
    row: list[tuple[str, object]] = [
        ("vehicle", address.vehicle), ("topic", address.topic), ("instance", address.instance),
        ("sent", sample.sent), ("timestamp", message.timestamp),
    ]  # fmt: skip
    types = message.DEFINITION.types
    for name in fields or types:
        if name == "timestamp":
            continue
        value = getattr(message, name, "")
        digits = _DIGITS.get(types[name].base) if name in types else None
        if isinstance(value, tuple):
            row += [(f"{name}[{index}]", _to_number(each, digits)) for index, each in enumerate(value)]
        else:
            row.append((name, _to_number(value, digits)))
    return row


def _to_value(sample: Sample[Any], name: str) -> str:
    """Return the value of a field as text, "-" for one that this message does not have."""
    kind = sample.message.DEFINITION.types.get(name)
    return "-" if kind is None else _to_number(getattr(sample.message, name), _DIGITS.get(kind.base))


def _to_number(value: object, digits: int | None) -> str:
    """Return a value, or those of an array, with this number of significant digits, or with all there are."""
    if isinstance(value, tuple):
        return " ".join(_to_number(each, digits) for each in value)
    return str(value) if digits is None else f"{value:.{digits}g}"
