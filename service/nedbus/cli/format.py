"""Format samples and values as text, for a person or a program; nothing from the network reaches a terminal raw."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from typing import Final

from nedbus.client import Sample, to_age
from nedbus_msgs import FIELD_TYPES, message_doubts

MAX_TEXT: Final = 1000
"""Characters that are shown of an error or a line of the log."""

_MAX_CELL: Final = 120  # characters that are shown of a value that some peer sent
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


def to_line(sample: Sample, fields: Sequence[str] = ()) -> str:
    """Return one line with these fields, or with the most important ones; NED, metres, degrees."""
    message = sample.message
    start = f"{sample.address!s:<38} {message.timestamp / 1e6:12.3f} s"
    if fields:
        return "  ".join([start, *(f"{name} {to_value(sample, name)}" for name in fields)]) + _notes(sample)
    position = " ".join(f"{value:9.3f}" for value in (message.x, message.y, message.z))
    velocity = " ".join(f"{value:7.3f}" for value in (message.vx, message.vy, message.vz))
    heading = f"hdg {math.degrees(message.heading):6.1f}  eph {message.eph:6.2f}"
    return f"{start}  ned {position} m  v {velocity} m/s  {heading}  {to_state(sample)}"


def to_state(sample: Sample) -> str:
    """Return what casts doubt on a sample, or "ok"; then its age, if it is old, and how many were lost before it."""
    return message_doubts(sample.message) + _notes(sample)


def _notes(sample: Sample) -> str:
    lost = f"  [{sample.lost} lost]" if sample.lost else ""
    old = f"  [{to_age(sample.latency)} old]" if sample.latency is not None and sample.latency > _OLD else ""
    return f"{old}{lost}"


def to_fields(sample: Sample, fields: Sequence[str] = ()) -> str:
    """Return these fields, or all, each on a line of its own, as `ros2 topic echo` does."""
    age = "" if sample.latency is None else f", {to_age(sample.latency)} old"
    source = "" if sample.source is None else f", from {sample.source}"
    stored = ", only stored" if sample.stored else ""
    lines = [f"{sample.address}{age}{source}{stored}"]
    lines += [
        f"  {name}: {to_value(sample, name)}" + (" (not provided)" if name in sample.missing else "")
        for name in fields or FIELD_TYPES
    ]
    return "\n".join([*lines, "---"])


def to_json(sample: Sample, fields: Sequence[str] = ()) -> str:
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


def to_csv_head(fields: Sequence[str] = ()) -> str:
    """Return the first line of a CSV file of these fields, or of all."""
    names = ["vehicle", "topic", "instance", "sent", "timestamp"]
    for name in fields or FIELD_TYPES:
        if name != "timestamp":
            names += [f"{name}[0]", f"{name}[1]"] if FIELD_TYPES[name] == "float32[2]" else [name]
    return csv_line(names)


def to_csv(sample: Sample, fields: Sequence[str] = ()) -> str:
    """Return a line of CSV: vehicle, topic, instance, when it was sent [ns], PX4's timestamp [us], and the fields."""
    address, message = sample.address, sample.message
    cells: list[object] = [address.vehicle, address.topic, address.instance, sample.sent, message.timestamp]
    for name in fields or FIELD_TYPES:
        if name != "timestamp":
            value = getattr(message, name)
            cells += [_to_number(name, each) for each in (value if isinstance(value, tuple) else (value,))]
    return csv_line(cells)


def csv_line(cells: Iterable[object]) -> str:
    """Return a line of CSV, with quotes where they are needed; None is an empty cell."""
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()


def to_value(sample: Sample, name: str) -> str:
    """Return the value of a field as text."""
    return _to_number(name, getattr(sample.message, name))


def _to_number(name: str, value: object) -> str:
    """Return nine digits of a float32, which distinguish any two of them; ref_lat and ref_lon have more."""
    if isinstance(value, float) and FIELD_TYPES[name].startswith("float32"):
        return f"{value:.9g}"
    return str(value)
