"""Tests of `nedbus doctor`."""
