import os
from contextlib import suppress

import nedbus

try:
    with suppress(KeyboardInterrupt), nedbus.connect() as bus:
        for sample in bus.subscribe():  # vehicle_local_position of all vehicles, by default
            position = sample.message.position  # None while it is invalid or of unknown validity
            if position is None:
                print(sample.vehicle, "has no valid position")
            else:
                north, east, down = position
                print(sample.vehicle, f"{north:.2f} m north, {east:.2f} m east, {-down:.2f} m up")
except BrokenPipeError:
    os._exit(0)  # the reader, such as `head`, has ended: a normal exit would print the rest
except nedbus.ConnectError as exc:
    raise SystemExit(str(exc)) from None
