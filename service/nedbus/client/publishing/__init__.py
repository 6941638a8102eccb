"""The sending side of a session: publishers with flow control, heartbeats and downsampling, and query replies."""
