#!/usr/bin/env bash
# mcapfixindex 0.1.0 (with mcap 1.6.0), 2026-11-28: the tool that rebuilds a missing summary refuses a recording whose
# writer was stopped, which has none, as "unknown (opcode 0) record ...". mcap's StreamReader reads its complete chunks.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q mcap==1.6.0 mcapfixindex==0.1.0
venv/bin/python - <<'PYTHON'
from mcap.exceptions import EndOfFile
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

with open("stopped.mcap", "wb") as stream:
    writer = Writer(stream, chunk_size=1000)
    writer.start()
    schema = writer.register_schema("Position", "jsonschema", b'{"type": "object"}')
    channel = writer.register_channel("/position", "json", schema)
    for i in range(100):
        writer.add_message(channel, i, b'{"x": 1}', i)
count = 0
with open("stopped.mcap", "rb") as stream:
    try:
        for record in StreamReader(stream).records:
            count += isinstance(record, Message)
    except EndOfFile:
        pass
print("mcap 1.6.0: StreamReader reads", count, "of 100 messages")
assert 0 < count < 100
PYTHON
code=0
venv/bin/mcapfixindex fix --input stopped.mcap --output fixed.mcap >output.txt 2>&1 || code=$?
cat output.txt
[ "$code" -ne 0 ] && grep -q "opcode 0" output.txt && [ ! -e fixed.mcap ]
