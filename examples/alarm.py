"""Print an alarm when a vehicle's position is in doubt or nothing arrives for 1 s, and when it is good again."""

import os
import sys
from collections.abc import Iterator
from contextlib import suppress

import nedbus

VALID = ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid")
GOOD = {**dict.fromkeys(VALID, True), "dead_reckoning": False}


def states(vehicle: str) -> Iterator[str]:
    """Yield the state of a vehicle after each message, and after each second without one."""
    try:
        bus = nedbus.connect()
    except nedbus.ConnectError as exc:
        yield f"ALARM: {exc}"
        bus = nedbus.connect(timeout=None)  # wait for a router
    with bus, bus.subscribe(vehicle=vehicle) as subscription:
        while True:  # the subscription survives restarts of the service and the router
            try:
                sample = subscription.receive(timeout=1.0)
            except nedbus.NoDataError:
                yield "ALARM: nothing arrived for 1 s"
            else:
                known = {
                    flag: getattr(sample.message, flag) for flag in GOOD.keys() - sample.missing
                }
                doubts = [
                    f"{flag} is {known[flag]}"
                    for flag, good in GOOD.items()
                    if known.get(flag, good) != good
                ]
                doubts += [f"{flag} is unknown" for flag in VALID if flag not in known]
                yield f"ALARM: {', '.join(doubts).lower()}" if doubts else "good"


if any(argument.startswith("-") for argument in sys.argv[1:]):
    print("usage: alarm.py [VEHICLE]", file=sys.stderr)
    sys.exit(2)
watched = sys.argv[1] if len(sys.argv) > 1 else "1"
shown = ""
try:
    with suppress(KeyboardInterrupt):
        for state in states(watched):
            if state != shown:
                shown = state
                print(f"vehicle {watched}: {state}", flush=True)
except BrokenPipeError:
    os._exit(0)  # the reader, such as `head`, has ended: a normal exit would print the rest
