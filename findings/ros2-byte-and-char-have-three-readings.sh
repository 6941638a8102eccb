#!/usr/bin/env bash
# 2026-11-28, three decoders of one ROS 2 message whose `byte` and `char` are 200: rosbags 0.11.9 reads the byte as -56,
# mcap-ros2-support 0.6.0 the char as -56, @foxglove/rosmsg2-serialization 3.1.0 both as 200 (ROS 2: octet and uint8).
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q rosbags==0.11.9 mcap==1.6.0 mcap-ros2-support==0.6.0
npm install --silent --no-audit --no-fund @foxglove/rosmsg@5.0.5 @foxglove/rosmsg2-serialization@3.1.0
venv/bin/python - <<'PYTHON'
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

DEFINITION, NAME = "byte flags\nbyte[2] more\nchar letter\n", "px4_msgs/msg/Probe"
cdr = b"\0\1\0\0" + bytes([200, 201, 7, 200])
with open("message.cdr", "wb") as stream:
    stream.write(cdr)
store = get_typestore(Stores.EMPTY)
store.register(get_types_from_msg(DEFINITION, NAME))
bag = store.deserialize_cdr(cdr, NAME)
with open("byte.mcap", "wb") as stream:
    writer = Writer(stream)
    writer.start(profile="ros2")
    schema = writer.register_schema(NAME, "ros2msg", DEFINITION.encode())
    writer.add_message(writer.register_channel("/probe", "cdr", schema), 1, cdr, 1)
    writer.finish()
with open("byte.mcap", "rb") as stream:
    reader = make_reader(stream, decoder_factories=[DecoderFactory()])
    (message,) = (decoded for _, _, _, decoded in reader.iter_decoded_messages())
print("rosbags 0.11.9:", int(bag.flags), bag.more.tolist(), bag.more.dtype, int(bag.letter))
print("mcap-ros2-support 0.6.0:", message.flags, list(message.more), message.letter)
assert (int(bag.flags), bag.more.tolist(), int(bag.letter)) == (-56, [-55, 7], 200)
assert (message.flags, list(message.more), message.letter) == (200, [201, 7], -56)
PYTHON
node - <<'JAVASCRIPT'
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const reader = new MessageReader(parse("byte flags\nbyte[2] more\nchar letter\n", { ros2: true }));
const message = reader.readMessage(require("fs").readFileSync("message.cdr"));
console.log("@foxglove/rosmsg2-serialization 3.1.0:", message.flags, [...message.more], message.letter);
require("assert").deepEqual([message.flags, ...message.more, message.letter], [200, 201, 7, 200]);
JAVASCRIPT
