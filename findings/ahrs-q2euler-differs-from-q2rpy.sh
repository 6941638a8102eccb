#!/usr/bin/env bash
# ahrs 0.4.0, 2026-11-28: two functions of one module turn the same unit quaternion into different angles. q2rpy gives
# the roll, pitch and yaw of PX4's attitude (0.1, 0.2, 0.7); q2euler gives the angles of another convention.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q ahrs==0.4.0
"$work/venv/bin/python" - <<'PYTHON'
import math

import numpy as np
from ahrs.common.orientation import q2euler, q2rpy

c, s = zip(*((math.cos(angle / 2), math.sin(angle / 2)) for angle in (0.1, 0.2, 0.7)))
q = np.array(  # (w, x, y, z), body to NED, as VehicleAttitude.q
    [
        c[0] * c[1] * c[2] + s[0] * s[1] * s[2],
        s[0] * c[1] * c[2] - c[0] * s[1] * s[2],
        c[0] * s[1] * c[2] + s[0] * c[1] * s[2],
        c[0] * c[1] * s[2] - s[0] * s[1] * c[2],
    ]
)
print("ahrs 0.4.0, of roll 0.1, pitch 0.2, yaw 0.7: q2rpy", q2rpy(q), "q2euler", q2euler(q))
assert np.allclose(q2rpy(q), [0.1, 0.2, 0.7])
assert np.allclose(q2euler(q), [0.05224082, -0.21720999, -0.69565555])
PYTHON
