"""Write the results: performance.json, two tables in performance.md, and four rows in the README."""

from __future__ import annotations

import datetime as dt
import json
import os
import platform
import re
from pathlib import Path
from typing import Final

from benchmarks.processes import ROOT

from .fields import DEFAULT_FLIGHT, FLIGHTS
from .peers import CORE, title
from .results import FULL, KHZ, LOADS, SLOW, TEN, Measured, Results
from .targets import evaluate

RESULTS: Final = ROOT / "docs" / "explanation" / "performance.json"
PAGE: Final = RESULTS.with_suffix(".md")
README: Final = ROOT / "README.md"
HEAD: Final = (
    "| form | bytes | messages/s | relative to raw | CPU µs/message at full speed, publisher / reader"
    " | one-way p50 / p99 at 1 kHz, µs | at 100 Hz, µs | CPU µs/message at 1 kHz |"
)

# payload size with the default flight and a timestamp in ns, without transport overhead
BYTES: Final = {
    "raw": 244, "batches": 244, "rows": 244, "models": 244, "fields_in": 244, "straightforward": 916,
    "msgspec_array": 356, "pyzmq": 916, "zenoh_ros2": 220, "cyclonedds": 220, "lcm": 200,
    "mavsdk_telemetry": 40, "rclpy_odometry": 708,
}  # fmt: skip


def table(results: Results) -> str:
    """Return the results with the default flight as a Markdown table, the fastest first."""
    flight = DEFAULT_FLIGHT
    medians = {form: results.median(flight, FULL, form) for form in results.forms(flight, FULL)}
    lines = [HEAD, "|---" * HEAD.count(" |") + "|"]
    for form, full in sorted(medians.items(), key=lambda item: -item[1]["rate"]):
        khz, slow = results.median(flight, KHZ, form), results.median(flight, SLOW, form)
        lines.append(
            f"| {title(form)} | {BYTES[form]} | {full['rate']:,.0f}{_lost(full)} |"
            f" {results.ratio(flight, FULL, form, 'raw', 'rate'):.2f} |"
            f" {full['publish_cpu']:.1f} / {full['receive_cpu']:.1f} |"
            f" {khz['p50']:.0f} / {khz['p99']:.0f} | {slow['p50']:.0f} / {slow['p99']:.0f} |"
            f" {khz['publish_cpu']:.0f} / {khz['receive_cpu']:.0f} |"
        )
    lines += [f"| {form} | | {reason} | | | | | |" for form, reason in results.failed.items()]
    return "\n".join(lines)


def _lost(measured: Measured) -> str:
    """Return the share of lost messages, "" if there are none."""
    return "" if measured["kept"] == 1.0 else f" ({1 - measured['kept']:.1%} lost)"


def flight_table(results: Results) -> str:
    """Return the core forms with each flight, and with ten vehicles, as a Markdown table."""
    flights = results.flights(FULL)
    head = ["form", *flights, "ten vehicles"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for form in CORE:
        if form in results.failed:
            continue
        cells = [
            f"{results.median(flight, FULL, form)['rate']:,.0f}"
            f" · {results.ratio(flight, KHZ, form, 'raw', 'receive_cpu'):.2f}"
            for flight in flights
        ]
        ten = [
            results.ratio(DEFAULT_FLIGHT, TEN, form, "raw", key)
            for key in ("publish_cpu", "receive_cpu", "p50")
        ]
        lines.append(
            f"| {form.replace('_', ' ')} | {' | '.join(cells)} | {' / '.join(f'{ratio:.2f}' for ratio in ten)} |"
        )
    return "\n".join(lines)


def as_json(results: Results, rounds: int) -> dict[str, object]:
    """Return the complete results: medians and ratios by flight, load and form."""
    measured: dict[str, dict[str, dict[str, object]]] = {}
    for flight, name, form in results.runs:
        load = LOADS[name]
        entry: dict[str, object] = _rounded(results.median(flight, load, form))
        for other in ("raw", "straightforward"):
            if results.has(flight, load, other):
                entry[f"of_{other}"] = _rounded(dict(results.ratios(flight, load, form, other)))
        measured.setdefault(flight, {}).setdefault(name, {})[form] = entry
    return {
        "date": dt.datetime.now(dt.UTC).date().isoformat(),
        "machine": f"{os.cpu_count()} shared cores, {platform.machine()}, Python {platform.python_version()}",
        "rounds": rounds,
        "flight": DEFAULT_FLIGHT,
        "flights": {flight: content["from"] for flight, content in FLIGHTS.items()},
        "loads": {
            load.name: {"rate": load.rate, "vehicles": load.vehicles} for load in LOADS.values()
        },
        "bytes": BYTES,
        "results": measured,
        "bars": list(evaluate(results)),
        "failed": results.failed,
    }


def _rounded(numbers: Measured) -> dict[str, object]:
    return {key: round(value, 3) for key, value in numbers.items()}


def as_markdown(results: Results, rounds: int) -> str:
    """Return the text of the page: a few sentences and two tables."""
    about = as_json(results, rounds)
    return (
        f"Measured on {about['date']} on {about['machine']}, publisher, router and reader in separate processes,"
        f" TCP on loopback; medians of {rounds} interleaved rounds.\n"
        f"The message is one of a real flight, {FLIGHTS[DEFAULT_FLIGHT]['from']}: valid, with no origin and no terrain"
        " estimate.\n\n"
        f"{table(results)}\n\n"
        "Messages of several flights: each cell has messages/s · the reader's CPU time at 1 kHz. The last column, ten"
        " vehicles at 100 Hz in one process, has publisher's CPU time / reader's CPU time / p50 latency. CPU times and"
        " latencies are relative to `raw` (1.00):\n\n"
        f"{flight_table(results)}"
    )


SHOWN: Final = {
    "batches": "nedbus, batches (NumPy arrays)",
    "rows": "nedbus, rows (named tuples)",
    "models": "nedbus, models (Pydantic)",
    "straightforward": "a plain Pydantic and msgpack script on Zenoh",
    "zenoh_ros2": "zenoh-ros2-sdk",
    "mavsdk_telemetry": "MAVSDK, `position_velocity_ned`: 7 values, from MAVLink",
    "rclpy_odometry": "rclpy, Fast DDS: `nav_msgs/Odometry`",
}


def short_table(results: Results) -> str:
    """Return the table of the README."""
    lines = [
        "| form | messages/s | CPU µs/message, publisher / reader | one-way p50 / p99 at 1 kHz, µs |",
        "|---|---|---|---|",
    ]
    for form, name in SHOWN.items():
        full, khz = (results.median(DEFAULT_FLIGHT, load, form) for load in (FULL, KHZ))
        lines.append(
            f"| {name} | {full['rate']:,.0f}{_lost(full)} | {full['publish_cpu']:.1f} / {full['receive_cpu']:.1f} |"
            f" {khz['p50']:.0f} / {khz['p99']:.0f} |"
        )
    return "\n".join(lines)


def write(results: Results, rounds: int) -> None:
    """Write the results to performance.json, and the tables to its page and the README."""
    RESULTS.write_text(json.dumps(as_json(results, rounds), indent=2) + "\n")
    _replace(PAGE, "performance", as_markdown(results, rounds))
    if all(form in results.forms(DEFAULT_FLIGHT, FULL) for form in SHOWN):
        _replace(README, "speed", short_table(results))


def _replace(path: Path, name: str, text: str) -> None:
    marks = rf"(<!-- {name} -->\n).*?(\n<!-- /{name} -->)"
    path.write_text(
        re.sub(marks, lambda found: found[1] + text + found[2], path.read_text(), flags=re.DOTALL)
    )
