#!/usr/bin/env bash
# rosbags 0.11.9, 2026-11-29: `end_time` of a bag is one nanosecond after its last message, and `duration` is one more than
# the metadata.yaml that the library itself wrote, in both storages. The end of `messages(stop=...)` is not part of the range.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q rosbags==0.11.9
venv/bin/python - <<'PYTHON'
import re
from pathlib import Path

from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

types = get_typestore(Stores.ROS2_JAZZY)
types.register(get_types_from_msg("uint64 timestamp\n", "px4_msgs/msg/Probe"))
Probe = types.types["px4_msgs/msg/Probe"]
for storage in (StoragePlugin.SQLITE3, StoragePlugin.MCAP):
    folder = Path(storage.name.lower())
    with Writer(folder, version=9, storage_plugin=storage) as writer:
        connection = writer.add_connection("/probe", Probe.__msgtype__, typestore=types)
        for stamp in (1000, 2000, 4000):
            writer.write(connection, stamp, types.serialize_cdr(Probe(stamp), Probe.__msgtype__))
    written = int(re.search(r"nanoseconds: (\d+)", (folder / "metadata.yaml").read_text()).group(1))
    with Reader(folder) as reader:
        stamps = [stamp for _, stamp, _ in reader.messages(stop=4000)]
        print(f"{folder}: end_time {reader.end_time}, duration {reader.duration}, in metadata.yaml {written}")
        assert (reader.start_time, reader.end_time, reader.duration) == (1000, 4001, 3001)
    assert written == 3000
    assert stamps == [1000, 2000]
PYTHON
