#!/usr/bin/env bash
# mcap-bag-parser 0.3.1, 2026-11-29: `parse_mcap_file` leaves out arrays of more than 100 elements without a word: the text of
# PX4's log messages, `char[127]`, has no column, while an array of 100 has one column per element.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q mcap-bag-parser==0.3.1 mcap==1.6.0
venv/bin/python - <<'PYTHON'
import struct
from pathlib import Path

import mcap_bag
from mcap.writer import Writer


def columns_of(name, field, payload):
    """Return the columns of a recording of one message with this field."""
    path = Path(name)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        definition = f"uint64 timestamp\nuint8 severity\n{field} text\n"
        schema = writer.register_schema("px4_msgs/msg/LogMessage", "ros2msg", definition.encode())
        channel = writer.register_channel("/1/log_message", "cdr", schema)
        data = b"\0\1\0\0" + struct.pack("<QB", 5_000_000, 4) + payload
        writer.add_message(channel, 5 * 10**9, data, 5 * 10**9)
        writer.finish()
    return list(mcap_bag.parse_mcap_file(str(path))["/1/log_message"].columns)


others = ["msg_timestamp", "timestamp", "severity"]
seen = {size: columns_of(f"{size}.mcap", f"uint8[{size}]", bytes(size)) for size in (100, 101, 127)}
seen["char[127]"] = columns_of("char.mcap", "char[127]", b"Takeoff detected".ljust(127, b"\0"))
for size, columns in seen.items():
    print(size, [column for column in columns if column not in others][:2])
assert seen[100] == [*others, *(f"text.{index}" for index in range(100))]
assert seen[101] == seen[127] == seen["char[127]"] == others
PYTHON
