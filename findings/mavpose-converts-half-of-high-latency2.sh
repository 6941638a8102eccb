#!/usr/bin/env bash
# mavpose 0.4.0, 2026-11-29: of HIGH_LATENCY2, whose fields all have scaled units, it converts some to SI units and leaves
# others: eph of 5 m is 5.0, a climb rate of 2 m/s is 2.0, but a heading of 90 degrees is 45 and a ground speed of 10 m/s
# is 50. Only `units` shows it: "deg/2" and "m/s*5".
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q mavpose==0.4.0 pymavlink==2.4.50
venv/bin/python - <<'PYTHON'
import struct

from mavpose import LogExtractor
from pymavlink.dialects.v20 import common

message = common.MAVLink_high_latency2_message(
    timestamp=10_000, type=2, autopilot=12, custom_mode=0, latitude=473977420, longitude=85455940, altitude=500,
    target_altitude=510, heading=90 // 2, target_heading=180 // 2, target_distance=1000 // 10, throttle=50,
    airspeed=11 * 5, airspeed_sp=12 * 5, groundspeed=10 * 5, windspeed=8 * 5, wind_heading=270 // 2, eph=5 * 10,
    epv=6 * 10, temperature_air=-10, climb_rate=2 * 10, battery=57, wp_num=5, failure_flags=0, custom0=0, custom1=0, custom2=0,
)
link = common.MAVLink(None, srcSystem=1, srcComponent=1)
with open("satellite.tlog", "wb") as stream:
    stream.write(struct.pack(">Q", 1_700_000_000_000_000) + message.pack(link))
log = LogExtractor("satellite.tlog")
log.extract_all()
row = log.frames["HIGH_LATENCY2"].iloc[0]
names = ("eph", "climb_rate", "target_distance", "heading", "groundspeed", "wind_heading")
seen = {name: (float(row[name]), log.units["HIGH_LATENCY2"][name]) for name in names}
print("mavpose 0.4.0:", seen)
assert seen["eph"] == (5.0, "m") and seen["climb_rate"] == (2.0, "m/s") and seen["target_distance"] == (1000.0, "m")
assert seen["heading"] == (45.0, "deg/2") and seen["wind_heading"] == (135.0, "deg/2")
assert seen["groundspeed"] == (50.0, "m/s*5")
PYTHON
