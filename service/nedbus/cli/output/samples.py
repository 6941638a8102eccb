"""Text formats of samples: lines, terminal columns, all fields, JSON and CSV."""

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Final

from nedbus import Sample
from nedbus.clock import format_duration
from nedbus.errors import ConfigError
from nedbus.timings import TIMINGS
from nedbus_msgs import DEFAULT, Message, message_doubts
from nedbus_msgs.frames import derive, derived_from

from .streams import csv_line
from .table import COLUMN_GAP, fit_columns, terminal_width

_TIMES: Final = ("timestamp", "timestamp_sample")
_DIGITS: Final = {"float32": 9}  # enough to distinguish any two values; float64 is printed in full
_NAMED_FLAGS: Final = 8  # in a summary; of more, the false ones are counted
_SUMMARY_DIGITS: Final = {"float32": 6, "float64": 10}  # 1 mm of a latitude
_MIN_PAGE: Final = 10  # minimum number of lines between two headers
_FIELD_WIDTH: Final = 13  # characters; a longer value widens its column
_ADDRESS = "VEHICLE/TOPIC"
_POSITION = f"{'X m':>7} {'Y m':>7} {'Z m':>7}"
_STATE = "STATE"
_VELOCITY = f"{'VX m/s':>6} {'VY m/s':>6} {'VZ m/s':>6}"
_HEADING = "HDG deg"
_EPH = "EPH m"
_OPTIONAL: Final = (_EPH, _HEADING, _VELOCITY)  # in the order of removal on a narrow terminal


def to_line(sample: Sample[Any], fields: Sequence[str] = (), *, width: int = 38) -> str:
    """Format a sample as one line with these fields, or the most important ones; NED, metres, degrees.

    `width`: width of the address column.
    """
    message = sample.message
    start = f"{sample.address!s:<{width}} {message.timestamp / 1e6:12.3f} s"
    if fields:
        values = [f"{name} {_to_value(sample, name)}" for name in fields]
        return "  ".join([start, *values]) + _notes(sample)
    if message.DEFINITION is not DEFAULT:
        # a terminal cuts the end of the line
        return f"{start}{_notes(sample)}  {_to_summary(message)}"
    position = f"{message.x:9.3f} {message.y:9.3f} {message.z:9.3f}"
    velocity = f"{message.vx:7.3f} {message.vy:7.3f} {message.vz:7.3f}"
    heading = f"hdg {math.degrees(message.heading):6.1f}  eph {message.eph:6.2f}"
    return f"{start}  ned {position} m  v {velocity} m/s  {heading}  {_to_state(sample)}"


class Lines:
    """Format samples as lines; on a terminal in columns, with a header per screenful and when the columns change.

    A narrow terminal omits eph, then heading, then velocity, but never position, doubtful flags or loss.
    If stdout is not a terminal, lines are complete and have no header.
    """

    def __init__(self) -> None:
        self._widths: dict[str, int] = {}
        self._head = ""
        self._lines_left = 0  # before the next header

    def __call__(self, sample: Sample[Any], fields: Sequence[str] = ()) -> str:
        """Return the line of a sample, preceded by a header if one is due."""
        width = terminal_width()
        if width is None:
            return to_line(sample, fields)
        self._lines_left -= 1
        if not fields and sample.message.DEFINITION is not DEFAULT:
            # no columns: as much as fits into a line
            line = to_line(sample, width=self._widths.get(_ADDRESS, 0))
            if len(line) <= width:
                return line
            return f"{line[: width - 1]}…"
        cells = _to_cells(sample, fields)
        self._widths = {
            name: max(len(name), len(cell), self._widths.get(name, 0))
            for name, cell in cells.items()
        }
        columns = fit_columns(self._widths, _OPTIONAL, width)
        head = self._join(columns, columns)
        line = self._join(columns, [cells[name] for name in columns])
        if head == self._head and self._lines_left >= 0:
            return line
        self._head = head
        self._lines_left = max(_MIN_PAGE, shutil.get_terminal_size().lines - 1) - 2
        return f"{head}\n{line}"

    def _join(self, columns: Sequence[str], cells: Sequence[str]) -> str:
        """Join the cells of a line: address and state are text, the others numbers."""
        padded = [cell.rjust(self._widths[name]) for name, cell in zip(columns, cells, strict=True)]
        padded[0] = cells[0].ljust(self._widths[columns[0]])
        padded[-1] = cells[-1]
        return COLUMN_GAP.join(padded)


def _to_cells(sample: Sample[Any], fields: Sequence[str]) -> dict[str, str]:
    """Return the cells of these fields, or of a position, by the name of their column."""
    message = sample.message
    cells = {_ADDRESS: str(sample.address), "TIME s": f"{message.timestamp / 1e6:8.2f}"}
    if fields:
        for name in fields:
            cells[name] = _to_value(sample, name).rjust(_FIELD_WIDTH)
    else:
        cells[_POSITION] = f"{message.x:7.2f} {message.y:7.2f} {message.z:7.2f}"
        cells[_VELOCITY] = f"{message.vx:6.2f} {message.vy:6.2f} {message.vz:6.2f}"
        cells[_HEADING] = f"{math.degrees(message.heading):.1f}"
        cells[_EPH] = f"{message.eph:.2f}"
    cells[_STATE] = _to_state(sample)
    return cells


def _to_state(sample: Sample[Any]) -> str:
    """Return a sample's doubtful flags, or "ok"; then its age if old, and the number of messages lost before it."""
    state = "ok"
    if sample.message.DEFINITION is DEFAULT:
        state = message_doubts(sample.message, sample.missing)
    return state + _notes(sample)


