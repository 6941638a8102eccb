#!/usr/bin/env bash
# MAVSDK 4.1.0 (Python), 2026-11-29: what TelemetryServer sends differs from what it was given: the home's altitude of
# 4,000 m as 4 mm, a home quaternion of zeros, 68 % for a battery of 57 % (100 times the percentage, modulo 256), and
# texts cut at 50 characters, where STATUSTEXT has an id and a chunk number to continue them.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q mavsdk==4.1.0 pymavlink==2.4.50
cat >"$work/probe.py" <<'PYTHON'
import socket
import threading
import time

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.telemetry_server import Battery, Position, StatusText, StatusTextType, TelemetryServer
from pymavlink import mavutil
from pymavlink.dialects.v20 import common

TEXT = "".join(f"{number:02d} " for number in range(30))
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
    probe.bind(("127.0.0.1", 0))
    port = probe.getsockname()[1]
mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.AUTOPILOT))
mavsdk.add_any_connection(f"udpout://127.0.0.1:{port}")
server = TelemetryServer(mavsdk.server_component())
ended = threading.Event()
station = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}")


def publish():
    position = Position(latitude_deg=47.4, longitude_deg=8.5, absolute_altitude_m=4000.0, relative_altitude_m=10.0)
    while not ended.wait(0.1):
        server.publish_home(position)
        server.publish_battery(Battery(voltage_v=12.0, remaining_percent=57.0))
        server.publish_status_text(StatusText(type=StatusTextType.INFO, text=TEXT))


threading.Thread(target=publish, daemon=True).start()
wanted = ["HOME_POSITION", "BATTERY_STATUS", "STATUSTEXT"]
found = {}
deadline = time.monotonic() + 60
while len(found) < len(wanted):
    assert time.monotonic() < deadline, f"only {list(found)}"
    station.mav.heartbeat_send(common.MAV_TYPE_GCS, common.MAV_AUTOPILOT_INVALID, 0, 0, 4)
    message = station.recv_match(type=wanted, blocking=True, timeout=1)
    if message is not None:
        found[message.get_type()] = message
ended.set()
home, battery, text = (found[name] for name in wanted)
print("MAVSDK 4.1.0:", home, battery, text, sep="\n  ")
assert home.latitude == 474_000_000
assert home.altitude == 4  # mm, of 4,000 m
assert list(home.q) == [0, 0, 0, 0]
assert battery.voltages[0] == 12_000
assert battery.battery_remaining == 68 == 57 * 100 % 256
assert (text.id, text.chunk_seq, text.text) == (0, 0, TEXT[:50].rstrip())
PYTHON
timeout 120 "$work/venv/bin/python" "$work/probe.py"
