"""Tests: the docstring of each test states the rule that it proves."""