def _to_summary(message: Message) -> str:
    """Return the numbers of a message by name, then its flags; unknown numbers are omitted.

    A false flag has its value; of a message with many flags, only the number of the false ones is shown.
    """
    numbers = []
    flags = []
    false_flags = []
    for name, kind in message.DEFINITION.types.items():
        value = getattr(message, name)
        if kind.base == "bool":
            if value is True:
                flags.append(name)
            else:
                false_flags.append(f"{name} {_to_number(value, None)}")
        elif name not in _TIMES and value != kind.absent and repr(value) != repr(kind.absent):
            numbers.append(f"{name} {_to_number(value, _SUMMARY_DIGITS.get(kind.base))}")
    if false_flags and len(flags) + len(false_flags) > _NAMED_FLAGS:
        false_flags = [f"({len(false_flags)} flags False)"]
    return "  ".join([*numbers, *flags, *false_flags])


def _notes(sample: Sample[Any]) -> str:
    notes = ""
    if sample.latency is not None and sample.latency > TIMINGS.old:
        notes += f"  [{format_duration(sample.latency)} old]"
    if sample.lost:
        notes += f"  [{sample.lost} lost]"
    return notes


def to_fields(sample: Sample[Any], fields: Sequence[str] = ()) -> str:
    """Format these fields, or all, one per line, like `ros2 topic echo`."""
    head = str(sample.address)
    if sample.latency is not None:
        head += f", {format_duration(sample.latency)} old"
    if sample.source is not None:
        head += f", from {sample.source}"
    if sample.stored:
        head += ", only stored"
    lines = [head]
    for name in fields or sample.message.DEFINITION.types:
        note = ""
        if name in sample.missing:
            note = " (not provided)"
        lines.append(f"  {name}: {_to_value(sample, name)}{note}")
    return "\n".join([*lines, "---"])


def to_json(sample: Sample[Any], fields: Sequence[str] = ()) -> str:
    """Format a sample as one line of JSON; non-finite numbers are the strings NaN, Infinity and -Infinity."""
    head: dict[str, object] = asdict(sample.address)
    for name in ("received", "sent", "lost", "source"):
        head[name] = getattr(sample, name)
    head["missing"] = sorted(sample.missing)
    if sample.stored:
        head["stored"] = True
    message = sample.message.model_dump_json(include=set(fields) or None)
    derived = [name for name in fields if _is_derived(sample.message, name)]
    if derived:
        values = json.loads(message)
        for name in derived:
            value = derive(sample.message, name)
            if math.isfinite(value):
                values[name] = value
            else:
                values[name] = "NaN"
        message = json.dumps(values, separators=(",", ":"))
    return f'{json.dumps(head)[:-1]}, "message": {message}}}'


class CsvLines:
    """Format samples as lines of CSV, preceded by a header line.

    Raises ConfigError for a sample whose columns differ from those of the first one.
    """

    def __init__(self) -> None:
        self._head: tuple[str, ...] = ()

    def __call__(self, sample: Sample[Any], fields: Sequence[str] = ()) -> str:
        """Return the line of a sample."""
        row = _to_row(sample, fields)
        head = tuple(name for name, _ in row)
        line = csv_line(cell for _, cell in row)
        if not self._head:
            self._head = head
            return f"{csv_line(head)}\n{line}"
        if head != self._head:
            text = f"a CSV table has only one message type, but {sample.address} has another: select a topic"
            raise ConfigError("--csv", text)
        return line


def _to_row(sample: Sample[Any], fields: Sequence[str] = ()) -> list[tuple[str, object]]:
    """Return names and cells of a CSV row; an array has one cell per element, an absent field an empty cell."""
    message = sample.message
    row: list[tuple[str, object]] = [*asdict(sample.address).items()]
    row.append(("utc", sample.stamp and sample.stamp.get_time().isoformat()))
    row.append(("sent", sample.sent))
    row.append(("timestamp", message.timestamp))
    for name in fields or message.DEFINITION.types:
        if name == "timestamp":
            continue
        if _is_derived(message, name):
            row.append((name, str(derive(message, name))))
            continue
        value = getattr(message, name, "")
        digits = _digits_of(message, name)
        if not isinstance(value, tuple):
            row.append((name, _to_number(value, digits)))
            continue
        for index, element in enumerate(value):
            row.append((f"{name}[{index}]", _to_number(element, digits)))
    if message.DEFINITION is DEFAULT:
        row.append(("state", message_doubts(message, sample.missing)))
    return row


def _is_derived(message: Message, name: str) -> bool:
    """Return True for a field that is not PX4's, but derived from its fields."""
    types = message.DEFINITION.types
    return name not in types and name in derived_from(types)


def _digits_of(message: Message, name: str) -> int | None:
    kind = message.DEFINITION.types.get(name)
    if kind is None:
        return None
    return _DIGITS.get(kind.base)


def _to_value(sample: Sample[Any], name: str) -> str:
    message = sample.message
    if _is_derived(message, name):
        return f"{derive(message, name):.9g}"
    if name not in message.DEFINITION.types:
        return "-"
    return _to_number(getattr(message, name), _digits_of(message, name))


def _to_number(value: object, digits: int | None) -> str:
    """Format a value, or the elements of an array, with `digits` significant digits; None: all digits."""
    if isinstance(value, tuple):
        return " ".join(_to_number(element, digits) for element in value)
    if isinstance(value, str):
        return value.replace("\n", "\\n")
    if digits is None:
        return str(value)
    return f"{value:.{digits}g}"
