"""Output of the commands: logs and terminals."""
