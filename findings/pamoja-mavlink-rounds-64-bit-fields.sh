#!/usr/bin/env bash
# pamoja-mavlink 0.2.0, 2026-11-29: `to_dict` and `from_dict` pass 64-bit integers through a float: the unique id of a flight
# controller in AUTOPILOT_VERSION differs from that in the frame, and a frame built from a dict carries another id than was
# given. `get_int` reads the exact number.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q pamoja-mavlink==0.2.0 pymavlink==2.4.50
MAVLINK20=1 "$work/venv/bin/python" - <<'PYTHON'
from pamoja import mavlink
from pymavlink.dialects.v20 import common

UID = 0x0000_5678_9ABC_DEF1 << 8 | 0x35
shape = mavlink.schema_for("AUTOPILOT_VERSION")

link = common.MAVLink(None, srcSystem=1, srcComponent=1)
frame = common.MAVLink_autopilot_version_message(0, 0, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, UID).pack(link)
(received,) = mavlink.MavlinkParser().push(frame)
message = mavlink.MavlinkMessage.decode(shape, received.payload)
read = mavlink.to_dict(message, shape)["uid"]
print(f"sent     {UID}\nto_dict  {int(read)}\nget_int  {message.get_int('uid')}")
assert message.get_int("uid") == UID
assert int(read) != UID

sent = mavlink.from_dict(shape, {"uid": UID}).to_frame(mavlink.MavlinkHeader(1, 1, 0))
(decoded,) = common.MAVLink(None).parse_buffer(bytes(sent.bytes))
print(f"a frame from a dict with {UID} carries {decoded.uid}")
assert decoded.uid != UID
PYTHON
