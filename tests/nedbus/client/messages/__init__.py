"""Messages with and without a file, through a real router."""
