#!/usr/bin/env bash
# MAVSDK 4.1.0 (Python), 2026-11-29: the frames of an ODOMETRY are 0 for each of PX4's, so a velocity in NED
# (child_frame_id MAV_FRAME_LOCAL_NED) arrives as `velocity_body` without a hint. Before any message, the getters answer
# with zeros: 0 m/s in position_velocity_ned, a latitude of 0 in raw_gps, while position and home are NaN.
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

# frame and child frame as in PX4's streams/ODOMETRY.hpp, the child being the frame of the velocity
FRAMES = {
    "NED, velocity NED": (common.MAV_FRAME_LOCAL_NED, common.MAV_FRAME_LOCAL_NED),
    "NED, velocity body FRD": (common.MAV_FRAME_LOCAL_NED, common.MAV_FRAME_BODY_FRD),
    "FRD, velocity FRD": (common.MAV_FRAME_LOCAL_FRD, common.MAV_FRAME_LOCAL_FRD),
}
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
    probe.bind(("127.0.0.1", 0))
    port = probe.getsockname()[1]
ended = threading.Event()
current = None


def vehicle():
    """Send heartbeats, and the current odometry once there is one."""
    link = common.MAVLink(None, srcSystem=1, srcComponent=1)
    unknown = [math.nan] * 21
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        while not ended.wait(0.05):
            sock.sendto(common.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3).pack(link), ("127.0.0.1", port))
            if current is not None:
                number, (frame, child) = current
                odometry = common.MAVLink_odometry_message(
                    number, frame, child, 1, 2, -3, [1, 0, 0, 0], 4, 5, 6, 0, 0, 0, unknown, unknown
                )
                sock.sendto(odometry.pack(link), ("127.0.0.1", port))


threading.Thread(target=vehicle, daemon=True).start()
mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
telemetry = Telemetry(mavsdk.first_autopilot(20.0))
velocity = telemetry.position_velocity_ned().velocity
print("MAVSDK 4.1.0, before any message:", velocity, telemetry.position(), telemetry.raw_gps(), telemetry.home(), sep="\n  ")
assert velocity.north_m_s == velocity.east_m_s == velocity.down_m_s == 0.0
assert telemetry.raw_gps().latitude_deg == telemetry.raw_gps().longitude_deg == 0.0
assert math.isnan(telemetry.position().latitude_deg)
seen = {}
for number, (name, frames) in enumerate(FRAMES.items(), 1):
    current = (number, frames)
    deadline = time.monotonic() + 20
    while telemetry.odometry().time_usec != number:
        assert time.monotonic() < deadline, "no odometry"
        time.sleep(0.05)
    odometry = telemetry.odometry()
    seen[name] = (odometry.frame_id, odometry.child_frame_id, odometry.velocity_body.x_m_s)
    print(f"{name}: sent {frames}, received {seen[name][:2]}, velocity_body.x_m_s {seen[name][2]}")
ended.set()
assert all((int(frame), int(child)) == (0, 0) and x == 4.0 for frame, child, x in seen.values())
PYTHON
timeout 120 "$work/venv/bin/python" "$work/probe.py"
