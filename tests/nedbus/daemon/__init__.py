"""The service, its settings, and its monitoring."""
