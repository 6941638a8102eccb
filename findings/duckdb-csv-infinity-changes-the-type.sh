#!/usr/bin/env bash
# DuckDB 2.0.1, 2026-11-28: its CSV reader takes no `inf` as a number. A column with `inf` alone, such as PX4's vxy_max
# without a limit, becomes DATE (9999-12-31), and one with `inf` and 3.5 becomes VARCHAR; `nan` stays DOUBLE.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q duckdb==2.0.1
venv/bin/python - <<'PYTHON'
import duckdb

with open("flight.csv", "w") as stream:
    stream.write("timestamp,vxy_max,hagl_min,ref_alt\n1,inf,inf,nan\n2,inf,3.5,nan\n")
types = {name: kind for name, kind, *_ in duckdb.sql("describe select * from 'flight.csv'").fetchall()}
print("DuckDB", duckdb.__version__, types, duckdb.sql("select vxy_max from 'flight.csv'").fetchall())
assert types == {"timestamp": "BIGINT", "vxy_max": "DATE", "hagl_min": "VARCHAR", "ref_alt": "DOUBLE"}
typed = duckdb.sql("select vxy_max from read_csv('flight.csv', types={'vxy_max': 'DOUBLE'})").fetchall()
print("with the type given:", typed)
assert typed == [(float("inf"),)] * 2
PYTHON
