#!/usr/bin/env bash
# ulogr 0.1.0, 2026-11-29: it requires fields that PX4's releases do not all have: estimator_status of 1.16 and newer has
# hdg_test_ratio in place of mag_test_ratio, and the whole log gets no report (KeyError). With the field of 1.15 the same
# log gets one. Of six real logs of PX4 1.12 to 1.17, it opened one.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install -q ulogr==0.1.0 pyulog==1.3.0
cat >log.py <<'PYTHON'
import struct

RATIOS = ("vel_test_ratio", "pos_test_ratio", "hgt_test_ratio", "tas_test_ratio", "hagl_test_ratio", "beta_test_ratio")


def record(kind, body):
    return struct.pack("<HB", len(body), ord(kind)) + body


for name, ratio in (("v1_15", "mag_test_ratio"), ("v1_16", "hdg_test_ratio")):
    fields = "".join(f"float {each};" for each in (ratio, *RATIOS))
    log = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + record("B", bytes(40))
    flags = "uint32_t filter_fault_flags;uint16_t gps_check_fail_flags;"
    log += record("F", f"estimator_status:uint64_t timestamp;{fields}{flags}".encode())
    log += record("F", b"vehicle_local_position:uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;")
    log += record("A", struct.pack("<BH", 0, 0) + b"estimator_status")
    log += record("A", struct.pack("<BH", 0, 1) + b"vehicle_local_position")
    for number in range(1, 100):
        log += record("D", struct.pack("<HQ7fIH", 0, 100_000 * number, *[0.1] * 7, 0, 0))
        log += record("D", struct.pack("<HQ6f", 1, 100_000 * number, 0, 0, -5, 0, 0, 0))
    with open(f"{name}.ulg", "wb") as stream:
        stream.write(log)
PYTHON
venv/bin/python log.py
venv/bin/ulogr v1_15.ulg -o v1_15.html | tail -n 1
[ -s v1_15.html ]
code=0
venv/bin/ulogr v1_16.ulg -o v1_16.html >output.txt 2>&1 || code=$?
tail -n 1 output.txt
[ "$code" -ne 0 ] && grep -q "KeyError: 'mag_test_ratio'" output.txt && [ ! -e v1_16.html ]
