#!/usr/bin/env bash
# pyproj 3.7.2 (PROJ 9.5.1; 3.8 for Python 3.12 and newer does the same), 2026-11-29: without the grid of the geoid,
# which no wheel has, Transformer.from_crs(..., only_best=True) returns the height above the ellipsoid as the height
# above sea level, without an error or a warning; only the description and an accuracy of -1 show it.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q pyproj==3.7.2
PROJ_NETWORK=OFF "$work/venv/bin/python" -W error - <<'PYTHON'
from pyproj import Transformer

# WGS 84 with ellipsoidal height, to WGS 84 with height above EGM96; in Zurich the geoid is 47 m above the ellipsoid
transformer = Transformer.from_crs("EPSG:4979", "EPSG:4326+5773", always_xy=True, only_best=True)
height = transformer.transform(8.5456, 47.3977, 500.0)[2]
print("pyproj 3.7.2:", height, "m, accuracy", transformer.accuracy, "-", transformer.description)
assert height == 500.0
assert transformer.accuracy == -1
assert "ballpark" in transformer.description
PYTHON
