"""Tests of the codecs: payloads, rows and arrays."""
