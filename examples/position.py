import signal
from contextlib import suppress

import nedbus

signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `| head` ends the script
try:
    with suppress(KeyboardInterrupt), nedbus.connect() as bus:
        for sample in bus.subscribe():  # vehicle_local_position of all vehicles, by default
            position = sample.message.position  # None while it is invalid or of unknown validity
            if position is None:
                print(sample.vehicle, "has no valid position")
            else:
                north, east, down = position
                print(sample.vehicle, f"{north:.2f} m north, {east:.2f} m east, {-down:.2f} m up")
except nedbus.ConnectError as exc:
    raise SystemExit(str(exc)) from None
