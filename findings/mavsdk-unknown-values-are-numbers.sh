#!/usr/bin/env bash
# MAVSDK 4.1.0 (Python), 2026-11-28: MAVLink's values for "unknown" arrive as numbers in some fields and as NaN in others:
# GPS_RAW_INT's 65535 becomes an HDOP and a speed of 655.35, unknown cell voltages 0.0 V, a bottom clearance stays -1.0,
# while heading, battery current and temperature are NaN.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q mavsdk==4.1.0 pymavlink==2.4.50
cat >"$work/probe.py" <<'PYTHON'
import math
import socket
import threading
import time

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.telemetry import Telemetry
from pymavlink.dialects.v20 import common

with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
    probe.bind(("127.0.0.1", 0))
    port = probe.getsockname()[1]
ended = threading.Event()


def vehicle():
    """Send a heartbeat and messages without known values, 20 times a second."""
    link = common.MAVLink(None, srcSystem=1, srcComponent=1)
    unknown = 65535
    messages = [
        common.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3),
        common.MAVLink_gps_raw_int_message(
            10_000_000, 3, 473977420, 85455940, 500000, unknown, unknown, unknown, unknown, 255
        ),
        common.MAVLink_battery_status_message(0, 0, 0, 32767, [unknown] * 10, -1, -1, -1, -1),
        common.MAVLink_global_position_int_message(10000, 473977420, 85455940, 500000, 10000, 0, 0, 0, unknown),
        common.MAVLink_altitude_message(10_000_000, 1, 2, 3, 4, math.nan, -1),
    ]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        while not ended.wait(0.05):
            for message in messages:
                sock.sendto(message.pack(link), ("127.0.0.1", port))


threading.Thread(target=vehicle, daemon=True).start()
mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
telemetry = Telemetry(mavsdk.first_autopilot(20.0))
deadline = time.monotonic() + 20
while telemetry.gps_info().num_satellites != 255 or not math.isnan(telemetry.battery().temperature_degc):
    assert time.monotonic() < deadline, "no telemetry"
    time.sleep(0.1)
while telemetry.altitude().bottom_clearance_m != -1:
    assert time.monotonic() < deadline, "no ALTITUDE with the clearance as sent"
    time.sleep(0.1)
gps, battery = telemetry.raw_gps(), telemetry.battery()
print("MAVSDK 4.1.0:", gps, telemetry.gps_info(), battery, telemetry.altitude(), sep="\n  ")
assert abs(gps.hdop - 655.35) < 0.01 and abs(gps.velocity_m_s - 655.35) < 0.01
assert battery.voltage_v == 0.0 and battery.remaining_percent == -1.0
assert math.isnan(battery.current_battery_a) and math.isnan(telemetry.heading().heading_deg)
ended.set()
PYTHON
timeout 120 "$work/venv/bin/python" "$work/probe.py"
