#!/usr/bin/env bash
# mavio 0.9.1 (with foxglove-sdk 0.30.3), 2026-11-29: `mavio convert` of a .tlog writes GPS_RAW_INT and GLOBAL_POSITION_INT
# as locations on one topic. While the receiver has no fix, its locations are latitude 0 and longitude 0, between those of
# the estimator: on a map the vehicle jumps to the Gulf of Guinea and back with each message.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q "mavio[foxglove]==0.9.1" foxglove-sdk==0.30.3 mcap==1.6.0 mcap-protobuf-support==0.6.0 pymavlink==2.4.50
venv/bin/python - <<'PYTHON'
import struct

from pymavlink.dialects.v20 import common

link = common.MAVLink(None, srcSystem=1, srcComponent=1)
with open("flight.tlog", "wb") as stream:
    for number in range(5):
        boot_ms = 10_000 + 100 * number
        messages = [
            common.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3),
            # the estimator goes on without the receiver, which has lost its fix
            common.MAVLink_global_position_int_message(boot_ms, 473977420, 85455940, 500_000, 10_000, 0, 0, 0, 9000),
            common.MAVLink_gps_raw_int_message(boot_ms * 1000, 1, 0, 0, 0, 65535, 65535, 65535, 65535, 255),
        ]
        for message in messages:
            stream.write(struct.pack(">Q", 1_700_000_000_000_000 + 100_000 * number) + message.pack(link))
            link.seq = (link.seq + 1) % 256
PYTHON
venv/bin/mavio convert flight.tlog flight.mcap
venv/bin/python - <<'PYTHON'
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

decoder = None
seen = []
with open("flight.mcap", "rb") as stream:
    for schema, channel, message in make_reader(stream).iter_messages():
        if schema.name == "foxglove.LocationFix":
            decoder = decoder or DecoderFactory().decoder_for("protobuf", schema)
            location = decoder(message.data)
            seen.append((channel.topic, round(location.latitude, 4), round(location.longitude, 4)))
print(*seen[:4], sep="\n")
assert {topic for topic, _, _ in seen} == {"/mavlink/1_1/location"}
assert [place for _, *place in seen] == [[47.3977, 8.5456], [0.0, 0.0]] * 5
PYTHON
