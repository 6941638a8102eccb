#!/usr/bin/env bash
# pymavlink 2.4.50, 2026-11-29: mavextra moves a point on a sphere of 6,378,100 m (gps_newpos, gps_offset) and measures on
# one of 6,371,000 m (distance_lat_lon, distance_two): a point placed 1,000 m away measures 998.89 m.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q pymavlink==2.4.50
"$work/venv/bin/python" - <<'PYTHON'
from pymavlink import mavextra

lat, lon = 47.3977, 8.5456
measured = []
for bearing in (0, 90, 225):
    there = mavextra.gps_newpos(lat, lon, bearing, 1000)
    measured.append(mavextra.distance_lat_lon(lat, lon, *there))
print("pymavlink 2.4.50, 1,000 m away:", measured)
assert all(abs(distance - 998.887) < 0.001 for distance in measured)
PYTHON
