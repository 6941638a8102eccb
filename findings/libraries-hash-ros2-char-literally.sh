#!/usr/bin/env bash
# 2026-11-28: rosbags 0.11.9 and zenoh-ros2-sdk 0.1.8 hash the `char` of a .msg file as IDL's char, while ROS 2's own
# generator (4.9.5) hashes it as uint8, so keys of rmw_zenoh do not match; a `byte` and all else are hashed alike.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv generator
generator/bin/pip install -q ros-rosidl-generator-type-description==4.9.5 ros-rosidl-adapter==4.9.5 \
    ros-rosidl-cli==4.9.5 pyyaml catkin_pkg lark
python3 -m venv others
others/bin/pip install -q rosbags==0.11.9 zenoh-ros2-sdk==0.1.8
mkdir msg
printf 'uint64 stamp\nbyte flags\nfloat32[3] place\n' >msg/Plain.msg
printf 'uint64 stamp\nchar letter\n' >msg/Letter.msg
AMENT_PREFIX_PATH=$work/generator generator/bin/rosidl hash -o out probe_msgs msg/Plain.msg msg/Letter.msg \
    >log 2>&1 || { cat log; exit 1; }
others/bin/python - <<'PYTHON'
import json
from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh_ros2_sdk.utils import get_type_hash

agreeing = {}
for name in ("Plain", "Letter"):
    text, kind = Path(f"msg/{name}.msg").read_text(), f"probe_msgs/msg/{name}"
    hashes = json.loads(Path(f"out/msg/{name}.json").read_text())["type_hashes"]
    own = next(each["hash_string"] for each in hashes if each["type_name"] == kind)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, kind))
    found = {
        "generator 4.9.5": own,
        "rosbags 0.11.9": store.hash_rihs01(kind),
        "zenoh-ros2-sdk 0.1.8": get_type_hash(kind, msg_definition=text, dependencies={}),
    }
    for library, digest in found.items():
        print(f"{name:<8} {library:<22} {digest[:23]}...")
    agreeing[name] = [digest == own for digest in found.values()]
assert agreeing == {"Plain": [True, True, True], "Letter": [True, False, False]}, agreeing
PYTHON
