#!/usr/bin/env bash
# eclipse-zenoh 1.10.2, 2026-11-28: a parameter value that contains ";" becomes two parameters.
# zenoh.Parameters joins names and values by "=" and ";" as they are: it neither escapes nor refuses them.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q eclipse-zenoh==1.10.2
"$work/venv/bin/python" - <<'PYTHON'
import zenoh

parameters = zenoh.Parameters({"vehicle": "north;south", "n": "1"})
print("eclipse-zenoh 1.10.2:", str(parameters), dict(parameters))
assert sorted(str(parameters).split(";")) == ["n=1", "south", "vehicle=north"]
assert dict(parameters) == {"vehicle": "north", "south": "", "n": "1"}
PYTHON
