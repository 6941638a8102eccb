#!/usr/bin/env bash
# @dsnp/parquetjs 1.8.8 and hyparquet 1.33.0 (JavaScript), pandas 3.1.1, polars 2.1.0, 2026-11-29: parquetjs returns a uint32 of
# 2147483648 as -2147483648, and a uint64 in the same way, although the file's schema says that they are unsigned; hyparquet
# returns both as they were written. Neither reads the zstd compression of polars on its own; hyparquet has a package for it.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q pandas==3.1.1 pyarrow==26.0.1 polars==2.1.0
npm install --silent --no-audit --no-fund @dsnp/parquetjs@1.8.8 hyparquet@1.33.0 hyparquet-compressors@1.1.2 >/dev/null
venv/bin/python - <<'PYTHON'
import numpy as np
import pandas as pd
import polars as pl

columns = {
    "mask": np.array([1, 2**31 - 1, 2**31, 2**32 - 1], "uint32"),
    "counter": np.array([1, 127, 128, 255], "uint8"),
    "stamp": np.array([1, 2**53 + 1, 2**63, 2**64 - 1], "uint64"),
}
pd.DataFrame(columns).to_parquet("pandas.parquet")
pl.DataFrame(columns).write_parquet("polars.parquet")
PYTHON
cat >probe.mjs <<'JAVASCRIPT'
import assert from 'node:assert'
import { readFileSync } from 'node:fs'
import parquetjs from '@dsnp/parquetjs'
import { parquetReadObjects } from 'hyparquet'
import { compressors } from 'hyparquet-compressors'

async function withParquetjs(name) {
  const cursor = (await parquetjs.ParquetReader.openFile(name)).getCursor()
  const rows = []
  for (let row = await cursor.next(); row; row = await cursor.next()) rows.push(row)
  return rows
}
async function withHyparquet(name) {
  const content = readFileSync(name)
  const file = content.buffer.slice(content.byteOffset, content.byteOffset + content.length)
  return parquetReadObjects({ file, compressors })
}
const columnsOf = (rows) => ({
  mask: rows.map((row) => row.mask),
  counter: rows.map((row) => row.counter),
  stamp: rows.map((row) => row.stamp),
})
const written = {
  mask: [1, 2147483647, 2147483648, 4294967295],
  counter: [1, 127, 128, 255],
  stamp: [1n, 9007199254740993n, 9223372036854775808n, 18446744073709551615n],
}
const seen = columnsOf(await withParquetjs('pandas.parquet'))
console.log('@dsnp/parquetjs 1.8.8:', seen)
assert.deepEqual(seen.mask, [1, 2147483647, -2147483648, -1])
assert.deepEqual(seen.counter, written.counter)
assert.deepEqual(seen.stamp, [1n, 9007199254740993n, -9223372036854775808n, -1n])
await assert.rejects(withParquetjs('polars.parquet'), /ZSTD/)
for (const name of ['pandas.parquet', 'polars.parquet']) {
  assert.deepEqual(columnsOf(await withHyparquet(name)), written)
}
console.log('hyparquet 1.33.0: as written')
JAVASCRIPT
node probe.mjs
