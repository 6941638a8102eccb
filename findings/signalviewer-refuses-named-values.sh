#!/usr/bin/env bash
# signalviewer-lite 1.14.0, 2026-11-29: a .tlog with one NAMED_VALUE_FLOAT, which ArduSub sends all the time, is not opened: the
# error takes the name of the value for a number. Without that message the file opens.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q signalviewer-lite==1.14.0 pymavlink==2.4.50
MAVLINK20=1 venv/bin/python - <<'PYTHON'
import struct

from pymavlink.dialects.v20 import common

for name in ("with", "without"):
    link = common.MAVLink(None, srcSystem=1, srcComponent=1)
    with open(f"{name}.tlog", "wb") as file:
        for number in range(50):
            messages = [
                common.MAVLink_heartbeat_message(12, 3, 81, 19, 4, 3),
                common.MAVLink_local_position_ned_message(1000 + 100 * number, 1.5, 2.5, 3.5, 0.0, 0.0, 0.0),
            ]
            if name == "with" and number == 20:
                messages.append(common.MAVLink_named_value_float_message(1000 + 100 * number, b"CamPan", 0.5))
            for message in messages:
                file.write(struct.pack(">Q", 1_796_000_000_000_000 + 100_000 * number) + message.pack(link))
                link.seq = (link.seq + 1) % 256
PYTHON
venv/bin/signalviewer-cli info without.tlog | tee without.txt
grep -q LOCAL_POSITION_NED without.txt
if venv/bin/signalviewer-cli info with.tlog >with.txt 2>&1; then
    cat with.txt
    exit 1
fi
cat with.txt
grep -q "invalid literal for int() with base 10: b'CamPan'" with.txt
