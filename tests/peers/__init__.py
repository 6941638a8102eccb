"""Peers of the tests: processes, routers, HTTP clients, a browser, certificates and simulated vehicles."""
