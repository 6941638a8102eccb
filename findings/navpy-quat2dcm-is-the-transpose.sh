#!/usr/bin/env bash
# NavPy 1.0 and SciPy 1.17.1, 2026-11-28: of the same attitude, navpy.quat2dcm gives the transpose of SciPy's matrix: it
# rotates NED into body, while PX4's quaternion (and SciPy's as_matrix) rotates body into NED. The angles of both agree.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q NavPy==1.0 "numpy==2.4.*" "scipy==1.17.*"
"$work/venv/bin/python" - <<'PYTHON'
import navpy
import numpy as np
from scipy.spatial.transform import Rotation

attitude = Rotation.from_euler("ZYX", [0.7, 0.2, 0.1])
x, y, z, w = attitude.as_quat()
navpy_matrix = np.asarray(navpy.quat2dcm(w, np.array([x, y, z])))
print("NavPy:", navpy_matrix[0], "SciPy:", attitude.as_matrix()[0])
assert np.allclose(navpy_matrix, attitude.as_matrix().T)
assert not np.allclose(navpy_matrix, attitude.as_matrix())
assert np.allclose(navpy.quat2angle(w, np.array([x, y, z])), [0.7, 0.2, 0.1])
PYTHON
