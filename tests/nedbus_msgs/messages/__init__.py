"""Messages with a file."""
