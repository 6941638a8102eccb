"""Format samples and the health of streams as text, for a person or a program."""

from __future__ import annotations

import json
import math
from typing import Final

from nedbus.client import Health, Sample
from nedbus_msgs import FIELD_TYPES, describe_flags, message_doubts

_OLD: Final = 1.0  # s of latency from which on a line shows it: the last value of a stream that ended, or recovered


def to_line(sample: Sample) -> str:
    """Return one line with the most important fields; NED, metres, degrees."""
    message = sample.message
    position = " ".join(f"{value:9.3f}" for value in (message.x, message.y, message.z))
    velocity = " ".join(f"{value:7.3f}" for value in (message.vx, message.vy, message.vz))
    lost = f"  [{sample.lost} lost]" if sample.lost else ""
    old = f"  [{to_age(sample.latency)} old]" if sample.latency is not None and sample.latency > _OLD else ""
    return (
        f"{sample.address!s:<38} {message.timestamp / 1e6:12.3f} s  ned {position} m  v {velocity} m/s"
        f"  hdg {math.degrees(message.heading):6.1f}  eph {message.eph:6.2f}  {message_doubts(message)}{old}{lost}"
    )


def to_fields(sample: Sample) -> str:
    """Return every field on a line of its own, as `ros2 topic echo` does."""
    age = "" if sample.latency is None else f", {to_age(sample.latency)} old"
    source = "" if sample.source is None else f", from {sample.source}"
    lines = [f"{sample.address}{age}{source}"]
    for name, value in sample.message.model_dump().items():
        # Nine digits distinguish any two float32; ref_lat and ref_lon have more.
        text = f"{value:.9g}" if FIELD_TYPES[name] == "float32" else f"{value}"
        lines.append(f"  {name}: {text}" + (" (not provided)" if name in sample.missing else ""))
    return "\n".join([*lines, "---"])


def to_json(sample: Sample) -> str:
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
    }
    return f'{json.dumps(head)[:-1]}, "message": {sample.message.model_dump_json()}}}'


def to_cells(health: Health) -> list[str]:
    """Return rate, jitter, latency, greatest latency, loss and state, each as a cell of a table."""
    return [
        f"{health.rate:.1f}" if health.rate is not None else "-",
        f"{health.jitter * 1e3:.1f} ms" if health.jitter is not None else "-",
        to_age(health.latency) if health.latency is not None else "-",
        to_age(health.latency_max) if health.latency_max is not None else "-",
        f"{health.lost}",
        to_state(health),
    ]


def to_state(health: Health) -> str:
    """Return what is wrong with a stream: its flags, and its gaps, order and reboots; "ok" if nothing is."""
    doubts = describe_flags(health.flags) if health.flags else "ok"
    counts = (health.gaps, "gaps"), (health.out_of_order, "out of order"), (health.reboots, "reboots")
    events = [f"{count} {name}" for count, name in counts if count]
    return ", ".join(events if events and doubts == "ok" else [doubts, *events])


def to_age(seconds: float) -> str:
    """Return a duration in a suitable unit."""
    if seconds < 1:
        return f"{max(0.0, seconds) * 1e3:.0f} ms"
    return f"{seconds:.1f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def to_table(head: list[str], rows: list[list[str]]) -> str:
    """Return rows in columns, the first one aligned to the left, the others to the right."""
    widths = [max(len(row[column]) for row in [head, *rows]) for column in range(len(head))]
    lines = [
        "  ".join(cell.ljust(width) if column == 0 else cell.rjust(width) for column, (cell, width) in enumerate(pairs))
        for pairs in (list(zip(row, widths, strict=True)) for row in [head, *rows])
    ]
    return "\n".join(line.rstrip() for line in lines)
