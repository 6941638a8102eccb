"""Publish your own estimate at 50 Hz: a vehicle called "mine" flies a circle."""

import math
import sys
import time
from contextlib import suppress

import nedbus

try:
    with suppress(KeyboardInterrupt), nedbus.connect() as bus:
        publisher = bus.publisher("external_ins_local_position", vehicle="mine")
        while True:
            now = time.monotonic()
            position = {"x": 10 * math.cos(now), "y": 10 * math.sin(now), "z": -5.0}
            # timestamp: the time since boot
            publisher.publish({**position, "xy_valid": True, "z_valid": True})
            time.sleep(0.02)
except nedbus.ConnectError as exc:
    sys.exit(str(exc))
