#!/usr/bin/env bash
# libmav 0.1.1 (Python), 2026-11-29: a number outside of a field's type is reduced modulo 2^n without an error: a heading of
# 70,000 becomes 4,464, a severity of -1 becomes 255, a latitude of 3e9 becomes -1,294,967,296; a fraction is cut off. A
# text or an array that is too long raises an error.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q libmav==0.1.1 pymavlink==2.4.50
venv/bin/python - <<'PYTHON'
from importlib.resources import files

import libmav

messages = libmav.MessageSet(str(files("pymavlink") / "dialects" / "v20" / "common.xml"))


def stored(name, field, value):
    message = messages.create(name)
    message[field] = value
    return message[field]


seen = {
    "hdg 70000": stored("GLOBAL_POSITION_INT", "hdg", 70_000),
    "severity -1": stored("STATUSTEXT", "severity", -1),
    "lat 3e9": stored("GLOBAL_POSITION_INT", "lat", 3_000_000_000),
    "lat 47.9": stored("GLOBAL_POSITION_INT", "lat", 47.9),
}
print("libmav 0.1.1:", seen)
assert seen == {"hdg 70000": 4464, "severity -1": 255, "lat 3e9": -1_294_967_296, "lat 47.9": 47}
for name, field, value in (("STATUSTEXT", "text", "x" * 60), ("ODOMETRY", "q", [1.0, 0.0, 0.0, 0.0, 0.0])):
    try:
        stored(name, field, value)
        refused = False
    except IndexError as error:
        print(f"{field}:", error)
        refused = True
    assert refused
PYTHON
