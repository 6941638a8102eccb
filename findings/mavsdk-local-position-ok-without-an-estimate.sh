#!/usr/bin/env bash
# MAVSDK 4.1.0 (Python), 2026-11-28: Health.is_local_position_ok is true as soon as LOCAL_POSITION_NED arrives, even if
# its position is NaN and ESTIMATOR_STATUS has no flag set. PX4 sends LOCAL_POSITION_NED whether the estimate is valid or
# not; of the messages sent here, ESTIMATOR_STATUS is the one with validity flags.
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
    """Send a heartbeat, an estimator without a valid state, and a position that is NaN."""
    link = common.MAVLink(None, srcSystem=1, srcComponent=1)
    messages = [
        common.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3),
        common.MAVLink_estimator_status_message(10_000_000, 0, 0, 0, 0, 0, 0, 0, 0, 0),
        common.MAVLink_local_position_ned_message(10000, math.nan, math.nan, math.nan, 0, 0, 0),
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
while not telemetry.health().is_local_position_ok:
    assert time.monotonic() < deadline, "is_local_position_ok stays false"
    time.sleep(0.1)
print("MAVSDK 4.1.0:", telemetry.position_velocity_ned().position, "is_local_position_ok: True")
assert math.isnan(telemetry.position_velocity_ned().position.north_m)
ended.set()
PYTHON
timeout 120 "$work/venv/bin/python" "$work/probe.py"
