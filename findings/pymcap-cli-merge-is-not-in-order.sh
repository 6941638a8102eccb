#!/usr/bin/env bash
# pymcap-cli 0.34.0, 2026-11-29: `pymcap-cli merge` of two recordings of the same 20 s says that it interleaves the messages in
# the order of time. It copies whole chunks as they are: a reader of the file from its begin to its end sees steps back in
# time of seconds. A reader that uses the index, such as Python's `iter_messages`, gets all messages in order.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q pymcap-cli==0.34.0 mcap==1.6.0
cat >recording.py <<'PYTHON'
import struct
import sys

from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import Writer


def write(name, topic, offset, chunk_size):
    """Write 100 messages per second for 20 s, in chunks of this size [bytes]."""
    with open(name, "wb") as stream:
        writer = Writer(stream, chunk_size=chunk_size)
        writer.start(profile="ros2")
        schema = writer.register_schema("px4_msgs/msg/Probe", "ros2msg", b"uint64 timestamp\n")
        channel = writer.register_channel(topic, "cdr", schema, {"vehicle": topic[1:2]})
        for number in range(2000):
            stamp = number * 10**7 + offset
            writer.add_message(channel, stamp, b"\0\1\0\0" + struct.pack("<Q", stamp // 1000), stamp)
        writer.finish()


if sys.argv[1] == "write":
    write("one.mcap", "/1/probe", 0, 8_000)
    write("two.mcap", "/2/probe", 1000, 60_000)
else:
    with open("merged.mcap", "rb") as stream:
        in_file = [record.log_time for record in StreamReader(stream).records if isinstance(record, Message)]
    with open("merged.mcap", "rb") as stream:
        reader = make_reader(stream)
        by_index = [message.log_time for _, _, message in reader.iter_messages()]
        vehicles = sorted(channel.metadata["vehicle"] for channel in reader.get_summary().channels.values())
    steps = [before - after for before, after in zip(in_file, in_file[1:]) if after < before]
    print(f"{len(in_file)} messages, {len(steps)} steps back in the file, up to {max(steps) / 1e9:.1f} s")
    assert len(in_file) == len(by_index) == 4000
    assert len(steps) > 2 and max(steps) > 1e9
    assert by_index == sorted(in_file)
    assert vehicles == ["1", "2"]
PYTHON
venv/bin/python recording.py write
venv/bin/pymcap-cli merge --help | tr -s ' \n' ' ' | grep -q 'interleaved in time order across all input files'
venv/bin/pymcap-cli merge one.mcap two.mcap -o merged.mcap >merge.log 2>&1
venv/bin/python recording.py check
