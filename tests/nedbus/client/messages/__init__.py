"""Messages through a real router, with definitions that are built in or queried from their publishers."""
