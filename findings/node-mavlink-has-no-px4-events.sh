#!/usr/bin/env bash
# node-mavlink 2.3.0 and pymavlink 2.4.50, 2026-11-28: PX4's EVENT, which carries the reason of a denied arming or a
# failsafe, is in MAVLink's common.xml but in neither package: pymavlink returns UNKNOWN_410, node-mavlink nothing at all.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q pymavlink==2.4.50
venv/bin/python - <<'PYTHON'
import struct
from pathlib import Path

from pymavlink.dialects.v20 import all as every_dialect
from pymavlink.dialects.v20 import common
from pymavlink.generator.mavcrc import x25crc

link = common.MAVLink(None, srcSystem=1, srcComponent=1)
heartbeat = common.MAVLink_heartbeat_message(2, 12, 81, 3 << 16, 4, 3).pack(link)
# EVENT: number 410, CRC_EXTRA 160
payload = struct.pack("<IIHBBB40s", 11_272_193, 1000, 7, 0, 0, 0x66, bytes([1, 2, 3])).rstrip(b"\0")
frame = struct.pack("<BBBBBBB", len(payload), 0, 0, 1, 1, 1, 410 & 255) + struct.pack("<H", 410 >> 8) + payload
crc = x25crc(frame)
crc.accumulate(bytes([160]))
data = heartbeat + b"\xfd" + frame + struct.pack("<H", crc.crc) + heartbeat
Path("frames.bin").write_bytes(data)
seen = [message.get_type() for message in every_dialect.MAVLink(None).parse_buffer(data)]
print("pymavlink:   ", *seen)
assert seen == ["HEARTBEAT", "UNKNOWN_410", "HEARTBEAT"]
PYTHON
npm install --silent --no-audit --no-fund node-mavlink@2.3.0 mavlink-mappings@1.0.21-20250824-1 >/dev/null
cat >probe.mjs <<'JAVASCRIPT'
import assert from 'node:assert'
import { createReadStream } from 'node:fs'
import { MavLinkPacketParser, MavLinkPacketSplitter, common, minimal } from 'node-mavlink'

const registry = { ...minimal.REGISTRY, ...common.REGISTRY }
const seen = []
const packets = createReadStream('frames.bin').pipe(new MavLinkPacketSplitter()).pipe(new MavLinkPacketParser())
for await (const packet of packets) seen.push(registry[packet.header.msgid].MSG_NAME)
console.log('node-mavlink:', ...seen)
assert.deepEqual(seen, ['HEARTBEAT', 'HEARTBEAT'])
JAVASCRIPT
node probe.mjs
