"""The sending side of a session: publishers, their flow control, heartbeats and downsampling, answers to queries."""
