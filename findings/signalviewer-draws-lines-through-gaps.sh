#!/usr/bin/env bash
# signalviewer-lite 1.14.0, 2026-11-29: `signalviewer-cli export` puts signals on one time base by interpolation: a gap of 5 s
# in a PX4 topic becomes a straight line, and a flag such as xy_valid becomes 0.6 between false and true. `--alignment
# nearest` keeps the flag a flag, and fills the gap as well, and the time before the first sample, which is NaN otherwise.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q signalviewer-lite==1.14.0 pyulog==1.3.0
cat >log.py <<'PYTHON'
import struct


def record(kind, body):
    return struct.pack("<HB", len(body), ord(kind)) + body


log = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 10_000_000) + record("B", bytes(40))
log += record("F", b"vehicle_attitude:uint64_t timestamp;float roll_speed;")
log += record("F", b"vehicle_local_position:uint64_t timestamp;float x;bool xy_valid;")
log += record("A", struct.pack("<BH", 0, 0) + b"vehicle_attitude")
log += record("A", struct.pack("<BH", 0, 1) + b"vehicle_local_position")
for tenth in range(100):
    time = 10_000_000 + 100_000 * tenth
    log += record("D", struct.pack("<HQf", 0, time, 0.0))
    # the position at 1 Hz from 1 s on, without messages between 3 s and 8 s; valid at even seconds
    if tenth % 10 == 0 and tenth >= 10 and not 30 < tenth < 80:
        log += record("D", struct.pack("<HQf?", 1, time, tenth / 10, tenth % 20 == 0))
with open("flight.ulg", "wb") as stream:
    stream.write(log)
PYTHON
venv/bin/python log.py
for alignment in linear nearest; do
    venv/bin/signalviewer-cli export flight.ulg --out "$alignment.csv" --alignment "$alignment" \
        --signals vehicle_attitude.roll_speed,vehicle_local_position.x,vehicle_local_position.xy_valid
done
venv/bin/python - <<'PYTHON'
import csv
import math

seen = {}
for alignment in ("linear", "nearest"):
    with open(f"{alignment}.csv", encoding="utf-8-sig") as stream:
        rows = [[float(value) for value in row] for row in list(csv.reader(stream))[1:]]
    seen[alignment] = {round(row[0] - 10, 1): row[2:] for row in rows}
    print(alignment, {time: seen[alignment][time] for time in (0.5, 1.0, 1.4, 2.0, 5.5)})
linear, nearest = seen["linear"], seen["nearest"]
assert math.isnan(linear[0.5][0])
assert abs(linear[5.5][0] - 5.5) < 1e-6
assert abs(linear[1.4][1] - 0.4) < 1e-6
assert nearest[1.4] == [1.0, 0.0]
assert nearest[5.4][0] == 3.0
PYTHON
