#!/usr/bin/env bash
# pyulog 1.3.0, 2026-11-29: PX4ULog.add_roll_pitch_yaw takes the arc sine of a float32 that rounding puts above 1: of
# unit quaternions at a pitch of 90 degrees, as of a tailsitter, about 9 % get a pitch of NaN; roll and yaw are numbers.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q pyulog==1.3.0 "numpy==2.4.*"
venv/bin/python -W ignore - <<'PYTHON'
import struct

import numpy as np
from pyulog import ULog
from pyulog.px4 import PX4ULog


def record(kind, body):
    return struct.pack("<HB", len(body), ord(kind)) + body


# (w, x, y, z) of yaw, then a pitch of 90 degrees
yaws = np.linspace(-np.pi, np.pi, 10_000)
half = np.sqrt(0.5)
attitudes = np.column_stack([np.cos(yaws / 2), -np.sin(yaws / 2), np.cos(yaws / 2), np.sin(yaws / 2)]) * half
log = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + record("B", bytes(40))
log += record("F", b"vehicle_attitude:uint64_t timestamp;float[4] q;")
log += record("A", struct.pack("<BH", 0, 0) + b"vehicle_attitude")
log += b"".join(record("D", struct.pack("<HQ4f", 0, 1000 * i, *q)) for i, q in enumerate(attitudes, 1))
with open("tailsitter.ulg", "wb") as stream:
    stream.write(log)
flight = ULog("tailsitter.ulg")
PX4ULog(flight).add_roll_pitch_yaw()
data = flight.get_dataset("vehicle_attitude").data
norms = np.sqrt(sum(data[f"q[{i}]"].astype(float) ** 2 for i in range(4)))
share = np.isnan(data["pitch"]).mean()
print(f"pyulog 1.3.0: {share:.1%} of {len(data['pitch'])} pitches are NaN; the norms are 1 within {abs(norms - 1).max():.1e}")
assert abs(norms - 1).max() < 1e-6
assert 0.05 < share < 0.15
assert np.isfinite(data["roll"]).all() and np.isfinite(data["yaw"]).all()
PYTHON
