#!/usr/bin/env bash
# eclipse-zenoh 1.10.2, 2026-11-29: a client that asks a router for liveliness tokens gets its own token twice, and that of
# another client once.
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


def session(mode, **endpoints):
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    for name, values in endpoints.items():
        config.insert_json5(f"{name}/endpoints", json.dumps(values))
    return zenoh.open(config)


def tokens(of, key):
    return [str(reply.ok.key_expr) for reply in of.liveliness().get(key)]


with socket.socket() as probe:
    probe.bind(("127.0.0.1", 0))
    endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
with (
    session("router", listen=[endpoint]) as router,
    session("client", connect=[endpoint]) as owner,
    session("client", connect=[endpoint]) as other,
):
    token = owner.liveliness().declare_token("probe/alive")
    deadline = time.monotonic() + 20
    while not tokens(other, "probe/*"):
        assert time.monotonic() < deadline, "no token"
        time.sleep(0.1)
    seen = {name: tokens(of, "probe/*") for name, of in (("owner", owner), ("other", other), ("router", router))}
    print("eclipse-zenoh 1.10.2:", seen)
    token.undeclare()
assert seen == {"owner": ["probe/alive"] * 2, "other": ["probe/alive"], "router": ["probe/alive"]}
PYTHON
timeout 60 "$work/venv/bin/python" "$work/probe.py"
