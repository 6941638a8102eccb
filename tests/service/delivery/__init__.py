"""Tests of recovery, downsampling, slow readers and heartbeats."""
