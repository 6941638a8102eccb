#!/usr/bin/env bash
# DuckDB 2.0.1, DataFusion 55.0.0, pyarrow 26.0.1, polars 2.1.0, 2026-11-29: the minimum and maximum of a Parquet column
# leave NaN out. Files of pyarrow and polars have them, and DuckDB's `eph > 5` then finds no NaN, nor its isnan(eph) any;
# in memory both do, because NaN is above all numbers there. DataFusion differs in `eph > 5` only. Of DuckDB's own file,
# which has no such minimum and maximum, both find the NaN.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q duckdb==2.0.1 datafusion==55.0.0 pyarrow==26.0.1 polars==2.1.0
venv/bin/python - <<'PYTHON'
import math

import datafusion
import duckdb
import polars as pl
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

table = pa.table({"row": [0, 1, 2, 3], "eph": pa.array([1.0, 2.0, math.nan, 3.0], pa.float32())})
pq.write_table(table, "pyarrow.parquet")
pl.from_arrow(table).write_parquet("polars.parquet")
duckdb.sql('copy (select * from "table") to \'duckdb.parquet\'')
context = datafusion.SessionContext()
context.register_record_batches("memory", [table.to_batches()])
seen = {}
for name in ("pyarrow", "polars", "duckdb"):
    context.register_parquet(name, f"{name}.parquet")
for name in ("memory", "pyarrow", "polars", "duckdb"):
    for where in ("eph > 5", "isnan(eph)"):
        source = '"table"' if name == "memory" else f"'{name}.parquet'"
        in_duckdb = [row for (row,) in duckdb.sql(f"select row from {source} where {where}").fetchall()]
        in_datafusion = context.sql(f"select row from {name} where {where}").to_pydict().get("row", [])
        seen[name, where] = (in_duckdb, in_datafusion)
        print(f"{name:8} {where:11} DuckDB {in_duckdb} DataFusion {in_datafusion}")
for name in ("memory", "duckdb"):
    assert seen[name, "eph > 5"] == seen[name, "isnan(eph)"] == ([2], [2])
for name in ("pyarrow", "polars"):
    assert seen[name, "eph > 5"] == ([], [])
    assert seen[name, "isnan(eph)"] == ([], [2])
above = ds.dataset("pyarrow.parquet").to_table(filter=ds.field("eph") > 5)["row"].to_pylist()
polars_above = pl.scan_parquet("pyarrow.parquet").filter(pl.col("eph") > 5).collect()["row"].to_list()
print("pyarrow.parquet, eph > 5: pyarrow", above, "polars", polars_above)
assert (above, polars_above) == ([], [2])
PYTHON
