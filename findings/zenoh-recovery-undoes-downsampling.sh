#!/usr/bin/env bash
# eclipse-zenoh 1.10.2, 2026-11-29: a router's `downsampling` to 2 Hz limits a plain subscriber, while an advanced
# subscriber with recovery requests what the router left out as missed: it gets all samples of a publisher at 20 Hz.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q eclipse-zenoh==1.10.2
cat >"$work/probe.py" <<'PYTHON'
import json
import socket
import time

import zenoh
import zenoh.ext

COUNT = 40


def session(mode, **settings):
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("timestamping/enabled", "true")
    config.insert_json5("listen/endpoints", "[]")
    for name, value in settings.items():
        config.insert_json5(name.replace("__", "/"), json.dumps(value))
    return zenoh.open(config)


with socket.socket() as probe:
    probe.bind(("127.0.0.1", 0))
    endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
limit = [{"messages": ["put"], "flows": ["egress"], "rules": [{"key_expr": "probe/**", "freq": 2.0}]}]
with (
    session("router", listen__endpoints=[endpoint], downsampling=limit),
    session("client", connect__endpoints=[endpoint]) as sender,
    session("client", connect__endpoints=[endpoint]) as reader,
):
    publisher = zenoh.ext.declare_advanced_publisher(
        sender,
        "probe/position",
        cache=zenoh.ext.CacheConfig(max_samples=100),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=0.5),
    )
    plain = reader.declare_subscriber("probe/position")
    recovery = zenoh.ext.RecoveryConfig(heartbeat=True)
    advanced = zenoh.ext.declare_advanced_subscriber(reader, "probe/position", recovery=recovery)
    time.sleep(1)
    for number in range(COUNT):
        publisher.put(str(number))
        time.sleep(0.05)
    received = {"plain": [], "advanced": []}
    deadline = time.monotonic() + 10
    while len(received["advanced"]) < COUNT and time.monotonic() < deadline:
        time.sleep(0.1)
        for name, subscriber in (("plain", plain), ("advanced", advanced)):
            while (sample := subscriber.try_recv()) is not None:
                received[name].append(int(sample.payload.to_string()))
print("eclipse-zenoh 1.10.2, received of", COUNT, {name: len(numbers) for name, numbers in received.items()})
assert len(received["plain"]) < COUNT / 2
assert received["advanced"] == list(range(COUNT))
PYTHON
timeout 60 "$work/venv/bin/python" "$work/probe.py"
