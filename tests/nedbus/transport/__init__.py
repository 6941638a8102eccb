"""Routers, certificates and access rules."""
