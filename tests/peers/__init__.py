"""The other side of a test: processes, routers, HTTP clients, a browser, certificates and simulated vehicles."""
