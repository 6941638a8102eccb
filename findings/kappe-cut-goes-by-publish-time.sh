#!/usr/bin/env bash
# kappe 0.25.0, 2026-11-29: `kappe cut` puts a message into a part by its publish time, while its documentation says log time:
# with publish times 3 s before the log times, as of a transport with a delay, parts have other messages. A message at the
# boundary of two parts is in both, one at the last end in none. Metadata records and attachments are gone.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q kappe==0.25.0 mcap==1.6.0
cat >recording.py <<'PYTHON'
import struct
import sys

from mcap.reader import make_reader
from mcap.writer import Writer

START = 1_700_000_000


def write(name, delay):
    """Write a message each second for 10 s, published `delay` seconds before its log time."""
    with open(name, "wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema("px4_msgs/msg/Probe", "ros2msg", b"uint64 timestamp\n")
        channel = writer.register_channel("/probe", "cdr", schema)
        for second in range(START, START + 11):
            data = b"\0\1\0\0" + struct.pack("<Q", second)
            writer.add_message(channel, second * 10**9, data, (second - delay) * 10**9)
        writer.add_metadata("origin", {"log": "flight.ulg"})
        writer.add_attachment(START * 10**9, START * 10**9, "note.txt", "text/plain", b"first flight")
        writer.finish()


def read(name):
    """Return the log times, relative to the start [s], and the number of metadata records and attachments."""
    with open(name, "rb") as stream:
        reader = make_reader(stream)
        times = [message.log_time // 10**9 - START for _, _, message in reader.iter_messages()]
        return times, len(list(reader.iter_metadata())), len(list(reader.iter_attachments()))


if sys.argv[1] == "write":
    write("prompt.mcap", 0)
    write("delayed.mcap", 3)
else:
    seen = {name: read(name) for name in ("prompt.mcap", "prompt/a.mcap", "prompt/b.mcap", "delayed/a.mcap", "delayed/b.mcap")}
    for name, content in seen.items():
        print(name, *content)
    assert seen["prompt.mcap"] == ([*range(11)], 1, 1)
    assert seen["prompt/a.mcap"] == ([0, 1, 2, 3, 4, 5], 0, 0)
    assert seen["prompt/b.mcap"] == ([5, 6, 7, 8, 9], 0, 0)
    assert seen["delayed/a.mcap"] == ([3, 4, 5, 6, 7, 8], 0, 0)
    assert seen["delayed/b.mcap"] == ([8, 9], 0, 0)
PYTHON
cat >cut.yaml <<'YAML'
splits:
  - {start: 1700000000.0, end: 1700000005.0, name: a.mcap}
  - {start: 1700000005.0, end: 1700000010.0, name: b.mcap}
YAML
venv/bin/python recording.py write
for name in prompt delayed; do
    venv/bin/kappe cut --config cut.yaml --output "$name" "$name.mcap" >kappe.log 2>&1
done
venv/bin/python recording.py check
