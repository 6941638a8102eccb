#!/usr/bin/env bash
# mcap-ros2-support 0.6.0, 2026-11-28: its Writer records a dict with a missing, misspelled or wrong value without an error:
# missing numbers are 0 (not NaN), fractions are cut off, a text is true, arrays are filled with 0 or cut to their length.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q mcap==1.6.0 mcap-ros2-support==0.6.0
venv/bin/python - <<'PYTHON'
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

DEFINITION = "uint64 timestamp\nfloat32 x\nbool valid\nfloat32[4] q\n"
GOOD = {"timestamp": 1, "x": 1.5, "valid": True, "q": [1.0, 0.0, 0.0, 0.0]}
CASES = {
    "missing": {"timestamp": 1, "valid": True},
    "misspelled": {**GOOD, "X": 2.5},
    "fraction": {**GOOD, "timestamp": 1.75},
    "text": {**GOOD, "valid": "false"},
    "short": {**GOOD, "q": [1.0, 0.5]},
    "long": {**GOOD, "q": [1.0, 2.0, 3.0, 4.0, 5.0]},
}
with open("cases.mcap", "wb") as stream:
    writer = Writer(stream)
    schema = writer.register_msgdef("px4_msgs/msg/Probe", DEFINITION)
    for number, fields in enumerate(CASES.values()):
        writer.write_message("/probe", schema, fields, number, number)
    writer.finish()
seen = {}
with open("cases.mcap", "rb") as stream:
    decoded = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
    for case, (_, _, _, message) in zip(CASES, decoded, strict=True):
        seen[case] = (message.timestamp, message.x, message.valid, message.q)
        print(f"{case:10} -> {message}")
q = [1.0, 0.0, 0.0, 0.0]
assert seen["missing"] == (1, 0.0, True, [0.0] * 4)
assert seen["misspelled"] == seen["fraction"] == seen["text"] == (1, 1.5, True, q)
assert seen["short"] == (1, 1.5, True, [1.0, 0.5, 0.0, 0.0])
assert seen["long"] == (1, 1.5, True, [1.0, 2.0, 3.0, 4.0])
PYTHON
