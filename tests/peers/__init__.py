"""Peers of the tests: processes, servers, a browser, certificates, and sources as a service reads them."""
