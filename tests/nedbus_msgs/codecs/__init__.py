"""Messages as bytes, rows and arrays."""
