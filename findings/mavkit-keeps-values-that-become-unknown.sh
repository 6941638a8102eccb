#!/usr/bin/env bash
# mavkit 0.3.0, 2026-11-29: when a vehicle reports "unknown" (battery -1, satellites 255, heading and eph 65535), the
# telemetry keeps the last known value: 57 %, 12 satellites and an HDOP of 0.95 stand next to a fix type of NoFix.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q mavkit==0.3.0 pymavlink==2.4.50
cat >"$work/probe.py" <<'PYTHON'
import asyncio
import os
import socket
import sys
import threading

import mavkit
from pymavlink.dialects.v20 import common

NAMES = ("battery_pct", "battery_voltage_v", "gps_satellites", "gps_hdop", "heading_deg", "gps_fix_type")
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
    probe.bind(("127.0.0.1", 0))
    port = probe.getsockname()[1]
known = threading.Event()
known.set()


def known_messages():
    return [
        common.MAVLink_gps_raw_int_message(10_000_000, 3, 473977420, 85455940, 500_000, 95, 95, 100, 0, 12),
        common.MAVLink_global_position_int_message(10_000, 473977420, 85455940, 500_000, 10_000, 0, 0, 0, 9000),
        common.MAVLink_sys_status_message(0, 0, 0, 0, 12_000, 500, 57, 0, 0, 0, 0, 0, 0),
    ]


def unknown_messages():
    return [
        common.MAVLink_gps_raw_int_message(10_000_000, 1, 0, 0, 0, 65535, 65535, 65535, 65535, 255),
        common.MAVLink_global_position_int_message(10_000, 473977420, 85455940, 500_000, 10_000, 0, 0, 0, 65535),
        common.MAVLink_sys_status_message(0, 0, 0, 0, 65535, -1, -1, 0, 0, 0, 0, 0, 0),
    ]


def vehicle():
    link = common.MAVLink(None, srcSystem=1, srcComponent=1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        while True:
            messages = known_messages() if known.is_set() else unknown_messages()
            for message in [common.MAVLink_heartbeat_message(2, 12, 81, 3 << 16, 4, 3), *messages]:
                sock.sendto(message.pack(link), ("127.0.0.1", port))
                link.seq = (link.seq + 1) % 256
            threading.Event().wait(0.05)


async def main():
    threading.Thread(target=vehicle, daemon=True).start()
    station = await asyncio.wait_for(mavkit.Vehicle.connect_udp(f"127.0.0.1:{port}"), 30)
    while station.telemetry.gps_fix_type != mavkit.GpsFixType.Fix3d or station.telemetry.battery_pct is None:
        await asyncio.sleep(0.1)
    before = {name: getattr(station.telemetry, name) for name in NAMES}
    known.clear()
    while station.telemetry.gps_fix_type != mavkit.GpsFixType.NoFix:
        await asyncio.sleep(0.1)
    await asyncio.sleep(1)  # some more messages with unknown values
    after = {name: getattr(station.telemetry, name) for name in NAMES}
    print("known:  ", before)
    print("unknown:", after)
    return before, after


before, after = asyncio.run(asyncio.wait_for(main(), 60))
del before["gps_fix_type"], after["gps_fix_type"]
code = int(not (after == before and after["battery_pct"] == 57 and after["gps_satellites"] == 12))
sys.stdout.flush()
os._exit(code)
PYTHON
timeout 90 "$work/venv/bin/python" "$work/probe.py"
