#!/usr/bin/env bash
# rosbag-resurrector 0.8.7, 2026-11-29: its health report takes a topic that is sent on change, as PX4's vehicle_status or
# home_position, for one with lost messages ("~3 missing messages"), and gives it 44 of 100 points. Messages whose type it
# does not know have no fields in its tables, although the recording contains their definition.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q rosbag-resurrector==0.8.7 mcap==1.6.0
HOME="$work" venv/bin/python - <<'PYTHON'
import struct

from mcap.writer import Writer
from resurrector import BagFrame

START = 1_700_000_000_000_000_000
with open("flight.mcap", "wb") as stream:
    writer = Writer(stream)
    writer.start(profile="ros2")
    schema = writer.register_schema("px4_msgs/msg/Probe", "ros2msg", b"uint64 timestamp\nfloat32 x\n")
    topics = [writer.register_channel(topic, "cdr", schema) for topic in ("/vehicle_local_position", "/vehicle_status")]
    for tenth in range(100):
        log_time = START + 100_000_000 * tenth
        data = b"\0\1\0\0" + struct.pack("<Qf", 100_000 * tenth, tenth / 10)
        writer.add_message(topics[0], log_time, data, log_time)
        if tenth < 7 or tenth in (60, 61):  # several changes at the start, and again at 6 s
            writer.add_message(topics[1], log_time, data, log_time)
    writer.finish()
bag = BagFrame("flight.mcap")
columns = bag["/vehicle_local_position"].to_polars().columns
scores = bag.health_report().topic_scores
issues = [issue.message for result in scores["/vehicle_status"].results for issue in result.issues]
print("columns:", columns)
print({topic: health.score for topic, health in scores.items()}, issues)
assert columns == ["timestamp_ns"]
assert scores["/vehicle_local_position"].score == 100
assert scores["/vehicle_status"].score < 50
assert any("missing messages" in text for text in issues)
PYTHON
