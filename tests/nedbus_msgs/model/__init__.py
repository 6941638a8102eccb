"""Tests of definitions and layouts."""
