#!/usr/bin/env bash
# foxglove-sdk 0.30.3 and @foxglove/ws-protocol 0.8.0, 2026-11-29: the JavaScript client asks for the subprotocol of its
# constant SUPPORTED_SUBPROTOCOL, "foxglove.websocket.v1", which the SDK's server refuses with HTTP status 400. With
# "foxglove.sdk.v1" the same client connects and receives.
set -euo pipefail
work=$(mktemp -d)
server=
trap 'if [ -n "$server" ]; then kill "$server"; fi; rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q foxglove-sdk==0.30.3
npm install --silent --no-audit --no-fund @foxglove/ws-protocol@0.8.0 ws@8.22.0 >/dev/null
cat >server.py <<'PYTHON'
import os
import struct
import time

import foxglove

server = foxglove.start_server(host="127.0.0.1", port=0)
schema = foxglove.Schema(name="demo/msg/Probe", encoding="ros2msg", data=b"uint64 timestamp\nfloat32 x\n")
channel = foxglove.Channel("/probe", message_encoding="cdr", schema=schema)
with open("port.new", "w") as stream:
    stream.write(str(server.port))
os.rename("port.new", "port")
deadline = time.monotonic() + 100
while time.monotonic() < deadline:
    channel.log(b"\0\1\0\0" + struct.pack("<Qf", 1, 0.5))
    time.sleep(0.05)
PYTHON
venv/bin/python server.py 2>server.log &
server=$!
while [ ! -e port ]; do kill -0 "$server"; sleep 0.1; done
cat >probe.mjs <<'JAVASCRIPT'
import assert from 'node:assert'
import { readFileSync } from 'node:fs'
import protocol from '@foxglove/ws-protocol'
import { WebSocket } from 'ws'

const address = `ws://127.0.0.1:${readFileSync('port', 'utf8')}`
function connect(subprotocol) {
  return new Promise((resolve, reject) => {
    setTimeout(() => reject(new Error('no answer')), 20000).unref()
    const client = new protocol.FoxgloveClient({ ws: new WebSocket(address, [subprotocol]) })
    client.on('error', (error) => resolve(error.message ?? String(error)))
    client.on('advertise', (channels) => client.subscribe(channels[0].id))
    client.on('message', ({ data }) => {
      client.close()
      resolve(`a message of ${data.byteLength} bytes`)
    })
  })
}
const seen = {}
for (const name of [protocol.FoxgloveClient.SUPPORTED_SUBPROTOCOL, 'foxglove.sdk.v1']) seen[name] = await connect(name)
console.log('@foxglove/ws-protocol 0.8.0:', seen)
assert.match(seen['foxglove.websocket.v1'], /400/)
assert.equal(seen['foxglove.sdk.v1'], 'a message of 16 bytes')
process.exit(0)
JAVASCRIPT
timeout 60 node probe.mjs
