#!/usr/bin/env bash
# Python's mcap 1.6.0 and @mcap/core 2.2.2, 2026-11-29: the same range of log times selects different messages. The end of
# Python's `iter_messages` is not part of the range, the `endTime` of `readMessages` is: adjacent parts read in JavaScript
# have the messages at their boundary twice.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q mcap==1.6.0
npm install --silent --no-audit --no-fund @mcap/core@2.2.2 @mcap/nodejs@1.0.2
venv/bin/python -W ignore::DeprecationWarning - <<'PYTHON'
import struct

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

with open("flight.mcap", "wb") as stream:
    writer = Writer(stream, compression=CompressionType.NONE)
    writer.start(profile="ros2")
    schema = writer.register_schema("px4_msgs/msg/Probe", "ros2msg", b"uint64 timestamp\n")
    channel = writer.register_channel("/probe", "cdr", schema)
    for second in range(5):
        writer.add_message(channel, second * 10**9, b"\0\1\0\0" + struct.pack("<Q", second), second * 10**9)
    writer.finish()
with open("flight.mcap", "rb") as stream:
    found = make_reader(stream).iter_messages(start_time=10**9, end_time=3 * 10**9)
    seconds = [message.log_time // 10**9 for _, _, message in found]
print("mcap 1.6.0: seconds", seconds)
assert seconds == [1, 2]
PYTHON
cat >range.mjs <<'JAVASCRIPT'
import assert from "node:assert";
import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";

const file = await open("flight.mcap");
const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(file) });
const seconds = [];
for await (const message of reader.readMessages({ startTime: 10n ** 9n, endTime: 3n * 10n ** 9n })) {
  seconds.push(Number(message.logTime / 10n ** 9n));
}
await file.close();
console.log("@mcap/core 2.2.2: seconds", seconds);
assert.deepEqual(seconds, [1, 2, 3]);
JAVASCRIPT
node range.mjs
