"""Sources: MAVLink, PX4 over Zenoh, logs, the simulator."""
