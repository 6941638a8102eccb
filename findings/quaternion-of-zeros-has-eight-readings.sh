#!/usr/bin/env bash
# SciPy 1.17, spatialmath 1.1.18, numpy-quaternion 2024.0.13, transforms3d 0.4.2, pytransform3d 3.17.0, pyquaternion 0.9.9,
# NavPy 1.0, AHRS 0.4.0, 2026-11-29: a quaternion of zeros, PX4's and MAVLink's "no attitude" of an odometry or a home
# position, is an error in some, and in others the identity, a matrix of zeros, a matrix of NaN, or a reversed attitude.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q "scipy==1.17.*" spatialmath-python==1.1.18 numpy-quaternion==2024.0.13 transforms3d==0.4.2 \
    pytransform3d==3.17.0 pyquaternion==0.9.9 NavPy==1.0 AHRS==0.4.0
venv/bin/python -W ignore - <<'PYTHON'
import ahrs
import navpy
import numpy as np
import pyquaternion
import quaternion
import spatialmath
import transforms3d
from pytransform3d.rotations import matrix_from_quaternion
from scipy.spatial.transform import Rotation

zeros = [0.0, 0.0, 0.0, 0.0]
READERS = {
    "SciPy": lambda: Rotation.from_quat(zeros).as_matrix(),
    "spatialmath": lambda: spatialmath.UnitQuaternion(zeros).R,
    "numpy-quaternion": lambda: quaternion.as_rotation_matrix(np.quaternion(*zeros)),
    "numpy-quaternion, Euler": lambda: quaternion.as_euler_angles(np.quaternion(*zeros)),
    "transforms3d": lambda: transforms3d.quaternions.quat2mat(zeros),
    "pytransform3d": lambda: matrix_from_quaternion(zeros),
    "pyquaternion": lambda: pyquaternion.Quaternion(zeros).rotation_matrix,
    "NavPy": lambda: navpy.quat2dcm(0.0, np.zeros(3)),
    "NavPy, angles": lambda: navpy.quat2angle(0.0, np.zeros(3)),
    "AHRS, class": lambda: ahrs.Quaternion(zeros).to_DCM(),
    "AHRS, q2R": lambda: ahrs.common.orientation.q2R(np.zeros(4)),
    "AHRS, q2rpy": lambda: ahrs.common.orientation.q2rpy(np.zeros(4)),
}
seen = {}
for name, read in READERS.items():
    try:
        seen[name] = np.asarray(read(), float)
    except (ValueError, ZeroDivisionError) as error:
        seen[name] = type(error).__name__
    print(f"{name:24}", str(seen[name]).replace("\n", ""))
assert seen["SciPy"] == seen["spatialmath"] == seen["AHRS, class"] == "ValueError"
assert seen["numpy-quaternion"] == "ZeroDivisionError"
assert np.array_equal(seen["numpy-quaternion, Euler"], [0, np.nan, 0], equal_nan=True)
assert np.array_equal(seen["transforms3d"], np.eye(3)) and np.array_equal(seen["pytransform3d"], np.eye(3))
assert not seen["pyquaternion"].any()
assert np.array_equal(seen["NavPy"], -np.eye(3))
assert np.allclose(seen["NavPy, angles"], [np.pi, 0, np.pi])
assert np.isnan(seen["AHRS, q2R"]).all()
assert not seen["AHRS, q2rpy"].any()
PYTHON
