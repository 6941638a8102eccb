"""Messages with definitions from nedbus and from their publishers, through a real router."""
