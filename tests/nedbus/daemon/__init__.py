"""The service: its sources, output, reload and log streams."""
