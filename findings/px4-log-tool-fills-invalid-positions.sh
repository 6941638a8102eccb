#!/usr/bin/env bash
# px4-log-tool 0.6.4 (and pandas 2.1.2, which it pins), 2026-11-29: `resample_data`, which `ulog2csv -m -r` uses, turns an
# outage into a straight line: positions of NaN are interpolated, and those before the first valid one filled. A row at
# 10 Hz has the last value of its 0.1 s under the time at which they begin, so values seem up to 0.1 s too early.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q px4-log-tool==0.6.4
venv/bin/python -W ignore - <<'PYTHON'
import numpy as np
import pandas as pd
from px4_log_tool.processing_modules.resampler import resample_data

# x is the time in seconds, at 50 Hz; it is unknown before 0.2 s and from 0.5 to 1 s
micros = np.arange(0, 1_500_000, 20_000)
x = micros / 1e6
x[(micros < 200_000) | ((micros >= 500_000) & (micros < 1_000_000))] = np.nan
rows = pd.DataFrame({"timestamp": micros, "x": x, "mission": "one"})
table = resample_data(rows, 10, num_columns=["x"], cat_columns=["mission"], cat_method="ffill")
seconds = (table["timestamp"] - pd.Timestamp(0)).dt.total_seconds().to_numpy()
print(pd.DataFrame({"seconds": seconds, "x": table["x"]}).to_string(index=False))
assert len(table) == 15 and table["x"].notna().all()
assert np.allclose(table["x"][seconds >= 0.2] - seconds[seconds >= 0.2], 0.08)
assert np.allclose(table["x"][seconds < 0.2], 0.28)
PYTHON
