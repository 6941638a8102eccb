"""Independent table of events in PX4 logs: first differences of single topics, with pyulog and NumPy, without nedbus.

    python -m tests.nedbus.vehicle_events.events_table FOLDER...  # rewrites tests/data/events.json from its logs

It was written from PX4's message definitions by an author who had not seen `nedbus.vehicle_events`. Each row is a
difference between two consecutive messages of a topic (instance 0); the first message has none. Down is positive. A
reset has the step between the samples minus the motion by their rates or, if the deltas agree with that, the deltas of
the message; it has no size for a position whose origin changed at the same time.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from pyulog import ULog

TABLE: Final = Path(__file__).parents[2] / "data" / "events.json"
TOPICS: Final = (
    "vehicle_local_position", "vehicle_gps_position", "sensor_gps", "estimator_status_flags", "vehicle_status",
    "failsafe_flags", "battery_status", "vehicle_land_detected",
)  # fmt: skip
FUSED: Final = (
    "cs_gps", "cs_gnss_pos", "cs_gnss_vel", "cs_gps_hgt", "cs_gnss_yaw", "cs_gps_yaw", "cs_ev_pos", "cs_ev_vel",
    "cs_ev_yaw", "cs_ev_hgt", "cs_opt_flow", "cs_baro_hgt", "cs_rng_hgt", "cs_aux_gpos",
)  # fmt: skip
NOT_FLAGS: Final = ("gcs_connection_lost", "offboard_control_signal_lost")
VALID: Final = {
    "xy_valid": "xy_invalid", "z_valid": "z_invalid", "v_xy_valid": "v_xy_invalid", "v_z_valid": "v_z_invalid",
    "xy_global": "xy_not_global", "z_global": "z_not_global", "heading_good_for_control": "heading_not_good",
    "dist_bottom_valid": "dist_bottom_invalid",
}  # fmt: skip
JUMP_STEP: Final = 1.0  # m beyond velocity * dt in one step
JUMP_DT: Final = 0.5  # s; longest step, and longest pause within one slide
ORIGIN_MIN: Final = 0.01  # m
RATES: Final = {"x": "vx", "y": "vy", "z": "z_deriv", "vx": "ax", "vy": "ay", "vz": "az"}
EARTH: Final = 6_371_000.0  # m

Row = dict[str, Any]


class Topic:
    """Fields of one topic as float64; the timestamps as integers [us]."""

    def __init__(self, data: Any) -> None:
        self.types: dict[str, str] = {field.field_name: field.type_str for field in data.field_data}
        self.us = data.data["timestamp"].astype(np.int64)
        self.count = len(self.us)
        self._columns = {
            name: values.astype(np.float64)
            for name, values in data.data.items()
            if name != "timestamp"
        }

    def __contains__(self, field: str) -> bool:
        return field in self._columns

    def __getitem__(self, field: str) -> Any:
        return self._columns[field]

    def column(self, field: str) -> Any:
        """Return a field, or zeros if the log does not have it."""
        return self._columns.get(field, np.zeros(self.count))

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def time(self, index: int) -> float:
        return round(int(self.us[index]) / 1e6, 3)

    def step(self, index: int) -> float:
        return int(self.us[index] - self.us[index - 1]) / 1e6

    def changes(self, field: str) -> Iterator[tuple[int, float, float]]:
        """Yield index, previous and new value of each message with a changed value."""
        values = self[field]
        for index in range(1, self.count):
            if differs(values[index - 1], values[index]):
                yield index, values[index - 1], values[index]


class Table:
    """Rows of one log."""

    def __init__(self) -> None:
        self.rows: list[Row] = []

    def add(self, time: float, kind: str, change: str, **numbers: object) -> None:
        self.rows.append({"t": time, "kind": kind, "change": change, "numbers": numbers})

    def add_flag(self, topic: Topic, field: str, kind: str, *, bad: bool) -> None:
        """Add the changes of a flag that equals `bad` while the condition is active."""
        for index, before, now in topic.changes(field) if field in topic else ():
            if bool(before) != bool(now):
                self.add(topic.time(index), kind, "begin" if bool(now) == bad else "end")

    def add_flags(self, topic: Topic, fields: Sequence[str], kind: str, *, bad: bool) -> None:
        """Add the changes of flags; equal changes in one message are one row."""
        found: dict[tuple[int, str], list[str]] = {}
        for field in fields:
            for index, _, now in topic.changes(field):
                found.setdefault((index, "begin" if bool(now) == bad else "end"), []).append(field)
        for (index, change), names in found.items():
            self.add(topic.time(index), kind, change, flags=sorted(names))

    def add_level(
        self, topic: Topic, kind: str, begins: Callable[[int], bool], ends: Callable[[int], bool],
        numbers: Callable[[int], Mapping[str, int]],
    ) -> None:  # fmt: skip
        """Add the changes of a condition with hysteresis; the first message sets it without a row."""
        holds = begins(0)
        for index in range(1, topic.count):
            if (ends if holds else begins)(index):
                holds = not holds
                self.add(topic.time(index), kind, "begin" if holds else "end", **numbers(index))


def differs(one: float, other: float) -> bool:
    return one != other and not (math.isnan(one) and math.isnan(other))


def rounded(value: float, digits: int = 4) -> float:
    return round(float(value), digits)


def unexplained_step(position: Topic, index: int) -> tuple[float, float]:
    """Return the step north and east of a message minus mean velocity times interval."""
    north, east = (
        position[axis][index]
        - position[axis][index - 1]
        - 0.5
        * (position[f"v{axis}"][index] + position[f"v{axis}"][index - 1])
        * position.step(index)
        for axis in "xy"
    )
    return north, east


def origin_of(position: Topic, index: int) -> str | tuple[float, float] | None:
    """Return "set", or distance and height by which the origin moved; None if unchanged or unknown."""
    before, now = (
        [position[name][each] for name in ("ref_lat", "ref_lon", "ref_alt")]
        for each in (index - 1, index)
    )
    if not any(differs(*pair) for pair in zip(before, now, strict=True)):
        return None

    def is_known(values: Sequence[float], each: int) -> bool:
        is_given = bool(position["xy_global"][each]) or values[0] != 0 or values[1] != 0
        return bool(np.isfinite(values[:2]).all()) and is_given

    if not is_known(now, index):
        return None
    if not is_known(before, index - 1):
        return "set"
    north = math.radians(now[0] - before[0]) * EARTH
    east = math.radians(now[1] - before[1]) * EARTH * math.cos(math.radians(now[0]))
    up = now[2] - before[2]
    return math.hypot(north, east), 0.0 if math.isnan(up) else up


def add_position(table: Table, position: Topic) -> None:
    for field, kind in VALID.items():
        table.add_flag(position, field, kind, bad=False)
    table.add_flag(position, "dead_reckoning", "dead_reckoning", bad=True)
    slides: list[list[int]] = []
    for index in range(1, position.count):
        time, step = position.time(index), position.step(index)
        moved = origin_of(position, index)
        if moved == "set":
            table.add(time, "origin_set", "once")
        elif isinstance(moved, tuple) and max(moved[0], abs(moved[1])) >= ORIGIN_MIN:
            table.add(
                time, "origin_moved", "once", distance=rounded(moved[0]), up=rounded(moved[1])
            )
        add_reset(table, position, index, origin_changed=moved is not None)
        if step < -1.0:
            table.add(time, "reboot", "once")
        if step > 3.0:
            table.add(position.time(index - 1), "silent", "begin")
        is_reset = position["xy_reset_counter"][index] != position["xy_reset_counter"][index - 1]
        if (
            not 0 < step <= JUMP_DT
            or not position["xy_valid"][index]
            or is_reset
            or moved is not None
        ):
            continue
        if math.hypot(*unexplained_step(position, index)) > JUMP_STEP:
            if slides and (position.us[index] - position.us[slides[-1][1]]) / 1e6 <= JUMP_DT:
                slides[-1][1] = index
            else:
                slides.append([index, index])
    for first, last in slides:
        north, east = np.array(
            [unexplained_step(position, index) for index in range(first, last + 1)]
        ).sum(axis=0)
        table.add(
            position.time(first), "jump", "once", distance=rounded(math.hypot(north, east), 3)
        )


def add_reset(table: Table, position: Topic, index: int, *, origin_changed: bool) -> None:
    changed = [
        name
        for name in ("xy", "z", "vxy", "vz", "heading")
        if f"{name}_reset_counter" in position
        and position[f"{name}_reset_counter"][index] != position[f"{name}_reset_counter"][index - 1]
    ]
    numbers: dict[str, object] = {"quantities": changed}
    for quantity, names in (
        ("xy", {"north": "delta_xy[0]", "east": "delta_xy[1]"}),
        ("z", {"down": "delta_z"}),
        ("vxy", {"v_north": "delta_vxy[0]", "v_east": "delta_vxy[1]"}),
        ("vz", {"v_down": "delta_vz"}),
        ("heading", {"heading": "delta_heading"}),
    ):
        if quantity in changed and not (origin_changed and quantity in ("xy", "z")):
            numbers |= dict(
                zip(names, step_of(position, quantity, [*names.values()], index), strict=True)
            )
    if origin_changed:
        numbers["origin"] = True
    if changed:
        table.add(position.time(index), "reset", "once", **numbers)


def step_of(position: Topic, quantity: str, deltas: Sequence[str], index: int) -> list[float]:
    """Return the steps minus motion of a reset, or its deltas if they agree within what the motion leaves unknown."""
    seconds, values = (
        position.step(index),
        {"xy": ("x", "y"), "vxy": ("vx", "vy")}.get(quantity, (quantity,)),
    )
    margin = 0.003 + 10 * seconds**3
    steps = [position[value][index] - position[value][index - 1] for value in values]
    if quantity != "heading":
        rates = [
            (position[RATES[value]][index] + position[RATES[value]][index - 1]) / 2
            for value in values
        ]
        steps = [step - rate * seconds for step, rate in zip(steps, rates, strict=True)]
    elif "unaided_heading" in position:
        steps[0] -= position["unaided_heading"][index] - position["unaided_heading"][index - 1]
    else:
        margin = 5 * seconds
    if quantity == "heading":
        steps = [(steps[0] + math.pi) % math.tau - math.pi]
    announced = [position[delta][index] for delta in deltas]
    return [
        rounded(each) for each in (announced if math.dist(announced, steps) <= margin else steps)
    ]


def add_gps(table: Table, gps: Topic) -> None:
    for index, before, now in gps.changes("fix_type"):
        kind = "gps_fix" if (before >= 3) == (now >= 3) else "gps_fix_lost"
        change = "once" if kind == "gps_fix" else "end" if now >= 3 else "begin"
        table.add(gps.time(index), kind, change, fix_before=int(before), fix=int(now))
    used = gps["satellites_used"]
    table.add_level(
        gps, "few_satellites", lambda index: used[index] < 6, lambda index: used[index] >= 7,
        lambda index: {"satellites": int(used[index])},
    )  # fmt: skip
    state = gps.column("jamming_state")
    indicator = gps.column("jamming_indicator")
    table.add_level(
        gps, "jamming", lambda index: state[index] >= 2 or indicator[index] >= 80,
        lambda index: state[index] <= 1 and indicator[index] < 60, lambda index: {"indicator": int(indicator[index])},
    )  # fmt: skip
    spoofing = gps.column("spoofing_state")
    table.add_level(
        gps,
        "spoofing",
        lambda index: spoofing[index] >= 2,
        lambda index: spoofing[index] <= 1,
        lambda _: {},
    )


def add_estimator(table: Table, flags: Topic) -> None:
    table.add_flags(flags, [name for name in FUSED if name in flags], "not_fused", bad=False)
    table.add_flags(
        flags,
        [name for name in flags if name.startswith("reject_")],
        "innovation_rejected",
        bad=True,
    )
    faults = [
        name
        for name in flags
        if name.startswith("fs_bad_")
        or name == "cs_mag_field_disturbed"
        or (name.startswith("cs_") and name.endswith("_fault"))
    ]
    table.add_flags(flags, faults, "estimator_fault", bad=True)


def add_status(table: Table, status: Topic) -> None:
    table.add_flag(status, "failsafe", "failsafe", bad=True)
    for index, before, now in status.changes("nav_state"):
        table.add(status.time(index), "mode", "once", **{"from": int(before), "to": int(now)})
    for index, before, now in status.changes("arming_state"):
        if 2 in (before, now):
            table.add(status.time(index), "armed" if now == 2 else "disarmed", "once")
    link = "gcs_connection_lost" if "gcs_connection_lost" in status else "data_link_lost"
    table.add_flag(status, link, "gcs_lost", bad=True)


def add_failsafe(table: Table, flags: Topic) -> None:
    names = [
        name
        for name, kind in flags.types.items()
        if kind == "bool" and not name.startswith("mode_req_") and name not in NOT_FLAGS
    ]
    table.add_flags(flags, names, "failsafe_flag", bad=True)


def add_battery(table: Table, battery: Topic) -> None:
    """Add the warnings; ignore messages of a battery that is not connected."""
    before: int | None = None
    for index in range(battery.count):
        if "connected" in battery and not battery["connected"][index]:
            continue
        now = int(battery["warning"][index])
        if before is not None and (now > before or now == 0 < before):
            table.add(battery.time(index), "battery", "begin" if now else "end", warning=now)
        before = now


def add_landed(table: Table, detector: Topic) -> None:
    for index, _, now in detector.changes("landed"):
        table.add(detector.time(index), "landed" if now else "takeoff", "once")


def rows_of(path: Path) -> list[Row]:
    """Return the rows of a log in chronological order."""
    found = ULog(str(path), list(TOPICS)).data_list
    topics = {each.name: Topic(each) for each in found if each.multi_id == 0}
    table = Table()
    gps = "vehicle_gps_position" if "vehicle_gps_position" in topics else "sensor_gps"
    for name, add in (
        ("estimator_status_flags", add_estimator), ("vehicle_status", add_status), ("failsafe_flags", add_failsafe),
        ("battery_status", add_battery), ("vehicle_land_detected", add_landed), (gps, add_gps),
        ("vehicle_local_position", add_position),
    ):  # fmt: skip
        if name in topics:
            add(table, topics[name])
    return sorted(table.rows, key=lambda row: (row["t"], row["kind"], row["change"]))


def to_json(logs: Mapping[str, Sequence[Row]]) -> str:
    """Return the file as JSON, one row per line, below a note on its origin."""
    how = f"python -m {__spec__.name} LOGS: first differences of single topics, with pyulog; see its docstring"
    texts = ["{" + f'"from": {json.dumps(how)}']
    texts += [
        f"{json.dumps(name)}: [\n" + ",\n".join(f"  {json.dumps(row)}" for row in rows) + "]"
        for name, rows in logs.items()
    ]
    return ",\n".join(texts) + "}\n"


if __name__ == "__main__":
    TABLE.write_text(to_json({
        path.stem: rows_of(path) for folder in sys.argv[1:] for path in sorted(Path(folder).glob("*.ulg"))
    }))  # fmt: skip
