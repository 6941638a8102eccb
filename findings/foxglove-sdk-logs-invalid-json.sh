#!/usr/bin/env bash
# foxglove-sdk 0.30.3 (Python), 2026-11-28: Channel.log of a dict with NaN or infinity, as PX4's ref_alt or vxy_max often
# are, records the words NaN and Infinity, which JSON does not have: Python's json reads them, JavaScript's JSON does not.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q foxglove-sdk==0.30.3 mcap==1.6.0
venv/bin/python - <<'PYTHON'
import math

import foxglove
from mcap.reader import make_reader

with foxglove.open_mcap("flight.mcap"):
    foxglove.Channel("/position").log({"ref_alt": math.nan, "vxy_max": math.inf}, log_time=1)
with open("flight.mcap", "rb") as stream:
    ((_, channel, message),) = make_reader(stream).iter_messages()
print("foxglove-sdk 0.30.3:", channel.message_encoding, message.data)
assert channel.message_encoding == "json"
assert message.data == b'{"ref_alt": NaN, "vxy_max": Infinity}'
with open("message.json", "wb") as stream:
    stream.write(message.data)
PYTHON
node -e '
try {
  JSON.parse(require("fs").readFileSync("message.json", "utf8"));
  process.exit(1);
} catch (error) {
  console.log("JSON.parse:", error.message.split("\n")[0]);
}'
