"""Tests of recordings and logs: files, arrays, alignment and plots."""
