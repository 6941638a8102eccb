#!/usr/bin/env bash
# apache-arrow 21.2.0 (JavaScript), pandas 3.1.1 with pyarrow 26.0.1, polars 2.1.0, 2026-11-29: the JavaScript library does not
# read what pandas' to_feather writes by default, because it has no codec of its own for the LZ4 compression. It reads
# the same table written with compression="uncompressed", and polars' write_ipc.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q pandas==3.1.1 pyarrow==26.0.1 polars==2.1.0
npm install --silent --no-audit --no-fund apache-arrow@21.2.0 >/dev/null
venv/bin/python - <<'PYTHON'
import pandas as pd
import polars as pl

table = pd.DataFrame({"timestamp": range(1000), "x": [number / 10 for number in range(1000)]})
table.to_feather("default.feather")
table.to_feather("uncompressed.feather", compression="uncompressed")
pl.DataFrame({"timestamp": range(1000)}).write_ipc("polars.arrow")
PYTHON
cat >probe.mjs <<'JAVASCRIPT'
import assert from 'node:assert'
import { readFileSync } from 'node:fs'
import { tableFromIPC } from 'apache-arrow'

const seen = {}
for (const name of ['default.feather', 'uncompressed.feather', 'polars.arrow']) {
  try {
    seen[name] = tableFromIPC(readFileSync(name)).numRows
  } catch (error) {
    seen[name] = error.message
  }
}
console.log('apache-arrow 21.2.0:', seen)
assert.match(seen['default.feather'], /codec not found/)
assert.equal(seen['uncompressed.feather'], 1000)
assert.equal(seen['polars.arrow'], 1000)
JAVASCRIPT
node probe.mjs
