#!/usr/bin/env bash
# pyarrow 26.0.1, DataFusion 55.0.0, DuckDB 2.0.1, polars 2.1.0, pandas 3.1.1, NumPy 2.4, 2026-11-29: of a float32 of 0.1,
# such as a limit that a vehicle reports, `x <= 0.1` is true in NumPy, pandas, polars and DuckDB, which compare as float32,
# and false in pyarrow and DataFusion, which compare as float64 (0.1 as a float32 is 0.10000000149). So does DuckDB with
# `x <= 1e-1`, whose limit is a float64, and with a parameter of Python.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q duckdb==2.0.1 datafusion==55.0.0 pyarrow==26.0.1 polars==2.1.0 pandas==3.1.1 "numpy==2.4.*"
venv/bin/python - <<'PYTHON'
import datafusion
import duckdb
import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

x = np.array([0.1], np.float32)
table = pa.table({"x": x})
context = datafusion.SessionContext()
context.register_record_batches("flight", [table.to_batches()])
seen = {
    "NumPy": bool((x <= 0.1)[0]),
    "pandas": bool((pd.Series(x) <= 0.1)[0]),
    "polars": bool((pl.Series(x) <= 0.1)[0]),
    "DuckDB": duckdb.sql("select x <= 0.1 from \"table\"").fetchall()[0][0],
    "pyarrow": pc.less_equal(table["x"], 0.1)[0].as_py(),
    "DataFusion": context.sql("select x <= 0.1 as small from flight").to_pydict()["small"][0],
}
print(seen)
assert [name for name, small in seen.items() if not small] == ["pyarrow", "DataFusion"]
exact = pc.less_equal(table["x"], pa.scalar(0.1, pa.float32()))[0].as_py()
print("pyarrow with a float32 limit:", exact)
assert exact
as_float64 = [
    duckdb.sql("select x <= 1e-1 from \"table\"").fetchall()[0][0],
    duckdb.execute("select x <= ? from \"table\"", [0.1]).fetchall()[0][0],
]
typed = duckdb.execute("select x <= ?::FLOAT from \"table\"", [0.1]).fetchall()[0][0]
print("DuckDB, 1e-1 and a parameter:", as_float64, "with the type:", typed)
assert as_float64 == [False, False] and typed
PYTHON
