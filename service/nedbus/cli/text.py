"""Samples as a person reads them, and as a program does."""

from __future__ import annotations

import json
import math

from nedbus.health import Health
from nedbus.intake import Sample
from nedbus_msgs import FIELD_TYPES, VehicleLocalPosition

_DOUBTS = {
    "xy_valid": "xy invalid",
    "z_valid": "z invalid",
    "v_xy_valid": "vxy invalid",
    "v_z_valid": "vz invalid",
    "dead_reckoning": "dead reckoning",
}
_OLD = 1.0  # s of latency that a line tells of: the last value of a stream that ended, or a recovered one


def to_line(sample: Sample) -> str:
    """Return one line with what people look at first; NED, metres, degrees."""
    message = sample.message
    position = " ".join(f"{value:9.3f}" for value in (message.x, message.y, message.z))
    velocity = " ".join(f"{value:7.3f}" for value in (message.vx, message.vy, message.vz))
    lost = f"  [{sample.lost} lost]" if sample.lost else ""
    old = f"  [{to_age(sample.latency)} old]" if sample.latency is not None and sample.latency > _OLD else ""
    return (
        f"{sample.address!s:<38} {message.timestamp / 1e6:12.3f} s  ned {position} m  v {velocity} m/s"
        f"  hdg {math.degrees(message.heading):6.1f}  eph {message.eph:6.2f}  {doubts(message)}{old}{lost}"
    )


def to_fields(sample: Sample) -> str:
    """Return every field on a line of its own, as `ros2 topic echo` does."""
    age = "" if sample.latency is None else f", {to_age(sample.latency)} old"
    source = "" if sample.source is None else f", from {sample.source}"
    lines = [f"{sample.address}{age}{source}"]
    for name, value in sample.message.model_dump().items():
        # Nine digits tell a float32 apart from all others; ref_lat and ref_lon have more.
        shown = f"{value:.9g}" if FIELD_TYPES[name] == "float32" else f"{value}"
        lines.append(f"  {name}: {shown}" + (" (not provided)" if name in sample.missing else ""))
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


def doubts(message: VehicleLocalPosition) -> str:
    """Return why a position should be doubted, "ok" if nothing says so."""
    flags = {
        "xy": message.xy_valid,
        "z": message.z_valid,
        "vxy": message.v_xy_valid,
        "vz": message.v_z_valid,
    }
    invalid = [name for name, valid in flags.items() if not valid]
    words = [f"{' '.join(invalid)} invalid"] if invalid else []
    if message.dead_reckoning:
        words.append("dead reckoning")
    return ", ".join(words) or "ok"


def to_cells(health: Health) -> list[str]:
    """Return rate, jitter, latency, greatest latency, loss and remarks, each as a cell of a table."""
    return [
        f"{health.rate:.1f}" if health.rate is not None else "-",
        f"{health.jitter * 1e3:.1f} ms" if health.jitter is not None else "-",
        to_age(health.latency) if health.latency is not None else "-",
        to_age(health.latency_max) if health.latency_max is not None else "-",
        f"{health.lost}",
        to_state(health),
    ]


def to_state(health: Health) -> str:
    """Return what should be doubted of a stream: flags, with their share where they came and went, and its order."""
    words = []
    flags = health.flags or {}
    for flag, word in _DOUBTS.items():
        share = flags.get(flag, 0.0) if flag == "dead_reckoning" else 1.0 - flags.get(flag, 1.0)
        if share:
            words.append(word if share == 1.0 else f"{word} {max(1, round(100 * share))} %")
    for count, word in ((health.gaps, "gaps"), (health.out_of_order, "out of order"), (health.restarts, "restarts")):
        if count:
            words.append(f"{count} {word}")
    return ", ".join(words) or "ok"


def to_age(seconds: float) -> str:
    """Return a span of time as a person says it."""
    if seconds < 1:
        return f"{max(0.0, seconds) * 1e3:.0f} ms"
    return f"{seconds:.1f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def to_table(head: list[str], rows: list[list[str]]) -> str:
    """Return rows in columns, the first to the left, the others to the right."""
    widths = [max(len(row[column]) for row in [head, *rows]) for column in range(len(head))]
    lines = [
        "  ".join(cell.ljust(width) if column == 0 else cell.rjust(width) for column, (cell, width) in enumerate(pairs))
        for pairs in (list(zip(row, widths, strict=True)) for row in [head, *rows])
    ]
    return "\n".join(line.rstrip() for line in lines)
