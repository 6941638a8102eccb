"""Tests of metrics and health over HTTP."""
