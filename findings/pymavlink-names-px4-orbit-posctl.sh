#!/usr/bin/env bash
# pymavlink 2.4.50, 2026-11-28: mavutil.mode_string_v10 names PX4's modes without their sub-mode: Orbit and Position Slow
# are both POSCTL, and precision landing, VTOL take-off, external modes and Altitude Cruise are all UNKNOWN.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q pymavlink==2.4.50
"$work/venv/bin/python" - <<'PYTHON'
from pymavlink import mavutil
from pymavlink.dialects.v20 import common

# main and sub mode as in PX4's px4_custom_mode.h
MODES = {
    "Position": (3, 0), "Orbit": (3, 1), "Position Slow": (3, 2), "Land": (4, 6), "Precision Land": (4, 9),
    "VTOL Takeoff": (4, 10), "External Mode 1": (4, 11), "Altitude Cruise": (11, 0),
}
names = {}
for mode, (main, sub) in MODES.items():
    heartbeat = common.MAVLink_heartbeat_message(2, 12, 81, main << 16 | sub << 24, 4, 3)
    names[mode] = mavutil.mode_string_v10(heartbeat)
print(names)
assert names["Position"] == names["Orbit"] == names["Position Slow"] == "POSCTL"
assert names["Land"] == "LAND"
for mode in ("Precision Land", "VTOL Takeoff", "External Mode 1", "Altitude Cruise"):
    assert names[mode] == "UNKNOWN", mode
PYTHON
