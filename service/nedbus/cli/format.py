"""Format samples and values as text, for a person or a program; nothing from the network reaches a terminal raw."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from typing import Any, Final

from nedbus.client import Sample, to_age
from nedbus_msgs import DEFAULT, Message, message_doubts

MAX_TEXT: Final = 1000
"""Characters that are shown of an error or a line of the log."""

_MAX_CELL: Final = 120  # characters that are shown of a value that some peer sent
_TIMES: Final = ("timestamp", "timestamp_sample")
_DIGITS: Final = {"float32": 9}  # which distinguish any two of them; those of a float64 are all there are
_FEWER: Final = {"float32": 6, "float64": 10}  # in a line of all that a message says: 1 mm of a latitude
_OLD: Final = 1.0  # s of latency from which on a line shows it: the last value of a stream that ended, or recovered


def printable(text: str) -> str:
    """Return text whose control characters are spelt out, so that none acts on a terminal; lines stay lines."""
    if text.isascii() and text.replace("\n", "").isprintable():
        return text
    return "".join(
        char if char.isprintable() or char == "\n" else char.encode("unicode_escape").decode() for char in text
    )


def to_text(value: object, limit: int = _MAX_CELL) -> str:
    """Return what some peer sent as one line of at most `limit` characters, all of them printable."""
    text = str(value)
    short = text if len(text) <= limit else f"{text[: limit - 3]}..."
    return printable(short.replace("\n", "\\n"))[: 4 * limit]


def to_line(sample: Sample[Any], fields: Sequence[str] = (), *, address: str = "") -> str:
    """Return one line with these fields, or with the most important ones; NED, metres, degrees."""
    message = sample.message
    start = f"{address or f'{sample.address!s:<38}'} {message.timestamp / 1e6:12.3f} s"
    if fields:
        return "  ".join([start, *(f"{name} {to_value(sample, name)}" for name in fields)]) + _notes(sample)
    if not is_position(message):
        return f"{start}{_notes(sample)}  {to_summary(message)}"  # whose end has no room on a terminal
    position = " ".join(f"{value:9.3f}" for value in (message.x, message.y, message.z))
    velocity = " ".join(f"{value:7.3f}" for value in (message.vx, message.vy, message.vz))
    heading = f"hdg {math.degrees(message.heading):6.1f}  eph {message.eph:6.2f}"
    return f"{start}  ned {position} m  v {velocity} m/s  {heading}  {to_state(sample)}"


def to_state(sample: Sample[Any]) -> str:
    """Return what casts doubt on a sample, or "ok"; then its age, if it is old, and how many were lost before it."""
    return (message_doubts(sample.message) if is_position(sample.message) else "ok") + _notes(sample)


def is_position(message: Message) -> bool:
    """Return whether this is the message whose position, flags and doubts are shown."""
    return message.DEFINITION is DEFAULT


def to_summary(message: Message) -> str:
    """Return the numbers of a message by name, then the flags that are set; what is not known is left out."""
    definition = message.DEFINITION
    numbers, flags = [], []
    for name, kind in definition.types.items():
        value = getattr(message, name)
        if kind.base == "bool":
            flags += [name] if value is True else []
        elif name not in _TIMES and value != kind.absent and repr(value) != repr(kind.absent):
            numbers.append(f"{name} {_to_number(value, _FEWER.get(kind.base))}")
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
        f"  {name}: {to_value(sample, name)}" + (" (not provided)" if name in missing else "")
        for name in fields or sample.message.DEFINITION.types
    ]
    return "\n".join([*lines, "---"])


def to_json(sample: Sample[Any], fields: Sequence[str] = ()) -> str:
    """Return one line of JSON; non-finite numbers are the strings NaN, Infinity and -Infinity."""
    address = sample.address
    head = {
        "vehicle": address.vehicle,
        "topic": address.topic,
        "instance": address.instance,
        "received": sample.received,
        "sent": sample.sent,
        "lost": sample.lost,
        "source": sample.source,
        "missing": sorted(sample.missing),
        **({"stored": True} if sample.stored else {}),
    }
    message = sample.message.model_dump_json(include=set(fields) or None)
    return f'{json.dumps(head)[:-1]}, "message": {message}}}'


def to_csv_head(sample: Sample[Any], fields: Sequence[str] = ()) -> str:
    """Return the first line of a CSV file of these fields, or of all, of messages like this one."""
    names, types = ["vehicle", "topic", "instance", "sent", "timestamp"], sample.message.DEFINITION.types
    for name in fields or types:
        if name != "timestamp":
            length = types[name].length if name in types else None
            names += [f"{name}[{index}]" for index in range(length)] if length else [name]
    return csv_line(names)


def to_csv(sample: Sample[Any], fields: Sequence[str] = ()) -> str:
    """Return a line of CSV: vehicle, topic, instance, when it was sent [ns], PX4's timestamp [us], and the fields."""
    address, message = sample.address, sample.message
    cells: list[object] = [address.vehicle, address.topic, address.instance, sample.sent, message.timestamp]
    types = message.DEFINITION.types
    for name in fields or types:
        if name != "timestamp":
            value = getattr(message, name, "")
            digits = _DIGITS.get(types[name].base) if name in types else None
            cells += [_to_number(each, digits) for each in (value if isinstance(value, tuple) else (value,))]
    return csv_line(cells)


def csv_line(cells: Iterable[object]) -> str:
    """Return a line of CSV, with quotes where they are needed; None is an empty cell."""
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()


def to_value(sample: Sample[Any], name: str) -> str:
    """Return the value of a field as text, "-" for one that this message does not have."""
    kind = sample.message.DEFINITION.types.get(name)
    return "-" if kind is None else _to_number(getattr(sample.message, name), _DIGITS.get(kind.base))


def _to_number(value: object, digits: int | None) -> str:
    """Return a value, or those of an array, with so many significant digits, or with all there are."""
    if isinstance(value, tuple):
        return " ".join(_to_number(each, digits) for each in value)
    return str(value) if digits is None else f"{value:.{digits}g}"
