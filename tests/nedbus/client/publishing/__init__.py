"""Publishers: flow control, heartbeats and slow readers."""
