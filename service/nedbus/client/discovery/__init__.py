"""Discovery of peers: vehicles, services and their status, layouts, rejected messages."""
