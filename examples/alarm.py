"""Raise an alarm when a vehicle has no valid position, or when nothing arrives for 1 s; say when it is good again."""

import sys
from contextlib import suppress

import nedbus

vehicle = sys.argv[1] if len(sys.argv) > 1 else "1"
state = ""
with suppress(KeyboardInterrupt), nedbus.connect() as bus, bus.subscribe(vehicle=vehicle) as subscription:
    while True:  # the subscription outlives its service, and its router: it goes on when they are back
        try:
            message = subscription.receive(timeout=1.0).message
            found = "good" if message.xy_valid else "ALARM: xy_valid is false"
        except nedbus.NoDataError:
            found = "ALARM: nothing arrived for 1 s"
        if found != state:
            state = found
            print(f"vehicle {vehicle}: {state}", flush=True)
