from contextlib import suppress

import nedbus

with suppress(KeyboardInterrupt), nedbus.connect() as bus:
    for sample in bus.subscribe():  # vehicle_local_position of all vehicles, by default
        message = sample.message
        if message.xy_valid and message.z_valid:
            position = f"{message.x:.2f} m north, {message.y:.2f} m east, {-message.z:.2f} m up"
            print(sample.vehicle, position)
