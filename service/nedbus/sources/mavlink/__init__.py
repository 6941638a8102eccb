"""Vehicles that speak MAVLink: `mavlink:`, over UDP, TCP or a serial port."""
