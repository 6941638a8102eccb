#!/usr/bin/env bash
# pyulog 1.3.0, 2026-11-28: ulog2kml of a log whose GPS never had a fix ends with 0 and writes a line at latitude 0,
# longitude 0 instead of an empty file or an error.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q pyulog==1.3.0 simplekml==1.3.6
venv/bin/python - <<'PYTHON'
import struct


def record(kind, content):
    return struct.pack("<HB", len(content), ord(kind)) + content


form = b"vehicle_gps_position:uint64_t timestamp;double latitude_deg;double longitude_deg;double altitude_msl_m;uint8_t fix_type;"
with open("no_fix.ulg", "wb") as stream:
    stream.write(bytes.fromhex("554c6f67011235") + b"\1" + struct.pack("<Q", 0))
    stream.write(record("B", bytes(40)) + record("F", form))
    stream.write(record("A", struct.pack("<BH", 0, 1) + b"vehicle_gps_position"))
    for second in range(5):
        position = struct.pack("<QdddB", second * 1_000_000, 47.397742, 8.545594, 488.0, 1)
        stream.write(record("D", struct.pack("<H", 1) + position))
PYTHON
venv/bin/ulog2kml -o no_fix.kml no_fix.ulg
grep -o '<coordinates>.*</coordinates>' no_fix.kml
[ "$(grep -c '<coordinates>0.0, 0.0, 0.0</coordinates>' no_fix.kml)" = 1 ]
