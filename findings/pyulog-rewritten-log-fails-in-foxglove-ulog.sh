#!/usr/bin/env bash
# pyulog 1.3.0 and @foxglove/ulog 2.3.2, 2026-11-28: pyulog's write_ulog gives all parts of a multi-part information
# the key of one part, with its length. PX4's metadata_events, whose last part is shorter, then declares more bytes than
# it has: pyulog reads such a log, and @foxglove/ulog does not open it (RangeError).
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


def part(text, continued):
    key = b"uint8_t[%d] metadata_events" % len(text)
    return record("M", bytes([continued, len(key)]) + key + text)


log = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + record("B", bytes(40))
log += part(bytes(300), 0) + part(bytes(300), 1) + part(bytes(90), 1)
log += record("F", b"probe:uint64_t timestamp;float x;")
log += record("A", struct.pack("<BH", 0, 0) + b"probe")
log += b"".join(record("D", struct.pack("<HQf", 0, 1000 * i, i)) for i in range(1, 4))
with open("original.ulg", "wb") as stream:
    stream.write(log)
ULog("original.ulg").write_ulog("rewritten.ulg")
before, after = (ULog(name).msg_info_multiple_dict for name in ("original.ulg", "rewritten.ulg"))
print("pyulog 1.3.0 reads both alike:", before == after)
assert before == after
PYTHON
node - <<'JAVASCRIPT'
const assert = require("assert");
const { ULog } = require("@foxglove/ulog");
const { FileReader } = require("@foxglove/ulog/node");
(async () => {
  const seen = {};
  for (const name of ["original.ulg", "rewritten.ulg"]) {
    try {
      const log = new ULog(new FileReader(name));
      await log.open();
      seen[name] = "opened";
    } catch (error) {
      seen[name] = error.constructor.name;
    }
  }
  console.log("@foxglove/ulog 2.3.2:", seen);
  assert.deepEqual(seen, { "original.ulg": "opened", "rewritten.ulg": "RangeError" });
})();
JAVASCRIPT
