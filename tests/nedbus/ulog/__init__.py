"""Tests of the ULog parser."""
