#!/usr/bin/env bash
# rosbags 0.11.9 and mcap-ros2-support 0.6.0, 2026-11-28: a message as PX4's zenoh module sends it, with up to 31 unused
# bytes behind its CDR (VehicleAttitude: 31), is refused by rosbags as a size mismatch and read by mcap-ros2-support.
# rosbags accepts up to three bytes, which are alignment.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q rosbags==0.11.9 mcap==1.6.0 mcap-ros2-support==0.6.0
cd "$work"
venv/bin/python - <<'PYTHON'
import struct

from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ATTITUDE = "uint64 timestamp\nuint64 timestamp_sample\nfloat32[4] q\nfloat32[4] delta_q_reset\nuint8 quat_reset_counter\n"
NAME = "px4_msgs/msg/VehicleAttitude"
cdr = b"\0\1\0\0" + struct.pack("<QQ4f4fB", 5_000_000, 4_998_000, 1, 0, 0, 0, 1, 0, 0, 0, 1)
store = get_typestore(Stores.EMPTY)
store.register(get_types_from_msg(ATTITUDE, NAME))

seen = {}
for tail in (0, 3, 4, 31):
    payload = cdr + bytes(tail)
    try:
        store.deserialize_cdr(payload, NAME)
        seen[tail] = "read"
    except SerdeError as error:
        seen[tail] = str(error)
with open("tail.mcap", "wb") as stream:
    writer = Writer(stream)
    writer.start(profile="ros2")
    schema = writer.register_schema(NAME, "ros2msg", ATTITUDE.encode())
    writer.add_message(writer.register_channel("/fmu/out/vehicle_attitude", "cdr", schema), 1, cdr + bytes(31), 1)
    writer.finish()
with open("tail.mcap", "rb") as stream:
    reader = make_reader(stream, decoder_factories=[DecoderFactory()])
    (decoded,) = (message for _, _, _, message in reader.iter_decoded_messages())
print("rosbags 0.11.9, by bytes behind the message:", seen)
print("mcap-ros2-support 0.6.0, with 31 bytes: timestamp", decoded.timestamp, "q", decoded.q)
assert seen[0] == seen[3] == "read"
assert "size mismatch" in seen[4] and "size mismatch" in seen[31]
assert decoded.timestamp == 5_000_000
PYTHON
