#!/usr/bin/env bash
# @foxglove/ulog 2.3.2, 2026-11-28: one message with timestamp 0 makes the log's timeRange begin at 0. PX4 writes such
# messages: rtl_time_estimate 31 of 31 in a 1.16 log, parameter_update and manual_control_setpoint once in 1.13 and 1.15,
# so a flight of a minute that began at 274 s is shown as one of more than five.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q pyulog==1.3.0
npm install --silent --no-audit --no-fund @foxglove/ulog@2.3.2
venv/bin/python - <<'PYTHON'
import struct

from pyulog import ULog


def record(kind, body):
    return struct.pack("<HB", len(body), ord(kind)) + body


log = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 274_000_000) + record("B", bytes(40))
log += record("F", b"vehicle_attitude:uint64_t timestamp;float[4] q;")
log += record("F", b"rtl_time_estimate:uint64_t timestamp;float time_estimate;")
log += record("A", struct.pack("<BH", 0, 0) + b"vehicle_attitude") + record("A", struct.pack("<BH", 0, 1) + b"rtl_time_estimate")
for second in range(274, 280):
    log += record("D", struct.pack("<HQ4f", 0, second * 1_000_000, 1, 0, 0, 0))
    log += record("D", struct.pack("<HQf", 1, 0, 30.0))
with open("zero.ulg", "wb") as stream:
    stream.write(log)
read = ULog("zero.ulg")
print("pyulog 1.3.0: start", read.start_timestamp, "end", read.last_timestamp)
assert (read.start_timestamp, read.last_timestamp) == (274_000_000, 279_000_000)
PYTHON
node - <<'JAVASCRIPT'
const { ULog } = require("@foxglove/ulog");
const { FileReader } = require("@foxglove/ulog/node");
(async () => {
  const log = new ULog(new FileReader("zero.ulg"));
  await log.open();
  console.log("@foxglove/ulog 2.3.2: timeRange", log.timeRange());
  require("assert").deepEqual(log.timeRange(), [0n, 279000000n]);
})();
JAVASCRIPT
