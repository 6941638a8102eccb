#!/usr/bin/env bash
# eclipse-zenoh 1.10.2, 2026-11-29: a liveliness token that ends just after a client has subscribed with `history=True`
# can stay alive for that client: it gets the PUT of the token, but never the DELETE. Later queries on its session return
# the token as well; queries on other sessions do not. It depends on timing: one of 20 to 400 attempts.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q eclipse-zenoh==1.10.2
"$work/venv/bin/python" - <<'PYTHON'
import socket
import threading
import time

import zenoh

ATTEMPTS = 1000

with socket.socket() as probe:
    probe.bind(("127.0.0.1", 0))
    ENDPOINT = f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def open_session(mode, option):
    config = zenoh.Config()
    config.insert_json5("mode", f'"{mode}"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5(f"{option}/endpoints", f'["{ENDPOINT}"]')
    return zenoh.open(config)


def listed(session):
    return "robot/0" in [str(reply.ok.key_expr) for reply in session.liveliness().get("robot/**")]


router = open_session("router", "listen")
robot = open_session("client", "connect")
for attempt in range(1, ATTEMPTS + 1):
    tokens = [robot.liveliness().declare_token(f"robot/{number}") for number in range(10)]
    listed(robot)
    reader = open_session("client", "connect")
    end = threading.Thread(target=tokens.pop(0).undeclare)
    subscriber = reader.liveliness().declare_subscriber("robot/**", zenoh.handlers.FifoChannel(100), history=True)
    end.start()
    end.join()
    time.sleep(0.3)
    samples = list(iter(subscriber.try_recv, None))
    kinds = [sample.kind for sample in samples if str(sample.key_expr) == "robot/0"]
    if kinds == [zenoh.SampleKind.PUT] and not listed(robot):
        time.sleep(5)
        assert subscriber.try_recv() is None
        print(f"eclipse-zenoh 1.10.2, attempt {attempt}: PUT, and no DELETE within 5 s")
        print("the token, by a query on the session of the subscriber:", listed(reader), "; on another one:", listed(robot))
        assert listed(reader) and not listed(robot)
        break
    reader.close()
    for token in tokens:
        token.undeclare()
else:
    raise SystemExit(f"not seen in {ATTEMPTS} attempts")
PYTHON
