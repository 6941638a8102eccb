#!/usr/bin/env bash
# node-mavlink 2.3.0, 2026-11-29: a .tlog that is read as a stream loses some of the frames that lie across two of the stream's
# blocks of 64 KiB. Given the same file as one block, the splitter delivers all of them.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q pymavlink==2.4.50
npm install --silent --no-audit --no-fund node-mavlink@2.3.0
MAVLINK20=1 venv/bin/python - <<'PYTHON'
import struct

from pymavlink.dialects.v20 import common

link = common.MAVLink(None, srcSystem=1, srcComponent=1)
with open("flight.tlog", "wb") as file:
    for number in range(20_000):
        message = common.MAVLink_local_position_ned_message(20 * number, 1.5, 2.5, -3.5, 0.5, 0.25, 0.125)
        file.write(struct.pack(">Q", 1_796_000_000_000_000 + 20_000 * number) + message.pack(link))
        link.seq = (link.seq + 1) % 256
PYTHON
cat >read.mjs <<'JAVASCRIPT'
import assert from "node:assert";
import { createReadStream, readFileSync } from "node:fs";
import { Readable } from "node:stream";
import { common, MavLinkPacketParser, MavLinkTLogPacketSplitter } from "node-mavlink";

async function bootTimes(input) {
  const times = [];
  for await (const packet of input.pipe(new MavLinkTLogPacketSplitter()).pipe(new MavLinkPacketParser())) {
    times.push(packet.protocol.data(packet.payload, common.LocalPositionNed).timeBootMs);
  }
  return times;
}

const streamed = await bootTimes(createReadStream("flight.tlog"));
const whole = await bootTimes(Readable.from([readFileSync("flight.tlog")]));
const blocks = Math.ceil(readFileSync("flight.tlog").length / 65536);
console.log(`sent 20000, as a stream of ${blocks} blocks ${streamed.length}, as one block ${whole.length}`);
assert.equal(whole.length, 20000);
assert(streamed.length < 20000 && streamed.length > 20000 - blocks);
JAVASCRIPT
node read.mjs
