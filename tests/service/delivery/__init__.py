"""Delivery: recovery, downsampling, slow readers, heartbeats."""
