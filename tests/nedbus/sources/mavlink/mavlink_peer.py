"""Simulated MAVLink 2 vehicle for tests: a process that sends the streams of a PX4 over UDP, with values from a file.

Each position sent is a JSON line on stdout with its float32 values; the last line is the number of dropped packets.
The same arguments produce the same packets in the same order; commands are not answered.
Unlike PX4, it sends GLOBAL_POSITION_INT (the heading) even without an origin, and repeats GPS_GLOBAL_ORIGIN.
"""

import argparse
import heapq
import json
import math
import random
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

Row = dict[str, float]
Build = Callable[[int, Row], Any]  # (ms since boot, row) to a message, or None to send nothing
Stream = tuple[float, Build]  # rate [Hz], builder
NED = ("x", "y", "z", "vx", "vy", "vz")
NAN = math.nan
BOOT_MS = 60_000  # time_boot_ms of the first message
# of the first one after a reboot: a vehicle cannot be up for longer than it was silent
REBOOTED_MS = 1000


def covariance(known: dict[int, float]) -> list[float]:
    """Return the 21 elements of an upper triangle: the given ones, and NaN elsewhere, as sent by PX4."""
    return [known.get(index, NAN) for index in range(21)]


def local_position(ms: int, row: Row) -> Any:
    return mavlink.MAVLink_local_position_ned_message(ms % 2**32, *(row[name] for name in NED))


def attitude(ms: int, row: Row) -> Any:
    return mavlink.MAVLink_attitude_message(ms % 2**32, 0, 0, row["heading"], 0, 0, 0)


def global_position(ms: int, row: Row) -> Any:
    turn = row["heading"] % math.tau
    hdg = 65535 if math.isnan(turn) else int(math.degrees(turn) * 100) % 36000
    lat, lon = (0 if math.isnan(row[k]) else round(row[k] * 1e7) for k in ("ref_lat", "ref_lon"))
    return mavlink.MAVLink_global_position_int_message(
        ms % 2**32, lat, lon, 0, int(-row["z"] * 1000), 0, 0, 0, hdg
    )


def origin(ms: int, row: Row) -> Any:
    lat, lon, alt = row["ref_lat"], row["ref_lon"], row["ref_alt"]
    if math.isnan(lat + lon + alt):
        return None  # PX4 sends no GPS_GLOBAL_ORIGIN before it has an origin
    return mavlink.MAVLink_gps_global_origin_message(
        round(lat * 1e7), round(lon * 1e7), round(alt * 1e3), 1_000_000
    )


def altitude(ms: int, row: Row) -> Any:
    bottom = row["dist_bottom"] if row.get("dist_bottom_valid", 1) else NAN
    return mavlink.MAVLink_altitude_message(
        ms * 1000, NAN, NAN, -row["z"], -row["z"], -row["z"] - bottom, bottom
    )


def estimator(ms: int, row: Row) -> Any:
    # from bit 0
    names = ("", "v_xy_valid", "v_z_valid", "xy_valid", "xy_global", "z_valid", "dist_bottom_valid")
    bits = [({"xy_global": not math.isnan(row["ref_lat"])} | row).get(name, 1) for name in names]
    flags = sum(1 << bit for bit, is_set in enumerate(bits) if is_set)
    return mavlink.MAVLink_estimator_status_message(
        ms * 1000, flags, 0, 0, 0, 0, 0, 0, row["eph"], row["epv"]
    )


def odometry(ms: int, row: Row) -> Any:
    eph, epv, evh, evv = (
        row["eph"] ** 2 / 2,
        row["epv"] ** 2,
        row.get("evh", 0.1) ** 2 / 2,
        row.get("evv", 0.1) ** 2,
    )
    pose = covariance({0: eph, 6: eph, 11: epv, 15: 0.01, 18: 0.01, 20: 0.01})
    twist, q = (
        covariance({0: evh, 6: evh, 11: evv}),
        (math.cos(row["heading"] / 2), 0, 0, math.sin(row["heading"] / 2)),
    )
    x, y, z, *speed = (row[name] for name in NED)
    return mavlink.MAVLink_odometry_message(
        ms * 1000, 1, 1, x, y, z, q, *speed, 0, 0, 0, pose, twist, 0, 8, 100
    )


def schedule(streams: list[Stream]) -> Iterator[tuple[float, Build]]:
    """Yield (seconds since boot, builder) endlessly; builders due at the same time come in the order of `streams`."""
    heap = [(0.0, order, 0) for order, (rate, _) in enumerate(streams) if rate > 0]
    while True:
        now, order, turn = heapq.heappop(heap)
        rate, build = streams[order]
        yield now, build
        heapq.heappush(heap, ((turn + 1) / rate, order, turn + 1))


def print_line(line: dict[str, Any]) -> None:
    """Print and flush a JSON line."""
    sys.stdout.write(f"{json.dumps(line)}\n")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--to", required=True, metavar="HOST:PORT")
    parser.add_argument("--values", required=True, type=Path)
    for name, number in {
        "system": 1,
        "count": 0,
        "reboot-after": 0,
        "drop": 0.0,
        "speed": 1.0,
    }.items():
        parser.add_argument(f"--{name}", type=type(number), default=number)
    args = parser.parse_args()
    host, port = args.to.rsplit(":", 1)
    rows: list[Row] = json.loads(args.values.read_text())
    heartbeat = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3
    )
    streams: list[Stream] = [
        (1, lambda ms, row: heartbeat),
        (1, origin),
        (2, estimator),
        (10, global_position),
    ]
    streams += [(10, altitude), (10, odometry), (50, attitude), (30, local_position)]
    link, rng = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), random.Random(1)
    mav, base_ms = mavlink.MAVLink(None, args.system, 1), BOOT_MS
    plan, start = schedule(streams), time.monotonic()
    total = turn = dropped = 0
    while not args.count or total < args.count:
        now, build = next(plan)
        time.sleep(max(0.0, start + now / args.speed - time.monotonic()))
        if (message := build(base_ms + round(now * 1000), rows[turn % len(rows)])) is None:
            continue
        data, mav.seq = message.pack(mav), (mav.seq + 1) % 256
        is_dropped = rng.random() < args.drop
        dropped += is_dropped
        if not is_dropped:
            link.sendto(data, (host, int(port)))
        if build is local_position:
            total, turn = total + 1, turn + 1
            if not is_dropped:
                values = struct.unpack(
                    "<6f", struct.pack("<6f", *(getattr(message, name) for name in NED))
                )
                print_line(
                    {"time_boot_ms": message.time_boot_ms} | dict(zip(NED, values, strict=True))
                )
            if total == args.reboot_after:
                plan, start = schedule(streams), time.monotonic()
                mav.seq, base_ms, turn = 0, REBOOTED_MS, 0
    print_line({"packets_dropped": dropped})


if __name__ == "__main__":
    main()
