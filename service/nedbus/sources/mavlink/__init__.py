"""MAVLink vehicles: `mavlink:`, over UDP, TCP or a serial port."""
