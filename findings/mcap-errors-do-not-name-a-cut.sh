#!/usr/bin/env bash
# Python's mcap 1.6.0 and @mcap/core 2.2.2, 2026-11-29: a recording that ends early, as after a loss of power, is refused with
# an error about a record of an impossible length, or about magic bytes that depend on the place of the cut. None says that
# the end is missing. Read forwards, both libraries deliver the same complete chunks.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q mcap==1.6.0
npm install --silent --no-audit --no-fund @mcap/core@2.2.2 @mcap/nodejs@1.0.2
venv/bin/python - <<'PYTHON'
import struct
from io import BytesIO

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Header, Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

stream = BytesIO()
writer = Writer(stream, chunk_size=2000, compression=CompressionType.NONE)
writer.start(profile="ros2")
schema = writer.register_schema("px4_msgs/msg/Probe", "ros2msg", b"uint64 timestamp\n")
channel = writer.register_channel("/probe", "cdr", schema)
for number in range(2000):
    writer.add_message(channel, number * 10**7, b"\0\1\0\0" + struct.pack("<Q", number), number * 10**7)
writer.finish()
cut = stream.getvalue()[: len(stream.getvalue()) * 3 // 5]
with open("cut.mcap", "wb") as file:
    file.write(cut)

error = ""
try:
    list(make_reader(BytesIO(cut)).iter_messages())
except McapError as exception:
    error = f"{type(exception).__name__}: {exception}"
print("mcap 1.6.0:", error)
records = []
try:
    for record in StreamReader(BytesIO(cut)).records:
        records.append(record)
except McapError as exception:
    print("mcap 1.6.0, forwards:", type(exception).__name__)
messages = sum(isinstance(record, Message) for record in records)
print("mcap 1.6.0, forwards:", messages, "messages")
assert error.startswith("RecordLengthLimitExceeded") and "exceeds limit" in error
assert isinstance(records[0], Header) and messages == 1220
PYTHON
cat >cut.mjs <<'JAVASCRIPT'
import assert from "node:assert";
import { open, readFile } from "node:fs/promises";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";

const file = await open("cut.mcap");
let error = "";
try {
  await McapIndexedReader.Initialize({ readable: new FileHandleReadable(file) });
} catch (exception) {
  error = String(exception);
}
await file.close();
console.log("@mcap/core 2.2.2:", error);
const reader = new McapStreamReader();
reader.append(await readFile("cut.mcap"));
let messages = 0;
for (let record; (record = reader.nextRecord()); ) {
  if (record.type === "Message") messages += 1;
}
console.log("@mcap/core 2.2.2, forwards:", messages, "messages");
assert(error.includes("Expected MCAP magic"));
assert(!/trunc|incomplete|footer|cut off/i.test(error));
assert.equal(messages, 1220);
JAVASCRIPT
node cut.mjs
