"""Messages and logs that tests send and read."""
