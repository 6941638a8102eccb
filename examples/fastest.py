"""Print the highest speed of each vehicle: of live vehicles, or of files given as arguments."""

import math
import os
import sys
from collections.abc import Iterable
from contextlib import suppress

import nedbus


def show_highest_speeds(samples: Iterable[nedbus.Sample]) -> None:
    fastest: dict[str, float] = {}
    for sample in samples:  # from a bus or from a file
        message = sample.message
        speed = math.hypot(message.vx, message.vy, message.vz)
        if (
            message.v_xy_valid
            and message.v_z_valid
            and speed > fastest.get(sample.vehicle, 0.0) + 0.5
        ):
            fastest[sample.vehicle] = speed
            print(f"{sample.vehicle}: {speed:.1f} m/s", flush=True)


try:
    with suppress(KeyboardInterrupt):
        if files := sys.argv[1:]:
            with nedbus.open(files) as flight:
                show_highest_speeds(flight(nedbus.VehicleLocalPosition))
        else:
            with nedbus.connect() as bus:
                show_highest_speeds(bus.subscribe(nedbus.VehicleLocalPosition, mode="every"))
except BrokenPipeError:
    os._exit(0)  # the reader, such as `head`, has ended: a normal exit would print the rest
except (nedbus.ConnectError, nedbus.SourceError) as exc:
    sys.exit(str(exc))
