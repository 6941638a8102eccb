import nedbus

with nedbus.connect() as bus:
    for sample in bus.subscribe():  # all four topics of all vehicles; or name a topic, a vehicle, an instance
        message = sample.message
        if message.xy_valid and message.z_valid:
            place = f"{message.x:.2f} m north, {message.y:.2f} m east, {-message.z:.2f} m up"
            print(sample.vehicle, sample.topic, place)
