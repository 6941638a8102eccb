#!/usr/bin/env bash
# NumPy 2.4, pandas 3.1.1, polars 2.1.0, pyarrow 26.0.1, DataFusion 55.0.0, DuckDB 2.0.1, 2026-11-29: 10 - 20 of a uint64,
# such as PX4's timestamps, is 18446744073709551606 in all but DuckDB, which raises an error. polars' diff() gives -10,
# NumPy's the wrapped number, and pandas' the same as a float, 1.8e19.
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

earlier, later = np.array([10], np.uint64), np.array([20], np.uint64)
table = pa.table({"earlier": earlier, "later": later})
context = datafusion.SessionContext()
context.register_record_batches("flight", [table.to_batches()])
seen = {
    "NumPy": int((earlier - later)[0]),
    "NumPy diff": int(np.diff(np.array([20, 10], np.uint64))[0]),
    "pandas": int((pd.Series(earlier) - pd.Series(later))[0]),
    "polars": int((pl.Series(earlier) - pl.Series(later))[0]),
    "pyarrow": pc.subtract(table["earlier"], table["later"])[0].as_py(),
    "DataFusion": context.sql("select earlier - later as age from flight").to_pydict()["age"][0],
    "pandas diff": float(pd.Series(np.array([20, 10], np.uint64)).diff()[1]),
    "polars diff": pl.Series(np.array([20, 10], np.uint64)).diff()[1],
}
print(seen)
wrapped = [name for name, age in seen.items() if age == 2**64 - 10]
assert wrapped == ["NumPy", "NumPy diff", "pandas", "polars", "pyarrow", "DataFusion"]
assert seen["pandas diff"] == 2.0**64 and seen["polars diff"] == -10
try:
    duckdb.sql("select earlier - later from \"table\"").fetchall()
    refused = False
except duckdb.OutOfRangeException as error:
    print("DuckDB:", error)
    refused = True
assert refused
PYTHON
