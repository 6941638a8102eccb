"""List all vehicles once: their streams, positions, and the age of their last messages."""

import os
import sys
from contextlib import suppress

import nedbus

try:
    with suppress(KeyboardInterrupt), nedbus.connect() as bus:
        for vehicle, addresses in bus.vehicles().items():
            print(f"vehicle {vehicle}: {len(addresses)} streams")
        for sample in bus.latest():
            age = "unknown" if sample.latency is None else f"{sample.latency:.3f} s"
            position = sample.message.position
            where = (
                "no valid position"
                if position is None
                else " ".join(f"{metres:.2f}" for metres in position)
            )
            doubt = ", dead reckoning" if sample.message.dead_reckoning else ""
            print(f"{sample.vehicle}: {where}, {age} old{doubt}")
except BrokenPipeError:
    os._exit(0)  # the reader, such as `head`, has ended: a normal exit would print the rest
except nedbus.ConnectError as exc:
    sys.exit(str(exc))
