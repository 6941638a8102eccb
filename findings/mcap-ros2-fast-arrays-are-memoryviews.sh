#!/usr/bin/env bash
# mcap-ros2-support-fast 0.8.0, 2026-11-28: arrays of numbers are memoryviews where mcap-ros2-support 0.6.0 gives lists
# and bytes: a decoded VehicleAttitude.q equals no list, and json.dumps refuses it.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q mcap==1.6.0 mcap-ros2-support==0.6.0 mcap-ros2-support-fast==0.8.0
venv/bin/python - <<'PYTHON'
import json
import struct

import mcap_ros2.decoder
import mcap_ros2_support_fast.decoder
from mcap.reader import make_reader
from mcap.writer import Writer

NAME = "px4_msgs/msg/Probe"
with open("arrays.mcap", "wb") as stream:
    writer = Writer(stream)
    writer.start(profile="ros2")
    schema = writer.register_schema(NAME, "ros2msg", b"float32[4] q\nuint8[4] raw\n")
    payload = b"\0\1\0\0" + struct.pack("<4f4B", 1, 0, 0, 0, 1, 2, 3, 4)
    writer.add_message(writer.register_channel("/probe", "cdr", schema), 1, payload, 1)
    writer.finish()
kinds = {}
for module in (mcap_ros2.decoder, mcap_ros2_support_fast.decoder):
    with open("arrays.mcap", "rb") as stream:
        reader = make_reader(stream, decoder_factories=[module.DecoderFactory()])
        (message,) = (decoded for _, _, _, decoded in reader.iter_decoded_messages())
    kinds[module.__name__] = [type(message.q).__name__, type(message.raw).__name__, message.q == [1.0, 0.0, 0.0, 0.0]]
print(kinds)
try:
    json.dumps(message.q)
    refused = False
except TypeError as error:
    print("json.dumps:", error)
    refused = True
assert kinds["mcap_ros2.decoder"] == ["list", "bytes", True]
assert kinds["mcap_ros2_support_fast.decoder"] == ["memoryview", "memoryview", False]
assert refused
PYTHON
