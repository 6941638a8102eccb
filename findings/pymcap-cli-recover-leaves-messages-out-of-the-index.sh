#!/usr/bin/env bash
# pymcap-cli 0.34.0, 2026-11-29: `recover` of a recording that ends within the indexes of a chunk copies that chunk with the
# indexes that are complete. The messages of the other channels are in the recovered file, but neither in its indexes nor in its
# statistics: Python's mcap 1.6.0, which reads whole chunks, delivers them; @mcap/core 2.2.2 and small-mcap 0.16.0, which go by
# the indexes, do not.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q mcap==1.6.0 pymcap-cli==0.34.0 small-mcap==0.16.0
npm install --silent --no-audit --no-fund @mcap/core@2.2.2 @mcap/nodejs@1.0.2
venv/bin/python - <<'PYTHON'
import struct

from mcap.writer import CompressionType, Writer

CHUNK, MESSAGE_INDEX = 0x06, 0x07

with open("whole.mcap", "wb") as file:
    writer = Writer(file, chunk_size=4000, compression=CompressionType.NONE)
    writer.start(profile="ros2")
    schema = writer.register_schema("px4_msgs/msg/Probe", "ros2msg", b"uint64 timestamp\n")
    slow, fast = (writer.register_channel(topic, "cdr", schema) for topic in ("/slow", "/fast"))
    for number in range(1000):
        channel = fast if number % 10 else slow
        data = b"\0\1\0\0" + struct.pack("<Q", number)
        writer.add_message(channel, number * 10**7, data, number * 10**7)
    writer.finish()
with open("whole.mcap", "rb") as file:
    content = file.read()
position = 8
ends = []  # of the first index behind each chunk
previous = 0
while position < len(content) - 8:
    kind, length = struct.unpack_from("<BQ", content, position)
    position += 9 + length
    if kind == MESSAGE_INDEX and previous == CHUNK:
        ends.append(position)
    previous = kind
with open("cut.mcap", "wb") as file:
    file.write(content[: ends[3]])
PYTHON
venv/bin/pymcap-cli recover cut.mcap -o recovered.mcap --compression none >recover.log 2>&1 || { cat recover.log; exit 1; }
venv/bin/python - <<'PYTHON'
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from small_mcap import read_message


def count(name):
    with open(name, "rb") as file:
        return sum(isinstance(record, Message) for record in StreamReader(file).records)


with open("recovered.mcap", "rb") as file:
    reader = make_reader(file)
    statistics = reader.get_summary().statistics.message_count
    by_chunks = sum(1 for _ in reader.iter_messages())
with open("recovered.mcap", "rb") as file:
    by_indexes = sum(1 for _ in read_message(file))
print(f"messages in the file: {count('recovered.mcap')}, in its statistics: {statistics}")
print(f"mcap 1.6.0 reads {by_chunks}, small-mcap 0.16.0 reads {by_indexes}")
assert by_chunks == count("recovered.mcap")
assert statistics == by_indexes < by_chunks
PYTHON
cat >count.mjs <<'JAVASCRIPT'
import assert from "node:assert";
import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";

const file = await open("recovered.mcap");
const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(file) });
let messages = 0;
for await (const _ of reader.readMessages()) messages += 1;
await file.close();
console.log("@mcap/core 2.2.2 reads", messages);
assert.equal(BigInt(messages), reader.statistics.messageCount);
JAVASCRIPT
node count.mjs
