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
        return "  ".join(
            [start, *(f"{name} {_to_value(sample, name)}" for name in fields)]
        ) + _notes(sample)
    if message.DEFINITION is not DEFAULT:
        # a terminal cuts the end of the line
        return f"{start}{_notes(sample)}  {_to_summary(message)}"
    position = " ".join(f"{value:9.3f}" for value in (message.x, message.y, message.z))
    velocity = " ".join(f"{value:7.3f}" for value in (message.vx, message.vy, message.vz))
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
        width, message = terminal_width(), sample.message
        if width is None:
            return to_line(sample, fields)
        self._lines_left -= 1
        # no columns: as much as fits into a line
        if not fields and message.DEFINITION is not DEFAULT:
            line = to_line(sample, width=self._widths.get(_ADDRESS, 0))
            return line if len(line) <= width else f"{line[: width - 1]}…"
        cells = {_ADDRESS: str(sample.address), "TIME s": f"{message.timestamp / 1e6:8.2f}"}
        if fields:
            cells |= {name: _to_value(sample, name).rjust(_FIELD_WIDTH) for name in fields}
        else:
            cells[_POSITION] = " ".join(
                f"{value:7.2f}" for value in (message.x, message.y, message.z)
            )
            cells[_VELOCITY] = " ".join(
                f"{value:6.2f}" for value in (message.vx, message.vy, message.vz)
            )
            cells |= {_HEADING: f"{math.degrees(message.heading):.1f}", _EPH: f"{message.eph:.2f}"}
        cells[_STATE] = _to_state(sample)
        self._widths = {
            name: max(len(name), len(cell), self._widths.get(name, 0))
            for name, cell in cells.items()
        }
        shown = fit_columns(self._widths, _OPTIONAL, width)
        head = self._join({name: name for name in shown})
        line = self._join({name: cells[name] for name in shown})
        if head == self._head and self._lines_left >= 0:
            return line
        self._head = head
        self._lines_left = max(_MIN_PAGE, shutil.get_terminal_size().lines - 1) - 2
        return f"{head}\n{line}"

    def _join(self, cells: dict[str, str]) -> str:
        address, *numbers, state = cells.items()
        padded = [cell.rjust(self._widths[name]) for name, cell in numbers]
        return COLUMN_GAP.join([address[1].ljust(self._widths[_ADDRESS]), *padded, state[1]])


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
    if len(flags) + len(false_flags) > _NAMED_FLAGS:
        false_flags = [f"({len(false_flags)} flags False)"] if false_flags else []
    flags += false_flags
    return "  ".join([*numbers, *flags])


def _notes(sample: Sample[Any]) -> str:
    lost = f"  [{sample.lost} lost]" if sample.lost else ""
    age = sample.latency or 0.0
    old = f"  [{format_duration(age)} old]" if age > TIMINGS.old else ""
    return f"{old}{lost}"


def to_fields(sample: Sample[Any], fields: Sequence[str] = ()) -> str:
    """Format these fields, or all, one per line, like `ros2 topic echo`."""
    age = "" if sample.latency is None else f", {format_duration(sample.latency)} old"
    source = "" if sample.source is None else f", from {sample.source}"
    stored = ", only stored" if sample.stored else ""
    missing, lines = sample.missing, [f"{sample.address}{age}{source}{stored}"]
    lines += [
        f"  {name}: {_to_value(sample, name)}{' (not provided)' if name in missing else ''}"
        for name in fields or sample.message.DEFINITION.types
    ]
    return "\n".join([*lines, "---"])


def to_json(sample: Sample[Any], fields: Sequence[str] = ()) -> str:
    """Format a sample as one line of JSON; non-finite numbers are the strings NaN, Infinity and -Infinity."""
    head = asdict(sample.address) | {
        name: getattr(sample, name) for name in ("received", "sent", "lost", "source")
    }
    head |= {"missing": sorted(sample.missing)} | ({"stored": True} if sample.stored else {})
    message = sample.message.model_dump_json(include=set(fields) or None)
    derived = {
        name: derive(sample.message, name) for name in _derived_fields(sample.message, fields)
    }
    if derived:
        numbers = {
            name: value if math.isfinite(value) else "NaN" for name, value in derived.items()
        }
        message = json.dumps(json.loads(message) | numbers, separators=(",", ":"))
    return f'{json.dumps(head)[:-1]}, "message": {message}}}'


class CsvLines:
    """Format samples as lines of CSV, preceded by a header line.

    Raises ConfigError for a sample whose columns differ from those of the first one.
    """

    def __init__(self) -> None:
        self._head: tuple[str, ...] = ()

    def __call__(self, sample: Sample[Any], fields: Sequence[str] = ()) -> str:
        """Return the line of a sample."""
        head, cells = zip(*_to_row(sample, fields), strict=True)
        if not self._head:
            self._head = head
            return f"{csv_line(head)}\n{csv_line(cells)}"
        if head != self._head:
            text = f"a CSV table has only one message type, but {sample.address} has another: select a topic"
            raise ConfigError("--csv", text)
        return csv_line(cells)


def _to_row(sample: Sample[Any], fields: Sequence[str] = ()) -> list[tuple[str, object]]:
    """Return names and cells of a CSV row; an array has one cell per element, an absent field an empty cell."""
    address, message = sample.address, sample.message
    row: list[tuple[str, object]] = [
        *asdict(address).items(),
        ("utc", sample.stamp and sample.stamp.get_time().isoformat()), ("sent", sample.sent),
        ("timestamp", message.timestamp),
    ]  # fmt: skip
    types = message.DEFINITION.types
    for name in fields or types:
        if name == "timestamp":
            continue
        if name in _derived_fields(message, fields):
            row.append((name, str(derive(message, name))))
            continue
        value = getattr(message, name, "")
        digits = _DIGITS.get(types[name].base) if name in types else None
        if isinstance(value, tuple):
            row += [
                (f"{name}[{index}]", _to_number(element, digits))
                for index, element in enumerate(value)
            ]
        else:
            row.append((name, _to_number(value, digits)))
    if message.DEFINITION is DEFAULT:
        row.append(("state", message_doubts(message, sample.missing)))
    return row


def _derived_fields(message: Message, fields: Sequence[str]) -> list[str]:
    """Return those of the fields that are not PX4's, but derived from its fields."""
    known = derived_from(message.DEFINITION.types)
    return [name for name in fields if name in known]


def _to_value(sample: Sample[Any], name: str) -> str:
    if _derived_fields(sample.message, [name]):
        return f"{derive(sample.message, name):.9g}"
    kind = sample.message.DEFINITION.types.get(name)
    if kind is None:
        return "-"
    return _to_number(getattr(sample.message, name), _DIGITS.get(kind.base))


def _to_number(value: object, digits: int | None) -> str:
    """Format a value, or the elements of an array, with `digits` significant digits; None: all digits."""
    if isinstance(value, tuple):
        return " ".join(_to_number(element, digits) for element in value)
    if isinstance(value, str):
        return value.replace("\n", "\\n")
    return str(value) if digits is None else f"{value:.{digits}g}"
